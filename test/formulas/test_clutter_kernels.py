"""The refinement of clouds that are mostly something else, against the same mathematics written down a second time."""

import numpy as np
import pytest
import tiny

from gapr_core.geometry import se3
from gapr_core.registration import clutter_kernels as kernels
from gapr_core.registration.kernels import residuals_at

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


def equations(T, points, normals, signed, egg, limit, same=SAME):
    middle, H, g = points.mean(axis=0), np.full((6, 6), 7.0), np.full(6, 7.0)
    total = kernels.accumulate_agreeing(T, points, normals, signed, *egg.kernel_view, limit, same, middle, H, g)
    return total, H, g


def expected(T, points, normals, signed, egg, limit, same=SAME):
    r, n, aside, q = residuals_at(T, points, *egg.kernel_view, 0.0)
    cosine = ((normals @ T[:3, :3].T) * egg.normals[q]).sum(axis=1)
    agrees = (cosine if signed else np.abs(cosine)) >= same
    square = (r**2 + aside**2) / limit**2
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


@pytest.mark.parametrize(("cosine", "signed", "counts"), [
    (0.61, True, True), (0.59, True, False), (-0.61, True, False), (-1.0, True, False), (1.0, True, True),
    (0.61, False, True), (0.59, False, False), (-0.61, False, True), (-0.59, False, False), (-1.0, False, True),
])  # fmt: skip
def test_a_point_counts_where_its_normal_agrees(cosine, signed, counts):
    plane = tiny.plane()
    normal = np.array([[np.sqrt(1.0 - cosine**2), 0.0, cosine]])
    total = equations(np.eye(4), np.array([[0.3, 0.2, 0.5]]), normal, signed, plane, 1.0)[0]
    assert total == pytest.approx(0.75**2 if counts else 0.0)


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
        poses, far, turned, True, *egg.kernel_view, np.array([6.0, 4.0, 3.0, 2.0, 2.0, 2.0]), SAME
    )
    assert np.array_equal(poses, start)
    for T in found[:2]:
        assert np.abs(se3.apply(T, points) - points).max() < 0.35
    assert np.array_equal(found[2], start[2])  # nothing pulls at it


def test_each_iteration_takes_its_own_limit(egg, cloud):
    points, normals = cloud
    start = se3.exp([2.5, -1.0, 0.5, 0.0, 0.02, 0.0])[None]

    def refined(pose, *limits):
        return kernels.refine_agreeing(pose, points, normals, True, *egg.kernel_view, np.array(limits), SAME)

    in_turn = refined(refined(start, 5.0), 2.0)
    assert refined(start, 5.0, 2.0) == pytest.approx(in_turn)
    assert refined(start, 2.0, 5.0) != pytest.approx(in_turn, abs=1e-4)
