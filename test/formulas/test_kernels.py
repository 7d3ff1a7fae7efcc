"""The compiled loops against the same mathematics written down a second time."""

import numpy as np
import pytest
import tiny
from scipy.spatial.transform import Rotation

from gapr_core.geometry import se3
from gapr_core.registration.fit import kernels, surface_kernels

RNG = np.random.default_rng(0)
T = se3.exp([1.0, -2.0, 0.5, 0.2, -0.1, 0.3])
FLAT = np.array([[1.0, 2.0, 3.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
RADIUS = 10.0


def sphere_element(direction, radius=RADIUS, variance=0.0):
    n = np.asarray(direction) / np.linalg.norm(direction)
    S = -(np.eye(3) - np.outer(n, n)) / radius
    return np.r_[n * radius, n, S[0, 0], S[0, 1], S[0, 2], S[1, 1], S[1, 2], S[2, 2], variance][None]


def test_a_point_moves_as_the_matrix_says():
    for p in RNG.normal(size=(5, 3)) * 30.0:
        assert kernels.moved(T, p) == pytest.approx(se3.apply(T, p[None])[0])


def test_the_element_near_a_place_is_that_of_the_nearest_cell_centre():
    nearest = np.arange(3 * 4 * 5).reshape(3, 4, 5)
    origin, cell = np.array([10.0, -20.0, 30.0]), 2.0
    for i, j, k in np.ndindex(3, 4, 5):
        for off in (-0.99, 0.0, 0.98):
            x, y, z = origin + cell * np.array([i, j, k]) + off
            assert kernels.element_near(x, y, z, nearest, origin, 1.0 / cell) == nearest[i, j, k]
    for axis in range(3):
        for end in (-2, -1, nearest.shape[axis], nearest.shape[axis] + 1):
            cell_of = np.array([1.0, 1.0, 1.0])
            cell_of[axis] = end
            assert kernels.element_near(*(origin + cell * cell_of), nearest, origin, 1.0 / cell) == -1


def test_over_a_plane_the_residual_is_the_height():
    for x, y, z in RNG.uniform(-1.0, 1.0, (5, 3)):
        r, nx, ny, nz, aside = kernels.residual(1.0 + x, 2.0 + y, 3.0 + z, 0, FLAT, 5.0, 0.0)
        assert (r, nx, ny, nz, aside) == pytest.approx((z, 0.0, 0.0, 1.0, 0.0))


def test_what_lies_outside_the_disc_of_an_element_is_aside_by_the_rest():
    spacing = 1.5
    *_, aside = kernels.residual(1.0 + 6.0, 2.0 + 8.0, 3.0, 0, FLAT, spacing, 0.0)
    assert aside == pytest.approx(10.0 - surface_kernels.ELEMENT_RADIUS * spacing)
    *_, within = kernels.residual(1.0 + 1.2, 2.0 + 1.6, 3.0, 0, FLAT, spacing, 0.0)
    assert within == 0.0


def test_near_a_sphere_the_residual_is_the_distance_and_its_gradient_points_away_from_the_centre():
    for _ in range(20):
        n = RNG.normal(size=3)
        element = sphere_element(n)
        place = element[0, :3] + RNG.normal(size=3) * 0.6
        r, *gradient, _ = kernels.residual(*place, 0, element, 5.0, 0.0)
        assert r == pytest.approx(np.linalg.norm(place) - RADIUS, abs=6e-3)
        assert gradient == pytest.approx(place / np.linalg.norm(place), abs=1e-2)
        assert np.linalg.norm(gradient) == pytest.approx(1.0)


def test_every_entry_of_the_second_fundamental_form_counts():
    """A general form against height - t^T S t / 2 over |n - S t|."""
    for _ in range(10):
        n = RNG.normal(size=3)
        n /= np.linalg.norm(n)
        P = np.eye(3) - np.outer(n, n)
        S = RNG.normal(size=(3, 3)) * 0.1
        S = P @ (S + S.T) @ P
        p, place = RNG.normal(size=3), RNG.normal(size=3)
        element = np.r_[p, n, S[0, 0], S[0, 1], S[0, 2], S[1, 1], S[1, 2], S[2, 2], 0.0][None]
        d = place - p
        t = d - (d @ n) * n
        tilted = n - S @ t
        expected = (d @ n - 0.5 * t @ S @ t) / np.linalg.norm(tilted)
        r, *gradient, _ = kernels.residual(*place, 0, element, 100.0, 0.0)
        assert r == pytest.approx(expected)
        assert gradient == pytest.approx(tilted / np.linalg.norm(tilted))


def test_beyond_its_disc_an_element_is_not_extrapolated():
    element, spacing = sphere_element([0.0, 0.0, 1.0]), 1.0
    reach = surface_kernels.ELEMENT_RADIUS * spacing
    r, gx, gy, gz, _ = kernels.residual(6.0, 8.0, RADIUS, 0, element, spacing, 0.0)
    t = np.array([0.6, 0.8, 0.0]) * reach
    tilted = np.array([0.0, 0.0, 1.0]) + t / RADIUS
    assert r == pytest.approx(0.5 * reach**2 / RADIUS / np.linalg.norm(tilted))
    assert (gx, gy, gz) == pytest.approx(tilted / np.linalg.norm(tilted))


def test_the_offset_that_noise_causes_on_a_curved_surface_is_taken_away():
    """Isotropic noise of variance s^2 lifts the mean distance to a sphere by s^2 / R."""
    rng, s = np.random.default_rng(1), 0.8
    places = np.array([0.0, 0.0, RADIUS]) + rng.normal(0.0, s, (40_000, 3))
    assert (np.linalg.norm(places, axis=1) - RADIUS).mean() == pytest.approx(s**2 / RADIUS, abs=0.02)
    element = sphere_element([0.0, 0.0, 1.0])
    bare = kernels.residual(0.3, 0.2, RADIUS, 0, element, 5.0, 0.0)[0]
    assert kernels.residual(0.3, 0.2, RADIUS, 0, element, 5.0, s**2)[0] == pytest.approx(bare - s**2 / RADIUS)
    form = element.copy()
    form[0, 6:12] = [0.01, 0.0, 0.0, 0.02, 0.0, 0.04]
    with_form, without = (kernels.residual(0.0, 0.0, RADIUS, 0, form, 5.0, v)[0] for v in (s**2, 0.0))
    assert with_form - without == pytest.approx(0.5 * s**2 * 0.07)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_at_a_sharp_edge_that_offset_is_at_most_half_a_standard_deviation(sign):
    element = sphere_element([0.0, 0.0, 1.0], radius=0.01)
    element[0, 6:12] *= sign
    element[0, :3] = [0.0, 0.0, RADIUS]
    assert kernels.residual(0.0, 0.0, RADIUS, 0, element, 5.0, 4.0)[0] == pytest.approx(-sign * 1.0)


def view(target):
    return target.kernel_view


def expected_equations(T, points, trust, target, limit, variance):
    """H and g of weighted least squares on linearised residuals, one row a point."""
    moved = se3.apply(T, points)
    centre = se3.apply(T, points.mean(axis=0)[None])[0]
    H, g = np.zeros((6, 6)), np.zeros(6)
    for p, w0 in zip(moved, trust, strict=True):
        q = kernels.element_near(*p, target.field.nearest, target.field.origin, 1.0 / target.field.cell_mm)
        if q < 0:
            continue
        r, nx, ny, nz, aside = kernels.residual(*p, q, target.elements, target.spacing_mm, variance)
        square = (r**2 + aside**2) / limit**2
        if square >= 1.0:
            continue
        w = w0 * (1.0 - square) ** 2
        w *= variance / (variance + target.elements[q, 12]) if variance > 0.0 else 1.0
        J = np.r_[nx, ny, nz, np.cross(p - centre, [nx, ny, nz])]
        H += w * np.outer(J, J)
        g -= w * J * r
    return H, g


def squared_distance(T, point, *surface):
    return kernels.mean_square(T, point[None], np.ones(1), *surface)


@pytest.mark.parametrize("count", [60, 128, 300])  # less than a block, one, and more
@pytest.mark.parametrize(("variance", "element_variance"), [(0.0, 0.3), (0.5, 0.3), (0.5, 0.0)])
def test_the_normal_equations_are_those_of_weighted_least_squares(variance, element_variance, count):
    target = tiny.ellipsoid(variance=element_variance)
    points = tiny.on_ellipsoid(count) + RNG.normal(0.0, 1.0, (count, 3))
    points[:4] += 40.0  # far from everything
    trust, small = RNG.uniform(0.2, 1.0, count), se3.exp([0.5, -0.4, 0.3, 0.02, 0.03, -0.01])
    H, g = np.full((6, 6), 7.0), np.full(6, 7.0)
    middle = points.mean(axis=0)
    kernels.accumulate(small, points, trust, middle, *view(target), 2.5, variance, H, g)
    expected_H, expected_g = expected_equations(small, points, trust, target, 2.5, variance)
    assert np.allclose(H, expected_H) and np.allclose(g, expected_g)


def test_a_point_aside_of_the_surface_weighs_less_by_both_distances():
    """3 mm beyond the disc of the plane's first element, a corner: Tukey's weight of 0.1 and 3 mm."""
    plane, limit = tiny.plane(size_mm=40.0, step_mm=2.0), 5.0
    points, H, g = np.array([[-27.0, -20.0, 0.1]]), np.empty((6, 6)), np.empty(6)
    kernels.accumulate(np.eye(4), points, np.ones(1), points[0], *view(plane), limit, 0.0, H, g)
    weight = (1.0 - (0.1**2 + 3.0**2) / limit**2) ** 2
    assert np.diag(H) == pytest.approx([0.0, 0.0, weight, 0.0, 0.0, 0.0])
    assert g == pytest.approx([0.0, 0.0, -0.1 * weight, 0.0, 0.0, 0.0])


def test_a_motion_that_nothing_holds_is_damped():
    """1e-4 for every point along, 1 about an axis."""
    T, g = np.eye(4), np.array([0.002, 0.0, 0.0, 0.03, 0.0, 0.0])
    kernels.step(T, np.zeros(3), np.zeros((6, 6)), g, 50)
    assert g == pytest.approx([0.002 / (1e-4 * 50), 0.0, 0.0, 0.03, 0.0, 0.0])
    assert se3.apply(T, np.zeros((1, 3)))[0] == pytest.approx([0.4, 0.0, 0.0])


def test_a_score_is_truncated_at_the_last_limit():
    plane, far = tiny.plane(size_mm=40.0, step_mm=4.0), np.array([[0.0, 0.0, 500.0], [4.0, 0.0, 500.0]])
    limits = np.array([6.0, 5.0, 3.0])
    scores = kernels.refine_batch(np.eye(4)[None], far, np.ones(2), *view(plane), limits, 0.0 * limits)[1]
    assert scores == pytest.approx([9.0])


def test_a_residual_at_the_limit_weighs_nothing():
    target, H, g = tiny.plane(), np.empty((6, 6)), np.empty(6)
    for height, weighs in ((1.99, True), (2.0, False), (2.01, False)):
        point = np.array([[0.0, 0.0, height]])
        kernels.accumulate(np.eye(4), point, np.ones(1), point[0], *view(target), 2.0, 0.0, H, g)
        assert bool(H[2, 2] > 0.0) is weighs


@pytest.mark.parametrize("axis", range(6))
def test_a_step_solves_the_damped_equations_about_the_middle_of_the_source(axis):
    H, count, middle = np.diag([50.0, 60.0, 70.0, 800.0, 900.0, 1000.0]), 20, np.array([5.0, 6.0, 7.0])
    g = np.zeros(6)
    g[axis] = 10.0
    damped = np.diag(H) + np.r_[[1e-4 * count] * 3, 1e-4 * np.diag(H)[3:] + 1.0]
    start = T.copy()
    moved = start.copy()
    kernels.step(moved, middle, H.copy(), g.copy(), count)
    centre = se3.apply(start, middle[None])[0]
    assert np.allclose(moved, se3.exp(g / damped, centre) @ start, atol=1e-12)


def test_equations_are_solved_as_by_lapack():
    for n in (1, 3, 6):
        B = RNG.normal(size=(n, n))
        A, b = B @ B.T + 0.1 * np.eye(n), RNG.normal(size=n)
        x = b.copy()
        kernels.solve(np.tril(A) + np.triu(np.full((n, n), np.nan), 1), x)  # only the lower triangle is read
        assert x == pytest.approx(np.linalg.solve(A, b), rel=1e-9)


def test_a_step_never_turns_farther_than_the_limit():
    H, g = np.eye(6) * 1e3, np.array([0.0, 0.0, 0.0, 600.0, -700.0, 800.0])
    moved = np.eye(4)
    kernels.step(moved, np.zeros(3), H, g.copy(), 10)
    assert se3.rotation_angle_deg(moved) == pytest.approx(np.degrees(kernels.LARGEST_TURN_RAD))
    axis = Rotation.from_matrix(moved[:3, :3]).as_rotvec()
    assert axis / np.linalg.norm(axis) == pytest.approx(g[3:] / np.linalg.norm(g[3:]))


def test_rotations_follow_rodrigues():
    for vector in RNG.normal(size=(6, 3)):
        R = kernels.rotation(vector, float(np.linalg.norm(vector)))
        assert np.allclose(R, Rotation.from_rotvec(vector).as_matrix())
    assert np.array_equal(kernels.rotation(np.zeros(3), 0.0), np.eye(3))


def test_the_squared_distance_is_truncated_and_counts_what_lies_aside():
    target = tiny.plane(size_mm=8.0)
    surface = view(target)
    reach = surface_kernels.ELEMENT_RADIUS * target.spacing_mm
    assert squared_distance(np.eye(4), np.array([0.0, 0.0, 1.5]), *surface, 4.0) == pytest.approx(2.25)
    assert squared_distance(np.eye(4), np.array([0.0, 0.0, -5.0]), *surface, 4.0) == 16.0
    assert squared_distance(np.eye(4), np.array([90.0, 0.0, 0.0]), *surface, 4.0) == 16.0
    aside = squared_distance(np.eye(4), np.array([4.0 + reach + 1.0, 0.0, 2.0]), *surface, 4.0)
    assert aside == pytest.approx(1.0 + 4.0)
    egg = tiny.ellipsoid()
    above = egg.points[7] + 1.5 * egg.normals[7]  # also of a curved surface: nothing is taken off for noise
    assert squared_distance(np.eye(4), above, *view(egg), 4.0) == pytest.approx(2.25)


@pytest.mark.parametrize("count", [90, 300])
def test_poses_near_the_truth_are_brought_home_and_scored_by_their_mean_square(count):
    target, points = tiny.ellipsoid(count=600), tiny.on_ellipsoid(count)
    off = np.array([se3.exp([1.0, -0.8, 0.6, 0.05, -0.04, 0.06]), se3.exp([-0.5, 0.5, -0.5, -0.03, 0.02, 0.0])])
    limits = np.array([6.0, 5.0, 4.0, 4.0, 4.0])
    poses, scores = kernels.refine_batch(off, points, np.ones(count), *view(target), limits, np.zeros(5))
    unscored = kernels.refine_batch(off, points, np.ones(count), *view(target), limits, np.zeros(5), False)
    assert np.allclose(unscored[0], poses, atol=1e-12) and not unscored[1].any()
    for pose in poses:
        assert np.abs(se3.apply(pose, points) - points).max() < 0.25
    expected = [np.mean([squared_distance(T, p, *view(target), 4.0) for p in points]) for T in poses]
    assert scores == pytest.approx(expected)
    assert np.array_equal(off[0], se3.exp([1.0, -0.8, 0.6, 0.05, -0.04, 0.06]))  # what was given stays


def test_each_iteration_takes_its_own_limit_and_variance():
    target, points = tiny.ellipsoid(variance=0.4), tiny.on_ellipsoid(40)
    start = se3.exp([0.8, 0.0, 0.3, 0.0, 0.02, 0.0])
    trust = RNG.uniform(0.5, 1.0, 40)
    limits, variances = np.array([6.0, 2.0]), np.array([0.0, 0.5])
    done, _ = kernels.refine_batch(start[None], points, trust, *view(target), limits, variances)
    by_hand, H, g = start.copy(), np.empty((6, 6)), np.empty(6)
    for limit, variance in zip(limits, variances, strict=True):
        kernels.accumulate(by_hand, points, trust, points.mean(axis=0), *view(target), limit, variance, H, g)
        kernels.step(by_hand, points.mean(axis=0), H, g, 40)
    assert np.allclose(done[0], by_hand, atol=1e-12)


def test_residuals_at_a_pose_are_those_of_each_point():
    target, points = tiny.ellipsoid(), np.vstack([tiny.on_ellipsoid(20) + 0.5, [[90.0, 0.0, 0.0]]])
    signed, gradient, aside, element = kernels.residuals_at(np.eye(4), points, *view(target), 0.3)
    for i, p in enumerate(points[:20]):
        r, nx, ny, nz, a = kernels.residual(*p, element[i], target.elements, target.spacing_mm, 0.3)
        assert (signed[i], aside[i]) == (r, a) and tuple(gradient[i]) == (nx, ny, nz)
    assert np.isnan(signed[20]) and element[20] == -1 and aside[20] == 0.0 and not gradient[20].any()


def test_distinct_poses_are_farther_apart_than_the_tolerance_in_the_root_mean_square():
    places = np.zeros((5, 4, 3))
    for k, shift in enumerate([0.0, 1.0, 3.0, 3.5, 9.0]):
        places[k, :, 0] = shift
    places[1, :, 1] = 0.5
    order = np.array([2, 0, 3, 1, 4])
    assert kernels.distinct(places, order, 2.0, 5).tolist() == [2, 0, 4]
    assert kernels.distinct(places, order, 2.0, 2).tolist() == [2, 0]
    assert kernels.distinct(places, order, 0.4, 5).tolist() == [2, 0, 3, 1, 4]
    places[1, :, 1] = 0.0
    assert kernels.distinct(places[[0, 1]], np.array([0, 1]), 1.0, 5).tolist() == [0, 1]  # at the limit
    for axis in range(3):
        apart = np.zeros((2, 4, 3))
        apart[1, :, axis] = 3.0
        assert kernels.distinct(apart, np.array([0, 1]), 2.0, 5).tolist() == [0, 1]


@pytest.mark.parametrize("spacing", [0.5, 5.0])  # beyond the element's reach, and within
def test_a_turn_of_element_and_point_together_changes_no_residual(spacing):
    for seed in range(5):
        R = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
        place = np.array([4.0, -3.0, RADIUS + 0.5])
        before, after = sphere_element([0.0, 0.0, 1.0]), sphere_element(R[:, 2])
        wanted, turned = (kernels.residual(*p, 0, e, spacing, 0.04) for p, e in ((place, before), (R @ place, after)))
        assert turned[0] == pytest.approx(wanted[0]) and turned[4] == pytest.approx(wanted[4])
        assert turned[1:4] == pytest.approx(R @ wanted[1:4])
