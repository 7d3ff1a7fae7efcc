"""What an answer says, from a fit, rivals and a covariance made by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
from scipy.special import logit

from gapr_core.config import RegistrarConfig, RulesConfig
from gapr_core.geometry import se3
from gapr_core.registration.checks import assessment as assessments
from gapr_core.registration.checks.assessment import Assessment, answer, judge, shared_probability
from gapr_core.registration.confidence.additive import Additive, Curve
from gapr_core.registration.confidence.classifier import Calibration
from gapr_core.registration.fit.refinement import Fit
from gapr_core.registration.fit.verification import Candidates
from gapr_core.registration.uncertainty.covariance import PoseUncertainty
from gapr_core.registration.uncertainty.error_calibration import Precision
from gapr_core.results import Refusal, RegistrationStatus

POINTS = np.array([[10.0, 0.0, 0.5], [-10.0, 0.0, 0.2], [0.0, 10.0, -0.1], [0.0, -10.0, 0.4]])
T = se3.exp([1.0, 2.0, 0.0, 0.0, 0.0, 0.1])
REFUSED = Refusal(RegistrationStatus.AMBIGUOUS, "another pose fits")
AXIS = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def plane():
    return tiny.plane(size_mm=40.0, step_mm=4.0)


def uncertainty(shift_mm=0.3, turn_rad=0.0):
    covariance = np.diag([shift_mm**2] * 3 + [turn_rad**2] * 3)
    return PoseUncertainty(covariance, 0.1, 0.2, 0.3)


def made(plane, probability=0.9, refusal=None, known=None, scores=(1.0, 1.2), **more):
    moved = se3.apply(T, POINTS)
    signed = np.array([0.5, 0.2, -0.1, np.nan])
    weights = np.array([0.9, 0.5, 0.0, 0.0])
    fit = Fit(T, 0.5, signed, weights, np.tile(AXIS, (4, 1)), np.zeros(4, dtype=int), moved)
    poses = np.array([np.eye(4), *(se3.exp([30.0 * k, 0, 0, 0, 0, 0]) for k in range(1, len(scores)))])
    candidates = Candidates(poses, np.array(scores), np.ones(len(scores)))
    source = SimpleNamespace(points=POINTS, around=np.arange(4)[:, None])
    features = {"inlier_ratio": 0.25, "margin": 0.5, "scale_z": 0.0}
    return Assessment(fit, candidates, known or uncertainty(), features, probability, refusal, source, plane, **more)


def test_the_error_over_the_bone_is_the_root_of_the_mean_variance(plane):
    only_shifts = made(plane)
    assert only_shifts.tre_mm == pytest.approx(0.3 * np.sqrt(3.0))
    arm = plane.points - se3.apply(T, POINTS).mean(axis=0)
    turns = made(plane, known=uncertainty(0.3, 0.02))
    assert turns.tre_mm == pytest.approx(np.sqrt(0.27 + 2.0 * 0.02**2 * (arm**2).sum(axis=1).mean()))
    assert turns.centre_mm == pytest.approx(se3.apply(T, POINTS).mean(axis=0))


def test_the_bound_is_a_quantile_times_its_factor_and_counts_for_single_targets(plane):
    rng = np.random.default_rng(0)
    drawn = np.linalg.norm(rng.normal(0.0, 0.3, (200_000, 3)), axis=1)
    a = made(plane)
    assert a.tre95_mm == pytest.approx(np.quantile(drawn, 0.95), rel=0.01)
    assert replace(a, factor95=1.7).tre95_mm == pytest.approx(1.7 * a.tre95_mm)
    known = uncertainty(0.0001, 0.02)
    near, far = (made(plane, known=known).bound_mm(a.centre_mm + [[x, 0.0, 0.0]]) for x in (10.0, 30.0))
    assert far == pytest.approx(3.0 * near, rel=1e-3)


def test_hypotheses_begin_with_the_refined_pose_and_share_the_probability(plane):
    a = made(plane, scores=(1.0, 1.2, 1.5), independent_points=10.0)
    found = a.hypotheses
    assert np.array_equal(found[0].T_target_source, T)
    assert np.array_equal(found[1].T_target_source, a.candidates.poses[1]) and len(found) == 3
    assert [h.probability for h in found] == pytest.approx([0.9, 0.1 / (1 + np.exp(-1.5)), 0.1 / (1 + np.exp(1.5))])


@pytest.mark.parametrize(
    ("best", "scores", "n", "expected"),
    [
        (0.6, [1.0, 1.0], 30.0, [0.6, 0.4]),  # as good: all that is left
        (0.3, [1.0, 1.0], 30.0, [0.3, 0.3]),  # but never more than the best
        (0.6, [2.0, 2.2], 0.0, [0.6, 0.4]),
        (0.2, [2.0, 3.0], 4.0, [0.2, 0.2 * np.exp(-1.0)]),
        (0.5, [1.0, 0.5, 0.25], 9.0, [0.5, 0.25, 0.25]),  # smaller residuals than the best's count as the same
        (0.7, [1.0], 30.0, [0.7]),
        (0.7, [1.0, 1e6], 30.0, [0.7, 0.0]),
        (1.0, [1.0, 1.0], 30.0, [1.0, 0.0]),
    ],
)
def test_a_rival_gets_its_likelihood_of_what_is_left(best, scores, n, expected):
    assert shared_probability(best, np.array(scores), n) == pytest.approx(expected, abs=1e-12)


def test_residuals_are_those_of_the_source_with_its_inliers(plane):
    found = made(plane).residuals
    assert np.array_equal(found.points, POINTS)
    assert np.array_equal(found.distance_mm, [0.5, 0.2, -0.1, np.nan], equal_nan=True)
    assert found.inlier.tolist() == [True, True, False, False]


def test_residuals_of_a_source_of_which_some_points_are_fitted_are_those_of_all(plane):
    whole = made(plane)
    part = replace(whole.fit, signed_mm=np.array([9.0]), weights=np.zeros(1), whole=whole.fit)
    source = SimpleNamespace(points=POINTS[:1], whole=POINTS)
    found = replace(whole, fit=part, source=source).residuals
    assert np.array_equal(found.points, POINTS) and found.inlier.tolist() == [True, True, False, False]
    assert np.array_equal(found.distance_mm, [0.5, 0.2, -0.1, np.nan], equal_nan=True)


def test_residuals_of_a_scene_are_those_of_the_whole_cloud_and_inliers_those_of_the_part(plane):
    rng = np.random.default_rng(1)
    cloud = np.column_stack([rng.uniform(-8.0, 8.0, (6, 2)), [0.1, -0.3, 0.7, 1.5, 200.0, 0.2]])
    members = np.array([False, True, True, False, True, True])
    found = made(plane, seen=SimpleNamespace(points=cloud), members=members).residuals
    assert np.array_equal(found.points, cloud)
    assert found.distance_mm[[0, 1, 2, 3, 5]] == pytest.approx(cloud[[0, 1, 2, 3, 5], 2], abs=1e-6)
    assert np.isnan(found.distance_mm[4])
    assert found.inlier.tolist() == [False, True, True, False, False, False]


def test_residuals_of_a_scene_are_plain_distances_also_on_a_curved_bone():
    """What noise adds on a curved surface is not taken off: the fit's own residuals hold that."""
    egg, above = tiny.ellipsoid(), np.array([0.3, -0.2, 0.0, 0.4])
    cloud = se3.apply(se3.inverse(T), egg.points[::101] + above[:, None] * egg.normals[::101])
    found = made(egg, seen=SimpleNamespace(points=cloud), members=np.ones(4, dtype=bool)).residuals
    assert found.distance_mm == pytest.approx(above, abs=1e-6)


def test_an_answer_is_sure_from_its_limit_on_unless_a_rule_speaks_against_it(plane):
    assert made(plane, 0.9).reaches(0.9) and made(plane, 0.95).reaches(0.9) and not made(plane, 0.8999).reaches(0.9)
    assert not made(plane, 0.9, REFUSED).reaches(0.0)


def test_a_limit_lowers_a_probability_and_never_raises_it(plane):
    assert made(plane, 0.9).capped(0.85).probability == 0.85
    assert made(plane, 0.3).capped(0.85).probability == 0.3


def test_what_was_learned_scales_standard_deviations_and_the_bound(plane):
    a = made(plane)
    asked = []
    learned = SimpleNamespace(scale=lambda features, tre_mm: asked.append((features, tre_mm)) or 1.5, factor95=1.2)
    found = a.corrected(learned)
    assert asked == [(a.features, a.tre_mm)]
    assert found.tre_mm == pytest.approx(1.5 * a.tre_mm) and found.factor95 == 1.2
    assert found.uncertainty.covariance == pytest.approx(2.25 * a.uncertainty.covariance)
    assert found.tre95_mm == pytest.approx(1.2 * 1.5 * a.tre95_mm)
    assert a.corrected(Precision.unscaled()).tre95_mm == pytest.approx(a.tre95_mm)


@pytest.fixture
def rule(monkeypatch):
    """The safety rules, replaced: what they are asked and what they say."""
    found = SimpleNamespace(says=None, asked=[])
    monkeypatch.setattr(assessments.rules, "by_geometry", lambda *words: found.asked.append(words) or found.says)
    return found


def calibrated(probability):
    curve = Curve("margin", np.array([0.0, 1.0]), np.array([0.0, 2.0]))
    return Calibration("search", Additive(float(logit(probability)) - 1.0, (curve,)), {})


@pytest.mark.parametrize("says", [None, REFUSED])
def test_a_rule_that_refuses_limits_the_probability(plane, rule, says):
    rule.says, a = says, made(plane)
    config = RegistrarConfig(rules=RulesConfig(ruled_out=0.35, independent_points=7.0))
    found = judge(a.fit, a.candidates, a.uncertainty, a.features, a.source, plane, calibrated(0.8), config)
    assert found.probability == pytest.approx(0.8 if says is None else 0.35) and found.refusal is says
    assert found.contributions == {"margin": 1.0} and found.independent_points == 7.0
    assert (found.fit, found.source, found.target, found.features) == (a.fit, a.source, plane, a.features)
    assert rule.asked[0][3] == pytest.approx(0.8)  # the rules are asked about the probability before they limit it


def test_a_source_of_another_size_is_refused_where_no_other_rule_speaks(plane, rule):
    a, config = made(plane), RegistrarConfig()
    other = {**a.features, "scale_z": 3.5}
    found = judge(a.fit, a.candidates, a.uncertainty, other, a.source, plane, calibrated(0.8), config)
    assert "another size" in found.refusal.reason and found.probability == config.rules.ruled_out


def test_a_pose_that_a_rule_refuses_and_that_is_improbable_stays_improbable(plane, rule):
    rule.says, a = REFUSED, made(plane)
    found = judge(a.fit, a.candidates, a.uncertainty, a.features, a.source, plane, calibrated(0.1), RegistrarConfig())
    assert found.probability == pytest.approx(0.1)


def test_a_fit_is_assessed_by_its_covariance_and_features(plane, rule, monkeypatch):
    a, seen = made(plane), []
    monkeypatch.setattr(assessments.covariance, "estimate", lambda *words: seen.append(words) or a.uncertainty)
    monkeypatch.setattr(assessments, "measure", lambda *words: seen.append(words) or a.features)
    config = RegistrarConfig()
    found = assessments.assess_fit(a.fit, a.candidates, a.source, plane, calibrated(0.8), config)
    assert seen == [
        (a.fit, config.covariance, config.sensor, a.source.around),
        (a.fit, a.candidates, a.uncertainty, a.source, plane, config),
    ]
    assert found.uncertainty is a.uncertainty and found.probability == pytest.approx(0.8)


def test_an_answer_carries_the_pose_and_its_errors(plane):
    a = made(plane, proposer="search", rounds=2, contributions={"margin": 1.0})
    found = answer(a, RegistrarConfig(min_confidence=0.9))
    assert found.ok and found.confidence == 0.9 and np.array_equal(found.T_target_source, T)
    assert (found.tre_mm, found.tre95_mm) == (a.tre_mm, a.tre95_mm) and np.array_equal(found.centre_mm, a.centre_mm)
    assert np.array_equal(found.covariance, a.uncertainty.covariance)
    assert (found.proposer, found.rounds, found.inlier_ratio) == ("search", 2, 0.25)
    assert found.features == a.features and found.contributions == {"margin": 1.0}
    assert len(found.hypotheses) == 2 and len(found.residuals.points) == 4


@pytest.mark.parametrize(
    ("made_with", "config", "status"),
    [
        ({"refusal": REFUSED}, RegistrarConfig(min_confidence=0.0), RegistrationStatus.AMBIGUOUS),
        ({"probability": 0.49}, RegistrarConfig(), RegistrationStatus.LOW_CONFIDENCE),
        ({"factor95": 10.0}, RegistrarConfig(max_tre_mm=2.0), RegistrationStatus.IMPRECISE),
    ],
)
def test_a_refusal_has_a_reason_and_keeps_what_can_be_looked_at(plane, made_with, config, status):
    found = answer(made(plane, **made_with), config)
    assert found.status is status and found.reason and found.T_target_source is None and found.tre95_mm is None
    assert len(found.hypotheses) == 2 and found.residuals is not None and found.features


def test_the_rule_is_named_before_a_threshold(plane):
    found = answer(made(plane, 0.1, REFUSED), RegistrarConfig())
    assert found.status is RegistrationStatus.AMBIGUOUS and found.reason == "another pose fits"
