"""Twists, NEES and the Cramer-Rao bound against simulation."""

import tracemalloc

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from gapr_core.geometry import se3
from gapr_core.geometry.twists import covariance_about, error_twist, motion_jacobians, nees
from gapr_core.metrics import bootstrap, cramer_rao
from gapr_core.metrics.bootstrap import interval, share_interval


def random_pose(rng):
    return se3.from_rotation_translation(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-100, 100, 3))


def random_covariance(rng):
    root = rng.normal(size=(6, 6)) * np.array([[0.5]] * 3 + [[0.01]] * 3)
    return root @ root.T + np.diag([0.01] * 3 + [1e-6] * 3)


def ellipsoid(rng, count, axes=(120.0, 45.0, 25.0)):
    unit = rng.normal(size=(count, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    normals = unit / axes
    return unit * axes, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def test_the_error_twist_rebuilds_the_estimate_from_the_truth():
    rng = np.random.default_rng(0)
    source, true, estimate = rng.normal(size=(30, 3)) * 50, random_pose(rng), random_pose(rng)
    twist = error_twist(estimate, true, source)
    centre = se3.apply(true, source).mean(axis=0)
    assert np.allclose(se3.exp(twist, centre) @ true, estimate)


def test_nees_of_an_honest_covariance_is_chi_square_with_six_degrees():
    rng = np.random.default_rng(1)
    covariance = random_covariance(rng)
    errors = rng.multivariate_normal(np.zeros(6), covariance, size=4000)
    values = np.array([nees(error, covariance) for error in errors])
    assert values.mean() == pytest.approx(6.0, rel=0.03)
    assert np.mean(values < chi2.ppf(0.95, 6)) == pytest.approx(0.95, abs=0.01)
    assert np.mean([nees(2 * error, covariance) for error in errors]) == pytest.approx(24.0, rel=0.03)


def test_motion_jacobians_are_the_derivative_of_the_motion():
    rng = np.random.default_rng(2)
    points, centre, step = rng.normal(size=(5, 3)) * 40, rng.normal(size=3), 1e-6
    numeric = [(se3.apply(se3.exp(step * e, centre), points) - points) / step for e in np.eye(6)]
    assert np.allclose(motion_jacobians(points, centre), np.stack(numeric, axis=2), atol=1e-4)


def test_estimated_normals_give_nearly_the_bound_of_exact_ones():
    rng = np.random.default_rng(6)
    clean, normals = ellipsoid(rng, 6000)
    source = clean[:800] + rng.normal(0, 0.5, (800, 3))
    exact = cramer_rao.pose_bound(source, clean, np.eye(4), 0.5, normals)
    assert cramer_rao.pose_bound(source, clean, np.eye(4), 0.5).rmse_mm == pytest.approx(exact.rmse_mm, rel=0.1)


def test_the_bound_is_the_inverse_of_the_information_of_the_points_near_the_surface():
    """J^T J / sigma^2, rows n and (p - c) x n; c is the mean of all points, outliers among them."""
    rng = np.random.default_rng(11)
    clean, normals = ellipsoid(rng, 60)
    clean = clean + [100.0, -40.0, 20.0]
    moved = clean + np.where(np.arange(60) < 10, 9.0, 0.0)[:, None] * normals
    centre = moved.mean(axis=0)
    J = np.hstack([normals, np.cross(moved - centre, normals)])[10:]
    true = random_pose(rng)
    bound = cramer_rao.pose_bound(se3.apply(se3.inverse(true), moved), clean, true, 0.7, normals)
    np.testing.assert_allclose(bound.covariance, np.linalg.inv(J.T @ J / 0.49), rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(bound.centre, centre)
    moves = motion_jacobians(moved, centre)
    variances = [np.trace(M @ bound.covariance @ M.T) for M in moves]
    assert bound.rmse_mm == pytest.approx(np.sqrt(np.mean(variances)))


def test_points_count_up_to_four_sigma_and_half_a_millimetre_along_the_normal():
    clean, normals = ellipsoid(np.random.default_rng(12), 40)
    for off_mm, counts in ((8.4, True), (8.6, False), (-8.4, True), (-8.6, False)):
        bound = cramer_rao.pose_bound(clean + off_mm * normals, clean, np.eye(4), 2.0, normals)
        assert (bound is not None) is counts
    aside = np.cross(normals, np.roll(normals, 1, axis=1))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    few = slice(0, 8)  # so few that each is nearest to its own point
    found = cramer_rao.pose_bound((clean + 3.0 * aside)[few], clean[few], np.eye(4), 0.1, normals[few])
    assert found is not None


def test_six_points_may_have_a_bound():
    clean, normals = ellipsoid(np.random.default_rng(13), 6)
    assert cramer_rao.pose_bound(clean, clean, np.eye(4), 0.5, normals) is not None


def test_a_normal_is_the_least_axis_of_its_neighbours():
    rng = np.random.default_rng(14)
    turn = random_pose(rng)
    points = se3.apply(turn, np.c_[rng.uniform(-10.0, 10.0, (200, 2)), np.zeros(200)])
    found = cramer_rao.local_normals(points, points[:5])
    assert np.abs(found @ turn[:3, 2]) == pytest.approx(np.ones(5))


def test_a_sphere_or_no_noise_has_no_bound():
    rng = np.random.default_rng(8)
    sphere, normals = ellipsoid(rng, 500, (50.0, 50.0, 50.0))
    sphere -= sphere.mean(axis=0)
    ball = 50.0 * normals
    assert cramer_rao.pose_bound(ball, ball, np.eye(4), 1.0, normals) is None
    bone, bone_normals = ellipsoid(rng, 500)
    with np.errstate(all="raise"):
        assert cramer_rao.pose_bound(bone, bone, np.eye(4), 0.0, bone_normals) is None
    assert cramer_rao.pose_bound(bone[:5], bone, np.eye(4), 1.0, bone_normals) is None


def test_bootstrap_of_a_mean_has_the_width_of_the_normal_approximation():
    values = np.random.default_rng(9).normal(size=400)
    low, high = interval(values)
    assert high - low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.1)
    assert low < values.mean() < high and interval(values) == (low, high)


def test_an_interval_does_not_depend_on_how_many_resamples_are_drawn_at_once(monkeypatch):
    values = np.random.default_rng(11).normal(size=90)
    whole = interval(values, np.arange(90) % 7)
    monkeypatch.setattr(bootstrap, "DRAWN_AT_ONCE", 1000)
    assert interval(values, np.arange(90) % 7) == whole


def test_an_interval_of_many_values_needs_little_memory():
    """All resamples at once are 2000 x 20 000 labels, and as many values: 960 MB."""
    tracemalloc.start()
    interval(np.arange(20_000) % 3)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 200e6


@pytest.mark.parametrize(("hits", "people", "ends"), [
    ([1], None, (0.2065, 1.0)),  # 1 / (1 + 1.96^2)
    ([1, 1, 1, 1], "aaaa", (0.2065, 1.0)),  # one subject, however many pairs
    ([1, 0, 1], "aaa", (0.0942, 0.9747)),  # (2 / 3 + 1.96^2 / 2 -+ 1.96 sqrt(2 / 9 + (1.96 / 2)^2)) / (1 + 1.96^2)
    ([0] * 20, None, (0.0, 0.1611)),  # 1.96^2 / (20 + 1.96^2)
    ([1, 0] * 5, "aabbccddee", (0.1704, 0.8296)),  # subjects that agree: a half of 5
    ([0, 1], None, (0.0, 1.0)),  # means of 0, 1/2, 1/2 and 1, equally often
    ([], None, (np.nan, np.nan)),
])  # fmt: skip
def test_a_share_on_which_all_subjects_agree_has_wilsons_interval(hits, people, ends):
    names = None if people is None else list(people)
    assert share_interval(hits, names) == pytest.approx(ends, abs=1e-4, nan_ok=True)
    agree = ends[0] > 0.0 or len(hits) != 2
    assert np.isnan(interval(hits, names)).all() == agree, "a mean of values that agree has none"


def test_pairs_of_one_person_do_not_count_as_independent():
    rng = np.random.default_rng(10)
    values = np.repeat(rng.normal(size=20), 30)
    people = np.repeat([f"person {k}" for k in range(20)], 30)
    alone, together = interval(values), interval(values, people)
    assert together[1] - together[0] > 4 * (alone[1] - alone[0])
    assert np.isnan(interval([])[0])


def test_a_covariance_about_another_centre_predicts_the_same_errors_of_points():
    rng = np.random.default_rng(5)
    root, centre, offset = rng.normal(size=(6, 6)), rng.normal(size=3) * 20.0, np.array([7.0, -11.0, 13.0])
    covariance, points = root @ root.T * np.diag([1.0] * 3 + [1e-2] * 3), rng.normal(size=(40, 3)) * 50.0
    covariance = 0.5 * (covariance + covariance.T)
    moved = covariance_about(offset, covariance)
    for point in points:
        one, other = (motion_jacobians(point[None], at)[0] for at in (centre, centre + offset))
        np.testing.assert_allclose(one @ covariance @ one.T, other @ moved @ other.T, rtol=1e-9, atol=1e-9)
