import threading
import time

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gapr_core.geometry import distance_field, quadrics, sampling, visibility


def sphere(count=4000, radius=30.0):
    directions = sampling.fibonacci_directions(count)
    return directions * radius, directions


def test_thinning_keeps_at_most_the_number_asked_for_and_spreads_them():
    points = np.random.default_rng(0).uniform(0, 100, (20_000, 3))
    kept = points[sampling.thin(points, 1000)]
    assert 900 <= len(kept) <= 1000
    gaps = cKDTree(kept).query(kept, k=2)[0][:, 1]
    random = points[np.random.default_rng(1).choice(20_000, 1000, replace=False)]
    assert np.quantile(gaps, 0.05) > 1.5 * np.quantile(cKDTree(random).query(random, k=2)[0][:, 1], 0.05)


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


def test_quadrics_find_normals_and_curvature_of_a_sphere():
    points, outward = sphere(4000, 30.0)
    neighbours = cKDTree(points).query(points, k=16)[1]
    noisy = quadrics.orient(quadrics.local_frames(points, neighbours).normals, outward)
    normals, shapes = quadrics.fit_quadrics(points, noisy, neighbours)
    assert np.einsum("ni,ni->n", normals, outward).min() > 0.9999
    assert np.trace(shapes, axis1=1, axis2=2) == pytest.approx(-2.0 / 30.0, rel=0.05)  # it falls away: convex
    assert np.abs(np.einsum("nij,nj->ni", shapes, normals)).max() < 1e-9


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


def test_the_field_gives_the_distance_to_the_surface_not_to_its_points():
    points, outward = sphere(2000, 30.0)
    field = distance_field.build(points, outward, spacing_mm=2.0, reach_mm=8.0)
    near = np.nonzero(field.distance < 250)
    centres = np.stack(near, axis=1) * field.cell_mm + field.origin
    true = np.abs(np.linalg.norm(centres, axis=1) - 30.0)
    assert np.abs(field.distance[near] * 8.0 / 255.0 - true).max() < 0.25
