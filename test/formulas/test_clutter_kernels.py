"""The refinement of clouds that are mostly something else, against the same mathematics written down a second time."""

import numpy as np
import pytest
import tiny

from gapr_core.geometry import se3
from gapr_core.registration.fit.block_kernels import accumulate
from gapr_core.registration.fit.kernels import residuals_at
from gapr_core.registration.scenes import kernels

SAME = 0.6


@pytest.fixture(scope="module")
def egg():
    return tiny.ellipsoid(count=500)


@pytest.fixture(scope="module")
def cloud(egg):
    """Points about the surface with the normals of the nearest elements."""
    rng = np.random.default_rng(0)
    points = tiny.on_ellipsoid(40) + rng.normal(0.0, 0.5, (40, 3))
    return points, egg.normals[egg.tree.query(points)[1]]


def both(*limits):
    """The same limits (I,) inside and outside of the surface."""
    return np.outer(limits, [1.0, 1.0])


def equations(T, points, normals, signed, egg, limit, same=SAME, front=None):
    trust, H, g = np.full(len(points), 7.0), np.full((6, 6), 7.0), np.full(6, 7.0)
    kernels.agreeing(T, points, normals, signed, *egg.kernel_view[:-1], same, trust)
    accumulate(T, points, trust, points.mean(axis=0), *egg.kernel_view, limit, 0.0, H, g, front or 0.0)
    return np.trace(H[:3, :3]), H, g


def expected(T, points, normals, signed, egg, limit, same=SAME, front=None):
    r, n, aside, q = residuals_at(T, points, *egg.kernel_view, 0.0)
    cosine = ((normals @ T[:3, :3].T) * egg.normals[q]).sum(axis=1)
    agrees = (cosine if signed else np.abs(cosine)) >= same
    square = (r**2 + aside**2) / np.where(r > 0.0, front or limit, limit) ** 2
    weight = np.where(agrees & (q >= 0) & (square < 1.0), (1.0 - square) ** 2, 0.0)
    arm = se3.apply(T, points) - se3.apply(T, points.mean(axis=0)[None])
    J = np.hstack([n, np.cross(arm, n)])
    return weight.sum(), (J * weight[:, None]).T @ J, -(J * weight[:, None]).T @ np.nan_to_num(r)


@pytest.mark.parametrize("signed", [True, False])
@pytest.mark.parametrize("limit", [0.6, 2.0])
def test_the_normal_equations_are_those_of_weighted_least_squares(egg, cloud, signed, limit):
    points, normals = cloud
    flipped = normals * np.where(np.arange(len(normals)) % 3 == 0, -1.0, 1.0)[:, None]
    T = se3.exp([0.3, -0.2, 0.4, 0.02, -0.03, 0.05])
    found, wanted = (of(T, points, flipped, signed, egg, limit) for of in (equations, expected))
    assert found[0] == pytest.approx(wanted[0]) and 0.0 < wanted[0] < len(points)
    assert found[1] == pytest.approx(wanted[1]) and found[2] == pytest.approx(wanted[2])


def test_outside_of_the_surface_a_limit_of_its_own_holds(egg, cloud):
    points, normals = cloud
    T = se3.exp([0.3, -0.2, 0.4, 0.02, -0.03, 0.05])
    found, wanted = (of(T, points, normals, True, egg, 2.0, front=0.7) for of in (equations, expected))
    assert found[0] == pytest.approx(wanted[0]) and 0.0 < wanted[0] < len(points)
    assert found[1] == pytest.approx(wanted[1]) and found[2] == pytest.approx(wanted[2])
    up = np.array([[0.0, 0.0, 1.0]])
    for height, weight in ((0.5, 0.0), (-0.5, 0.75**2), (0.3, 0.64**2), (-1.0, 0.0)):
        point = np.array([[0.0, 0.0, height]])
        assert equations(np.eye(4), point, up, True, tiny.plane(), 1.0, front=0.5)[0] == pytest.approx(weight)


@pytest.mark.parametrize(("cosine", "signed", "counts"), [
    (0.61, True, True), (0.59, True, False), (-0.61, True, False), (-1.0, True, False), (1.0, True, True),
    (0.61, False, True), (0.59, False, False), (-0.61, False, True), (-0.59, False, False), (-1.0, False, True),
])  # fmt: skip
def test_a_point_counts_where_its_normal_agrees(cosine, signed, counts):
    plane = tiny.plane()
    normal = np.array([[np.sqrt(1.0 - cosine**2), 0.0, cosine]])
    total = equations(np.eye(4), np.array([[0.3, 0.2, 0.5]]), normal, signed, plane, 1.0)[0]
    assert total == pytest.approx(0.75**2 if counts else 0.0)


def test_the_normal_equations_of_a_pose_that_is_turned_far(egg, cloud):
    """Every entry of the rotation counts, for the points and for their normals."""
    turn = se3.exp([5.0, -7.0, 3.0, 0.9, -1.3, 0.7])
    T = se3.exp([0.3, -0.2, 0.4, 0.02, -0.03, 0.05]) @ se3.inverse(turn)
    points = se3.apply(turn, cloud[0])
    rng = np.random.default_rng(3)
    normals = cloud[1] @ turn[:3, :3].T + rng.normal(0.0, 0.6, points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    for signed in (True, False):
        found, wanted = (of(T, points, normals, signed, egg, 2.0) for of in (equations, expected))
        assert found[0] == pytest.approx(wanted[0]) and 0.0 < wanted[0] < len(points)
        assert found[1] == pytest.approx(wanted[1]) and found[2] == pytest.approx(wanted[2])


def test_a_step_is_that_of_the_damped_equations_about_the_middle_of_the_points(egg, cloud):
    move = se3.exp([200.0, -90.0, 40.0, 0.0, 0.0, 0.0])
    points, normals = se3.apply(move, cloud[0]), cloud[1]
    T = se3.exp([0.3, -0.2, 0.4, 0.02, -0.03, 0.05]) @ se3.inverse(move)
    weight, H, g = expected(T, points, normals, True, egg, 2.0)
    damped = H + np.diag([1e-4 * weight] * 3 + list(1e-4 * np.diag(H)[3:] + 1.0))
    centre = se3.apply(T, points.mean(axis=0)[None])[0]
    wanted = se3.exp(np.linalg.solve(damped, g), centre) @ T
    found = kernels.refine_agreeing(T[None], points, normals, True, *egg.kernel_view, both(2.0), SAME)[0]
    np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-6)


def image_of_planes(rng, rows=9, columns=7, left=-0.3, top=-0.4, pixel=0.1):
    """(rows, columns, 6) planes that face the camera, their depth and the least depth around; some without."""
    normals = np.dstack([*rng.uniform(-0.4, 0.4, (2, rows, columns)), -np.ones((rows, columns))])
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    j, i = np.meshgrid(np.arange(columns), np.arange(rows))
    rays = np.dstack([left + pixel * j, top + pixel * i, np.ones((rows, columns))])
    depth = rng.uniform(80.0, 120.0, (rows, columns))
    offset = (normals * rays).sum(axis=2) * depth
    pixels = np.dstack([normals, offset, depth, depth - rng.uniform(0.0, 5.0, (rows, columns))])
    pixels[rng.random((rows, columns)) < 0.1] = 0.0
    return pixels, rays


def seen_by_hand(T, cloud, pixels, left, top, per_pixel, on, front, facing, hidden, slant, same):
    """Explained, violating, compared: one point after the other."""
    explained = violating = compared = 0.0
    for p, n in zip(se3.apply(T, cloud[:, :3]), cloud[:, 3:] @ T[:3, :3].T, strict=True):
        if p[2] < 1.0:
            continue
        j, i = np.floor((p[:2] / p[2] - [left, top]) * per_pixel + 0.5).astype(int)
        if not (0 <= i < pixels.shape[0] and 0 <= j < pixels.shape[1]) or pixels[i, j, 4] == 0.0:
            continue
        plane, offset, depth, least = pixels[i, j, :3], *pixels[i, j, 3:]
        violating += p[2] < least - front
        if n @ p > -facing * p[2]:
            continue
        compared += least - front < p[2] < depth + hidden
        off = plane @ p - offset
        if abs(off) < on and abs(p[2] - depth) < slant and n @ plane > same:
            explained += 1.0 - (off / on) ** 2
    return np.array([explained, violating, compared]) / len(cloud)


def test_what_an_image_says_of_a_target_is_what_each_line_of_sight_says():
    """Random planes and points about them, some hidden, in front, turned away, outside, behind, next to the camera."""
    rng = np.random.default_rng(5)
    pixels, rays = image_of_planes(rng)
    i, j = rng.integers(9, size=400), rng.integers(7, size=400)
    depth = pixels[i, j, 4] + rng.normal(0.0, 4.0, 400)
    depth[:40] = rng.choice([-60.0, 0.5, 50.0, 150.0], 40)
    points = (rays[i, j] + np.c_[rng.uniform(-0.04, 0.04, (400, 2)), np.zeros(400)]) * depth[:, None]
    points[40:60, :2] += rng.choice([-70.0, 70.0], (20, 2))
    normals = pixels[i, j, :3] + rng.normal(0.0, 0.35, (400, 3))
    normals *= rng.choice([1.0, 1.0, 1.0, -1.0], (400, 1)) / np.linalg.norm(normals, axis=1, keepdims=True)
    T = se3.exp([12.0, -30.0, 25.0, 0.9, -1.3, 0.7])
    back = se3.inverse(T)
    cloud = np.hstack([se3.apply(back, points), normals @ back[:3, :3].T])
    poses = np.array([T, se3.exp([1.0, -1.5, 2.0, 0.01, 0.02, 0.05]) @ T, se3.exp([0.0, 0.0, -6.0, 0.0, 0.1, 0.0]) @ T])
    view = -0.3, -0.4, 10.0, 3.0, 4.0, 0.2, 3.0, 5.0, 0.6
    small = [np.float32(x) for x in view]
    found = kernels.compare_with_image(
        poses[:, :3].astype(np.float32), cloud.astype(np.float32), pixels.astype(np.float32), *small
    )
    wanted = np.array([seen_by_hand(T, cloud, pixels, *view) for T in poses])
    assert found == pytest.approx(wanted, abs=2e-5)
    assert (wanted > 0.02).all() and (wanted < 0.9).all()


def test_normals_turn_with_the_pose():
    plane, T = tiny.plane(), se3.exp([0.0, 0.0, 0.0, 0.7, -1.2, 0.4])
    point = se3.apply(se3.inverse(T), np.array([[1.0, 2.0, 0.0]]))
    for axis in np.eye(3):
        total = equations(T, point, axis[None], False, plane, 1.0, same=0.2)[0]
        assert (total > 0.0) == (abs(T[:3, :3] @ axis)[2] > 0.2)


def test_a_point_at_the_limit_or_off_the_grid_does_not_count():
    plane, up = tiny.plane(), np.array([[0.0, 0.0, 1.0]])
    for height, counts in ((0.99, True), (1.0, False), (1.01, False), (-1.0, False), (500.0, False)):
        total = equations(np.eye(4), np.array([[0.0, 0.0, height]]), up, True, plane, 1.0)[0]
        assert (total > 0.0) == counts


def test_poses_come_home_and_what_lies_far_off_pulls_at_none(egg, cloud):
    points, normals = tiny.on_ellipsoid(40), None
    normals = egg.normals[egg.tree.query(points)[1]]
    far = np.concatenate([points, points[:10] + [0.0, 0.0, 60.0]])
    turned = np.concatenate([normals, normals[:10]])
    poses = np.array([np.eye(4), se3.exp([0.8, -0.6, 0.5, 0.03, 0.02, -0.04]), se3.exp([200.0, 0, 0, 0, 0, 0])])
    start = poses.copy()
    found = kernels.refine_agreeing(
        poses, far, turned, True, *egg.kernel_view, both(6.0, 4.0, 3.0, 2.0, 2.0, 2.0), SAME
    )
    assert np.array_equal(poses, start)
    for T in found[:2]:
        assert np.abs(se3.apply(T, points) - points).max() < 0.35
    assert np.array_equal(found[2], start[2])  # nothing pulls at it


def test_each_iteration_takes_its_own_limit(egg, cloud):
    points, normals = cloud
    start = se3.exp([2.5, -1.0, 0.5, 0.0, 0.02, 0.0])[None]

    def refined(pose, *limits):
        return kernels.refine_agreeing(pose, points, normals, True, *egg.kernel_view, both(*limits), SAME)

    in_turn = refined(refined(start, 5.0), 2.0)
    assert refined(start, 5.0, 2.0) == pytest.approx(in_turn)
    assert refined(start, 2.0, 5.0) != pytest.approx(in_turn, abs=1e-4)


def test_what_lies_in_front_pulls_less_than_the_bone_beside_it():
    """A plane of bone with tissue 1 mm in front of every third point: with closer limits there, the bone is found."""
    plane, up = tiny.plane(), np.array([0.0, 0.0, 1.0])
    points = np.random.default_rng(0).uniform(-4.0, 4.0, (90, 3)) * [1.0, 1.0, 0.0]
    points[::3, 2] = 1.0
    normals, limits = np.tile(up, (90, 1)), np.full(8, 2.0)

    def height(front_share):
        how = np.outer(limits, [1.0, front_share]), SAME
        return kernels.refine_agreeing(np.eye(4)[None], points, normals, True, *plane.kernel_view, *how)[0][2, 3]

    assert height(1.0) < -0.2 and abs(height(0.5)) < 0.01
