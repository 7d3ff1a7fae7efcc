"""Check points: distances, their covariance, the probability and what stays unseen, against draws and by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, norm
from tiny import ellipsoid, on_ellipsoid, plane

from gapr_core.config import CovarianceConfig, RegistrarConfig, SensorConfig
from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_core.geometry import se3
from gapr_core.geometry.twists import bound_mm, predicted_rmse_mm
from gapr_core.registration import check_points as module
from gapr_core.registration.check_points import check_points as check
from gapr_core.results import RegistrationResult, RegistrationStatus, Residuals, Verdict

EXACT = RegistrarConfig(
    sensor=SensorConfig(noise_mm=0.3, bias_mm=1e-3, scale=0.0, standoff_mm=0.0, known_standoff_mm=1e-3),
    covariance=CovarianceConfig(model_mm=0.0),
)
SMALL = np.diag([0.2**2] * 3 + [0.005**2] * 3)


def answer(T=None, covariance=SMALL, **more):
    pose, centre = np.eye(4) if T is None else T, np.array([3.0, 1.0, 2.0])
    return RegistrationResult(RegistrationStatus.OK, pose, covariance, 0.95, centre_mm=centre, **more)


def test_a_distance_is_positive_outside_less_the_stand_off_and_nan_where_no_surface_is_near():
    points = np.array([[0.0, 0.0, 1.2], [4.0, 2.0, -0.7], [0.0, 0.0, 60.0]])
    assert check(points, plane(), answer(), EXACT).distance_mm[:2] == pytest.approx([1.2, -0.7])
    stated = replace(EXACT, sensor=replace(EXACT.sensor, standoff_mm=0.5))
    found = check(points, plane(), answer(), stated)
    assert found.distance_mm[:2] == pytest.approx([0.7, -1.2]) and np.isnan(found.distance_mm[2])
    assert found.verdict is Verdict.CONTRADICTED and found.probability == 0.0
    assert "3 points, 1 with no surface near" in str(found)
    elsewhere = check(points + [0.0, 0.0, 400.0], plane(), answer(), stated)
    assert "none near the bone: are they in the frame and the unit of the source?" in str(elsewhere)


def test_off_the_edge_of_a_model_what_a_point_lies_beyond_it_counts():
    """An element of a plane of 2 mm spacing reaches 4 mm, the last one lies at 20 mm."""
    found = check([[26.0, 0.0, 0.5], [0.0, 0.0, 0.0]], plane(40.0), answer(), EXACT)
    assert found.distance_mm[0] == pytest.approx(np.hypot(2.0, 0.5))


def test_expected_distances_are_those_of_drawn_poses_and_errors():
    """Every error is there, with its square: of poses, noise, what all share, size, smooth bias and tracker."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6)) * np.array([0.3] * 3 + [0.01] * 3)[:, None]
    covariance, points = root @ root.T, on_ellipsoid(5, 3)
    target = ellipsoid(count=4000)
    sensor = SensorConfig(noise_mm=0.2, bias_mm=0.4, scale=0.02, standoff_mm=0.0, known_standoff_mm=0.3,
                          tracking_mm=0.3, tracking_deg=0.8)  # fmt: skip
    config = RegistrarConfig(sensor=sensor, covariance=CovarianceConfig(model_mm=0.25))
    result = answer(covariance=covariance, factor95=1.5)
    found = check(points, target, result, config)
    _, normals = module._distances(np.eye(4), points, target)
    n, away = 40_000, points - points.mean(axis=0)
    twists = 1.5 * rng.multivariate_normal(np.zeros(6), covariance, n)
    moves = twists[:, None, :3] + np.cross(twists[:, None, 3:], (points - result.centre_mm)[None])
    alike = np.exp(-0.5 * ((points[:, None] - points) ** 2).sum(axis=2) / 20.0**2)
    drawn = np.einsum("sni,ni->sn", moves, normals)
    drawn += rng.normal(size=(n, 5)) * 0.2 + rng.normal(size=(n, 1)) * 0.3 + rng.normal(size=(n, 1)) * 0.25
    drawn += rng.normal(size=(n, 1)) * 0.02 * (away * normals).sum(axis=1)
    shift, turn = rng.normal(size=(n, 1, 3)) * 0.3, rng.normal(size=(n, 1, 3)) * np.radians(0.8)
    drawn += np.einsum("sni,ni->sn", shift + np.cross(turn, away[None]), normals)
    drawn += 0.4 * rng.multivariate_normal(np.zeros(5), alike, n)
    assert found.expected_mm == pytest.approx(drawn.std(axis=0), rel=0.02)
    S = np.cov(drawn.T)
    d = found.distance_mm
    together = chi2.sf(d @ np.linalg.solve(S, d), 5)
    assert found.probability == pytest.approx(min(1.0, 2.0 * together), abs=0.02)


def test_what_near_points_alone_share_counts_for_each_of_them():
    """0.3 mm of a slice that the tracker puts elsewhere."""
    known = {"noise_mm": 0.4, "bias_mm": 0.1, "scale": 0.0, "standoff_mm": 0.0, "known_standoff_mm": 0.1}
    alone, sliced = (
        check(on_ellipsoid(5, 3), ellipsoid(count=4000), answer(), replace(EXACT, sensor=SensorConfig(kind, **known)))
        for kind in ("pointer", "ultrasound")
    )
    assert sliced.expected_mm**2 - alone.expected_mm**2 == pytest.approx(0.3**2)


def test_the_probability_is_even_under_a_right_pose_and_one_far_point_among_many_shows():
    rng = np.random.default_rng(1)
    S = np.diag(rng.uniform(0.1, 2.0, 8))
    values = [module._probability(rng.multivariate_normal(np.zeros(8), S), S) for _ in range(4000)]
    assert np.mean(np.array(values) < 0.05) == pytest.approx(0.04, abs=0.012)
    one = np.zeros(60)
    one[7] = 4.5
    assert chi2.sf(4.5**2, 60) > 0.9
    assert module._probability(one, np.eye(60)) == pytest.approx(2.0 * 60 * 2.0 * norm.sf(4.5))


def test_what_stays_unseen_is_the_bound_of_a_pose_of_which_only_these_points_are_known():
    """Points on a plane never notice a shift along it or a turn about its normal."""
    target = plane()
    flat = check([[-15.0, -15.0, 0.0], [15.0, -15.0, 0.0], [0.0, 15.0, 0.0], [9.0, 9.0, 0.0]], target, answer(), EXACT)
    assert flat.verdict is Verdict.SAYS_LITTLE and flat.probability > 0.9
    free = np.zeros((6, 6))
    free[[0, 1, 5], [0, 1, 5]] = [20.0**2, 20.0**2, np.radians(20.0) ** 2]
    assert flat.unseen_mm == pytest.approx(bound_mm(free, target.points, answer().centre_mm), rel=0.01)


def test_spread_points_show_every_error_and_together_with_the_registration_they_bound_it_more_tightly():
    target = ellipsoid(count=4000)
    result = answer()
    few, many = (check(on_ellipsoid(count, 5), target, result, EXACT) for count in (4, 40))
    registration_mm = bound_mm(SMALL, target.points, result.centre_mm)
    assert few.unseen_mm > 4.0 > many.unseen_mm
    assert registration_mm > few.tre95_mm > many.tre95_mm
    assert few.verdict is Verdict.SAYS_LITTLE and many.verdict is Verdict.HOLDS
    stricter = check(on_ellipsoid(40, 5), target, result, EXACT, within_mm=many.unseen_mm - 0.01)
    assert stricter.verdict is Verdict.SAYS_LITTLE


def test_information_adds_up():
    """C_alone^-1 = P^-1 + J^T J / s^2, and the registration's C^-1 in place of P^-1 for both together."""
    target, points, result = ellipsoid(count=4000), on_ellipsoid(6, 2), answer()
    _, normals = module._distances(np.eye(4), points, target)
    J = np.hstack([normals, np.cross(points - result.centre_mm, normals)])
    information = J.T @ J / 0.3**2
    loose = np.diag([1.0 / 400.0] * 3 + [1.0 / np.radians(20.0) ** 2] * 3)
    found = check(points, target, result, EXACT)
    together_mm = found.tre95_mm - found.shown_mm
    for bound, prior in ((found.unseen_mm, loose), (together_mm, np.linalg.inv(SMALL))):
        wanted = bound_mm(np.linalg.inv(prior + information), target.points, result.centre_mm)
        assert bound == pytest.approx(wanted, rel=1e-4)


def test_the_next_point_is_where_another_one_lowers_what_is_unseen_most():
    target, points, result = ellipsoid(count=300), on_ellipsoid(3, 8), answer()
    found = check(points, target, result, EXACT)
    _, normals = module._distances(np.eye(4), points, target)
    before = np.hstack([normals, np.cross(points - result.centre_mm, normals)])
    loose = np.diag([1.0 / 400.0] * 3 + [1.0 / np.radians(20.0) ** 2] * 3)

    def left_mm(place, normal):
        J = np.vstack([before, np.hstack([normal, np.cross(place - result.centre_mm, normal)])])
        covariance = np.linalg.inv(loose + J.T @ J / 0.3**2)
        return predicted_rmse_mm(covariance, target.points, result.centre_mm)

    left = [left_mm(*each) for each in zip(target.points, target.normals, strict=True)]
    best = int(np.argmin(left))
    assert found.next_point == pytest.approx(target.points[best])
    assert found.next_normal == pytest.approx(target.normals[best])


def test_a_pose_that_is_off_by_more_than_it_says_is_contradicted_and_only_then():
    target, points = ellipsoid(count=4000), on_ellipsoid(10, 4)
    shifted = se3.exp(np.array([2.0, 0.0, 0.0, 0.0, 0.0, 0.0]), np.zeros(3))
    assert check(points, target, answer(shifted), EXACT).verdict is Verdict.CONTRADICTED
    assert check(points, target, answer(shifted, 400.0 * SMALL), EXACT).verdict is not Verdict.CONTRADICTED
    assert check(points, target, answer(), EXACT).verdict is not Verdict.CONTRADICTED


def test_the_error_that_is_shown_is_the_likeliest_one():
    """That e which makes e^T C^-1 e + (d - J e)^T R^-1 (d - J e) least, as a root mean square over the bone."""
    target, points = ellipsoid(count=4000), on_ellipsoid(7, 4)
    covariance = np.diag([3.0**2, 2.0**2, 1.0, 0.02**2, 0.03**2, 0.04**2])
    result = answer(se3.exp(np.array([2.5, -1.0, 0.5, 0.01, 0.03, -0.02]), np.zeros(3)), covariance, factor95=1.2)
    found = check(points, target, result, EXACT, within_mm=9.0)
    moved = result.apply(points)
    d, normals = module._distances(result.T_target_source, points, target)
    J = np.hstack([normals, np.cross(moved - result.centre_mm, normals)])
    rows = np.vstack([np.diag(1.0 / (1.2 * np.sqrt(np.diag(covariance)))), J / 0.3])
    likeliest = np.linalg.lstsq(rows, np.concatenate([np.zeros(6), d / 0.3]), rcond=None)[0]
    moves = likeliest[:3] + np.cross(likeliest[3:], target.points - result.centre_mm)
    assert found.shown_mm == pytest.approx(np.sqrt((moves**2).sum(axis=1).mean()), rel=1e-3)
    left = np.linalg.inv(rows.T @ rows)
    assert found.tre95_mm == pytest.approx(found.shown_mm + bound_mm(left, target.points, result.centre_mm), rel=1e-3)


@pytest.mark.parametrize(
    ("shown_mm", "open_mm", "verdict"),
    [(3.9, 4.0, "HOLDS"), (3.9, 4.1, "SAYS_LITTLE"), (4.1, 4.2, "CONTRADICTED"), (0.0, 9.0, "SAYS_LITTLE")],
)
def test_a_pose_that_is_shown_to_be_off_does_not_hold_however_vague_it_is(shown_mm, open_mm, verdict):
    assert module._verdict(1.0, shown_mm, open_mm, 4.0) is Verdict(verdict)
    assert module._verdict(0.009, shown_mm, open_mm, 4.0) is Verdict.CONTRADICTED


def test_a_vague_pose_is_contradicted_by_an_error_that_matters_alone():
    target, points = ellipsoid(count=4000), on_ellipsoid(40, 5)
    shifted = answer(se3.exp(np.array([3.0, 0.0, 0.0, 0.0, 0.0, 0.0]), np.zeros(3)), 400.0 * SMALL)
    found, right = (check(points, target, each, EXACT, 2.5) for each in (shifted, answer(covariance=400.0 * SMALL)))
    assert found.shown_mm == pytest.approx(3.0, abs=0.2) and found.probability > 0.01
    assert found.verdict is Verdict.CONTRADICTED and right.verdict is Verdict.HOLDS
    assert check(points, target, shifted, EXACT, 4.0).verdict is Verdict.HOLDS


@pytest.mark.parametrize(("known", "is_refused"), [(3, True), (2, False)])
def test_points_of_the_source_check_nothing(known, is_refused):
    """Of four points more than half are those that the pose was found with."""
    source, touched = on_ellipsoid(20, 1), on_ellipsoid(4, 9)
    touched[:known] = source[3 : 3 + known]
    used = Residuals(source, np.zeros(20), np.ones(20, dtype=bool))
    result = answer(residuals=used)
    if is_refused:
        with pytest.raises(InvalidPointCloudError, match="took no part in the registration; got 3 that did"):
            check(touched, ellipsoid(count=4000), result, EXACT)
    else:
        assert check(touched, ellipsoid(count=4000), result, EXACT).verdict is not Verdict.CONTRADICTED


@pytest.mark.parametrize(("how", "sensor", "more", "said"), [
    *[({}, EXACT, (mm,), "an error that matters, mm, above 0") for mm in (0.0, -1.0, np.nan, np.inf)],
    *[({"factor95": factor}, EXACT, (), "a factor95 above 0") for factor in (0.0, -1.0, np.nan, np.inf)],
    ({}, SensorConfig(), (), "a RegistrarConfig"),
])  # fmt: skip
def test_lengths_factors_and_settings_that_cannot_be_are_refused(how, sensor, more, said):
    with pytest.raises((ConfigError, InvalidPointCloudError), match=said):
        check(on_ellipsoid(4, 1), plane(), answer(**how), sensor, *more)


def test_points_are_taken_from_the_frame_of_the_source():
    T = se3.from_rotation_translation(se3.random_rotation(np.random.default_rng(2)), np.array([40.0, -10.0, 5.0]))
    points = on_ellipsoid(12, 6)
    found = check(se3.apply(np.linalg.inv(T), points), ellipsoid(count=4000), answer(T), EXACT)
    assert np.abs(found.distance_mm).max() < 0.1
    assert found.points == pytest.approx(se3.apply(np.linalg.inv(T), points))


def test_rows_that_are_not_finite_are_dropped_and_nothing_to_check_is_an_error():
    found = check([[0.0, 0.0, 0.1], [np.nan, 0.0, 0.0]], plane(), answer(), EXACT)
    assert len(found.points) == 1
    with pytest.raises(InvalidPointCloudError, match="check points; got none that is finite"):
        check([[np.nan] * 3], plane(), answer(), EXACT)


def test_more_points_than_are_touched_are_refused_before_the_work():
    points = np.zeros((module.MOST_POINTS + 1, 3))
    with pytest.raises(InvalidPointCloudError, match="at most 1000 check points; got 1001"):
        check(points, plane(), answer(), EXACT)
    assert len(check(points[:-1], plane(), answer(), EXACT).points) == module.MOST_POINTS


def test_a_covariance_that_is_none_is_an_error():
    with pytest.raises(InvalidPointCloudError, match="a positive definite covariance"):
        check([[0.0, 0.0, 0.0]], plane(), answer(covariance=np.zeros((6, 6))), EXACT)
    with pytest.raises(InvalidPointCloudError, match="a result; got NoneType"):
        check([[0.0, 0.0, 0.0]], plane(), None, EXACT)


def test_a_refusal_and_a_pose_without_covariance_cannot_be_checked():
    refused = RegistrationResult(RegistrationStatus.AMBIGUOUS)
    for result in (refused, answer(covariance=None)):
        with pytest.raises(InvalidPointCloudError, match="an accepted pose with its covariance; got"):
            check([[0.0, 0.0, 0.0]], plane(), result, EXACT)
