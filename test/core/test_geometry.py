import threading
import time

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gapr_core.config import TargetConfig
from gapr_core.geometry import distance_field, quadrics, sampling, visibility
from gapr_core.registration.problem import target as targets


def sphere(count=4000, radius=30.0):
    directions = sampling.fibonacci_directions(count)
    return directions * radius, directions


def central_points(points, voxel_mm):
    """What `voxel_indices` finds, with NumPy."""
    cells = np.floor((points - points.min(axis=0)) / voxel_mm).astype(np.int64)
    _, voxel, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(voxel, weights=axis) for axis in points.T], axis=1) / counts[:, None]
    distance = np.linalg.norm(points - means[voxel], axis=1).round(9)  # ties are those but for rounding
    order = np.lexsort((*points.T[::-1], distance, voxel))
    return np.sort(order[np.concatenate([[0], np.cumsum(counts)[:-1]])])


@pytest.mark.parametrize("voxel_mm", [0.01, 0.8, 5.0, 1000.0])
def test_every_voxel_keeps_the_point_nearest_to_the_mean_and_of_two_the_first_by_x_y_z(voxel_mm):
    rng = np.random.default_rng(0)  # most voxels of 0.8 mm with two points have two that are equally near
    points = np.vstack([rng.uniform(-5, 5, (1000, 3)), rng.normal(size=(300, 3)) * [1, 1, 300], np.zeros((3, 3))])
    np.testing.assert_array_equal(sampling.voxel_indices(points, voxel_mm), central_points(points, voxel_mm))


def test_the_same_points_are_thinned_to_the_same_wherever_they_lie_and_in_any_order():
    points = np.random.default_rng(0).uniform(-5, 5, (3000, 3))
    kept = points[sampling.thin(points, 900)]
    for shift in ([0.37, 0.81, -0.4], [1234.5, -777.7, 3000.1]):
        moved = points + shift
        np.testing.assert_allclose(moved[sampling.thin(moved, 900)] - shift, kept, atol=1e-9)
    mixed = np.random.default_rng(1).permutation(points)
    np.testing.assert_array_equal(sampling.distinct(mixed[sampling.thin(mixed, 900)]), sampling.distinct(kept))


def test_no_voxel_keeps_more_than_so_many_points_or_times_the_typical_ones():
    rng = np.random.default_rng(1)
    apart = np.column_stack([2.0 * np.arange(30), np.zeros(30), np.zeros(30)])
    crowd = apart[4] + rng.uniform(0.0, 0.9, (20, 3))
    points = np.vstack([apart, crowd])
    kept = sampling.without_crowds(points, 1.0, 4, 2.0)
    np.testing.assert_array_equal(np.setdiff1d(apart[:, 0], apart[4, 0]), np.setdiff1d(kept[:, 0], [*crowd[:, 0], 8.0]))
    places = [np.flatnonzero((points == point).all(axis=1))[0] for point in kept]
    assert np.all(np.diff(places) > 0), "in their order"
    assert sum(place == 4 or place >= 30 for place in places) == 4 and len(kept) == 29 + 4
    assert len(sampling.without_crowds(points, 1.0, 4, 9.0)) == 30 + 8
    assert sampling.without_crowds(points, 1.0, 21, 2.0) is points
    dense = np.repeat(apart, 10, axis=0)
    assert sampling.without_crowds(dense, 1.0, 4, 2.0) is dense, "all are as many"


def test_what_stays_of_crowds_lies_where_they_do_though_points_come_sorted():
    """The first of sorted points would be those of low x, and a bone that is held by them lies aside."""
    apart = 3.0 * np.stack(np.meshgrid(*[np.arange(10.0)] * 2, [0.0]), axis=-1).reshape(-1, 3)
    crowds = (apart[:30, None] + np.random.default_rng(0).uniform(0.05, 0.95, (30, 40, 3))).reshape(-1, 3)
    points = sampling.distinct(np.vstack([apart, crowds]))
    kept = sampling.without_crowds(points, 1.0, 5, 5.0)
    assert len(kept) == 100 - 30 + 30 * 5
    aside = (kept[(kept % 3.0 > 0.0).any(axis=1)] % 3.0).mean(axis=0) - 0.5
    assert np.abs(aside).max() < 4 * 0.26 / np.sqrt(140)


def test_thinning_takes_the_finest_grid_that_its_bisection_finds():
    points = np.random.default_rng(0).normal(size=(5000, 3)) * [10, 20, 100]
    low, high = 0.0, np.ptp(points, axis=0).max() + 1e-9
    for _ in range(12):
        middle = 0.5 * (low + high) if low else high / 16.0
        kept = len(central_points(points, middle))
        low, high = (middle, high) if kept > 700 else (low, middle)
        if 0.97 * 700 < kept <= 700:
            break
    np.testing.assert_array_equal(sampling.thin(points, 700), central_points(points, high))


def test_distinct_points_are_those_of_numpy_whatever_repeats():
    rng = np.random.default_rng(0)
    points = rng.integers(-2, 3, (400, 3)) * 0.5
    np.testing.assert_array_equal(sampling.distinct(points), np.unique(points, axis=0))
    for count in (0, 1):
        np.testing.assert_array_equal(sampling.distinct(points[:count]), points[:count])


def test_sorting_out_doubles_does_not_stop_other_threads():
    """A node must be able to answer, and to end, while it sorts millions of points."""
    points, gaps, done = np.random.default_rng(0).normal(size=(400_000, 3)), [], threading.Event()

    def tick():
        last = time.perf_counter()
        while not done.wait(0.001):
            now = time.perf_counter()
            gaps.append(now - last)
            last = now

    thread = threading.Thread(target=tick)
    thread.start()
    start = time.perf_counter()
    sampling.distinct(points)
    lasted = time.perf_counter() - start
    done.set()
    thread.join()
    assert max(gaps) < 0.7 * lasted


def test_a_small_cloud_is_not_thinned():
    assert list(sampling.thin(np.eye(3), 10)) == [0, 1, 2]


def test_farthest_points_agree_with_the_definition():
    points = np.random.default_rng(0).normal(size=(60, 3))
    chosen = sampling.farthest_points(points, 10, start=4)
    assert chosen[0] == 4
    for i in range(1, 10):
        distance = np.linalg.norm(points[:, None] - points[chosen[:i]], axis=2).min(axis=1)
        assert distance[chosen[i]] == pytest.approx(distance.max())


def test_views_vote_for_the_outward_side_of_a_closed_surface():
    points, outward = sphere()
    votes, counts = visibility.outward_votes(points, outward, quadrics.spacing(points))
    assert (np.einsum("ni,ni->n", votes, outward) > 0.0).all()
    assert (counts > 0).all()


def test_a_wall_inside_the_body_is_not_seen_from_outside():
    outer, outer_normals = sphere(6000, 30.0)
    inner, inner_normals = sphere(2000, 15.0)
    points, normals = np.vstack([outer, inner]), np.vstack([outer_normals, inner_normals])
    _, counts = visibility.outward_votes(points, normals, quadrics.spacing(outer))
    assert (counts[:6000] > 0).all()
    assert (counts[6000:] > 0).mean() < 0.01


def bent_slab(count=1500):
    """Points of a bent sheet and of its back, 3 mm below; outward normals of the points, and a direction of view."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-20, 20, (2, count))
    top = np.stack([x, y, 0.01 * x**2 - 0.02 * x * y], axis=1)
    normals = np.stack([-0.02 * x + 0.02 * y, 0.02 * x, np.ones(count)], axis=1)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    direction = np.array([0.6, 0.1, 0.9])
    return np.vstack([top, top - 3.0 * normals]), np.vstack([normals, -normals]), direction / np.linalg.norm(direction)


def in_a_view(direction, points, pixel_mm):
    """Heights (N,), and for each point the indices of those in the 3 x 3 pixels around it."""
    side = np.cross(direction, [1.0, 0.0, 0.0] if abs(direction[0]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    flat = points @ np.stack([side, np.cross(direction, side)], axis=1)
    pixel = np.floor((flat - flat.min(axis=0)) / pixel_mm)
    return points @ direction, [np.flatnonzero((np.abs(pixel - own) <= 1).all(axis=1)) for own in pixel]


@pytest.mark.parametrize("turn", [[0, 1, 2], [2, 0, 1]])
def test_a_point_is_seen_when_nothing_near_it_is_higher_than_its_slope_explains(turn):
    points, normals, direction = (a[..., turn] for a in bent_slab())
    direction = direction if turn[0] == 0 else np.array([0.95, 0.1, 0.3]) / np.linalg.norm([0.95, 0.1, 0.3])
    height, around = in_a_view(direction, points, 2.0)
    facing = np.abs(normals @ direction)
    explained = 2.0 * (0.5 + 1.5 * np.minimum(np.sqrt(1.0 - facing**2) / facing, 2.0))
    expected = [height[p] >= height[near].max() - explained[p] for p, near in enumerate(around)]
    seen = visibility.seen_from(direction, points, normals, 2.0)
    np.testing.assert_array_equal(seen, expected)
    assert 0.1 < seen.mean() < 0.9


def test_a_point_is_free_when_no_highest_point_of_a_pixel_near_it_is_above_its_plane():
    points, normals, direction = bent_slab()
    height, around = in_a_view(direction, points, 2.0)
    side = np.cross(direction, [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    flat = points @ np.stack([side, np.cross(direction, side)], axis=1)
    pixel = np.floor((flat - flat.min(axis=0)) / 2.0)
    highest = {tuple(own): p for own, p in zip(pixel[np.argsort(height)], np.argsort(height), strict=True)}
    expected = np.abs(normals @ direction) > 0.1
    for p, near in enumerate(around):
        tops = points[sorted({highest[tuple(pixel[q])] for q in near})]
        expected[p] &= ((tops - points[p]) @ normals[p] * np.sign(normals[p] @ direction) < 1.0).all()
    free = visibility.unobstructed_from(direction, points, normals, 2.0)
    np.testing.assert_array_equal(free, expected)
    assert 0.1 < free.mean() < 0.9


def test_a_point_whose_surface_is_seen_edge_on_is_not_free():
    points, normals = np.zeros((2, 3)), np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]])
    points[1, 1] = 20.0
    free = visibility.unobstructed_from(np.array([0.0, 0.0, 1.0]), points, normals, 2.0)
    np.testing.assert_array_equal(free, [False, True])


def test_an_outer_layer_grows_to_its_neighbours_on_the_surface_and_not_across_a_gap():
    x, y = np.meshgrid(np.arange(8.0), np.arange(8.0))
    patch = np.stack([x.ravel(), y.ravel(), np.zeros(64)], axis=1)
    others = np.array(
        [[8.0, 3.0, 0.0], [8.0, 3.0, 0.6], [30.0, 3.0, 0.0]]
    )  # next to it, above it, far off in its plane
    points, outer = np.vstack([patch, others]), np.arange(67) < 64
    outward = np.tile([0.0, 0.0, 1.0], (67, 1)) * outer[:, None]
    visibility._grow(outer, outward, points, 1.0, num_threads=1)
    np.testing.assert_array_equal(outer[64:], [True, False, False])
    assert outward[64:] == pytest.approx(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))


def test_a_quadric_is_the_weighted_least_squares_fit_to_the_neighbours():
    points, normals, _ = bent_slab()
    neighbours = cKDTree(points).query(points, k=16)[1]
    corrected, shapes = quadrics.fit_quadrics(points, normals, neighbours, num_threads=2)
    for p in range(0, len(points), 300):
        tangents, offsets = quadrics.tangent_basis(normals[p : p + 1])[0], points[neighbours[p]] - points[p]
        far = np.linalg.norm(offsets, axis=1)
        reach = 1.05 * far.max()
        weight = (1.0 - (far / reach) ** 2) ** 2 * np.clip(normals[neighbours[p]] @ normals[p], 0.0, 1.0) ** 2
        u, v = tangents @ offsets.T / reach
        design = np.stack([np.ones(16), u, v, 0.5 * u**2, u * v, 0.5 * v**2], axis=1) * np.sqrt(weight)[:, None]
        ridge = np.vstack([design, 1e-3 * np.eye(6)])
        height = np.concatenate([np.sqrt(weight) * (offsets @ normals[p]), np.zeros(6)])
        fit = np.linalg.lstsq(ridge, height)[0]
        normal = normals[p] - fit[1:3] / reach @ tangents
        normal /= np.linalg.norm(normal)
        basis = quadrics.tangent_basis(normal[None], like=tangents[:1])[0]
        d, e, f = fit[3:] / reach**2
        assert corrected[p] == pytest.approx(normal, abs=1e-9)
        assert shapes[p] == pytest.approx(basis.T @ [[d, e], [e, f]] @ basis, abs=1e-9)


def test_the_misfit_is_the_rms_height_of_the_neighbours_above_the_quadric_up_to_a_limit():
    points, normals, _ = bent_slab()
    neighbours = cKDTree(points).query(points, k=16)[1]
    normals, shapes = quadrics.fit_quadrics(points, normals, neighbours)
    offsets = points[neighbours[:, 1:11]] - points[:, None]
    off = np.abs(quadrics.heights(offsets, normals[:, None], shapes[:, None]))
    found = quadrics.misfit_mm(points, normals, shapes, neighbours[:, 1:11], 2.0, num_threads=2)
    assert (off > 2.0).any()
    assert found == pytest.approx(np.sqrt((np.minimum(off, 2.0) ** 2).mean(axis=1)), abs=1e-12)


@pytest.mark.parametrize(("gain", "count"), [(0.5, 10), (2.0, 10), (0.5, 40)])
def test_the_variance_of_a_surface_element_is_its_gain_times_the_mean_square_misfit(femur_cloud, gain, count):
    target = targets.prepare(femur_cloud, config=TargetConfig(misfit_gain=gain, misfit_neighbours=count), num_threads=1)
    others = cKDTree(target.points).query(target.points, k=count + 1)[1][:, 1:]
    shapes = target.elements[:, [6, 7, 8, 7, 9, 10, 8, 10, 11]].reshape(-1, 3, 3)
    misfit = quadrics.misfit_mm(target.points, target.normals, shapes, others)
    assert target.elements[:, 12] == pytest.approx(gain * misfit**2, abs=1e-12)
    assert misfit.max() > 0.05


def test_local_frames_are_right_handed_rotations():
    points = np.random.default_rng(0).normal(size=(200, 3)) * [30, 20, 1]
    axes = quadrics.local_frames(points, cKDTree(points).query(points, k=12)[1]).axes
    assert np.allclose(axes @ axes.transpose(0, 2, 1), np.eye(3))
    assert np.allclose(np.linalg.det(axes), 1.0)


def test_the_field_holds_the_nearest_point_of_every_cell_within_reach():
    points, outward = sphere(2000, 30.0)
    field = distance_field.build(points, outward, spacing_mm=2.0, reach_mm=8.0)
    cells = np.stack(np.meshgrid(*[np.arange(n) for n in field.nearest.shape], indexing="ij"), axis=-1).reshape(-1, 3)
    centres = cells * field.cell_mm + field.origin
    gap, _ = cKDTree(points).query(centres)
    found = field.nearest.ravel()
    assert ((found >= 0) == (gap < 8.0)).mean() > 0.9999
    near = (found >= 0) & (gap < 7.99)
    assert np.linalg.norm(centres[near] - points[found[near]], axis=1) == pytest.approx(gap[near], abs=1e-3)
    beyond = field.distance.ravel() == distance_field.FARTHEST
    np.testing.assert_array_equal(beyond, found == distance_field.FAR)


def test_a_cell_as_near_to_two_points_has_the_first_however_many_threads_fill_the_field():
    points, outward = sphere(2000, 30.0)
    twice, normals = np.vstack([points, points]), np.vstack([outward, outward])
    one, two = (distance_field.build(twice, normals, 2.0, 8.0, num_threads=n) for n in (1, 2))
    assert one.nearest.max() < 2000
    np.testing.assert_array_equal(one.nearest, two.nearest)
    np.testing.assert_array_equal(one.distance, two.distance)


def test_the_field_gives_the_distance_to_the_surface_not_to_its_points():
    points, outward = sphere(2000, 30.0)
    field = distance_field.build(points, outward, spacing_mm=2.0, reach_mm=8.0)
    near = np.nonzero(field.distance < 250)
    centres = np.stack(near, axis=1) * field.cell_mm + field.origin
    true = np.abs(np.linalg.norm(centres, axis=1) - 30.0)
    assert np.abs(field.distance[near] * 8.0 / 255.0 - true).max() < 0.25


def test_of_few_points_the_nearest_in_a_tree_of_many_are_as_many_as_asked_for():
    many = np.random.default_rng(3).normal(size=(50, 3))
    gaps, found = quadrics.nearest(many[:4], 12, cKDTree(many))
    assert gaps.shape == found.shape == (4, 12)
    np.testing.assert_array_equal(found[:, 0], range(4))
    assert quadrics.nearest(many[:4], 12)[1].shape == (4, 4)
