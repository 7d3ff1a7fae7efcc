"""What is known of a pose: its errors, its rivals, its residuals, and the two steps that change it."""

from dataclasses import replace

import numpy as np
import pytest
import tiny

from gapr_core.config import CovarianceConfig, RegistrarConfig, SensorConfig, SourceConfig
from gapr_core.geometry import se3
from gapr_core.registration.checks import assess, assessment
from gapr_core.registration.checks.assess import assess_fit, with_both_cortices
from gapr_core.registration.checks.assessment import shared_probability
from gapr_core.registration.confidence.classifier import Classifier, bone_probability
from gapr_core.registration.confidence.features import BONE
from gapr_core.registration.problem import source as sources
from gapr_core.registration.uncertainty import covariance
from gapr_core.registration.uncertainty.covariance import PoseUncertainty
from gapr_core.registration.uncertainty.error_calibration import Precision
from gapr_core.results import Effect, Finding, RegistrationStatus

T = se3.exp([1.0, 2.0, 0.0, 0.0, 0.0, 0.1])
CONFIG = RegistrarConfig(num_threads=1)
REFUSED = Finding("equal rival", Effect.REFUSE, 1.0, 1.1, RegistrationStatus.AMBIGUOUS, "another pose fits")
WIDENED = replace(REFUSED, check="strained", effect=Effect.WIDEN, status=RegistrationStatus.OK)


@pytest.fixture(scope="module")
def a():
    points = np.column_stack([np.random.default_rng(0).uniform(-12.0, 12.0, (60, 2)), np.full(60, 0.2)])
    return tiny.assessed(points, tiny.plane(size_mm=40.0, step_mm=4.0), T, scores=(1.0, 1.2, 1.5))


def known(a, shift_mm, turn_rad):
    covariance = np.diag([shift_mm**2] * 3 + [turn_rad**2] * 3)
    return replace(a, uncertainty=PoseUncertainty(covariance, 0.1, 0.2, 0.3))


def test_the_error_over_the_bone_is_the_root_of_the_mean_variance(a):
    assert known(a, 0.3, 0.0).tre_mm == pytest.approx(0.3 * np.sqrt(3.0))
    middle = se3.apply(T, a.source.points).mean(axis=0)
    arm = a.target.points - middle
    assert known(a, 0.3, 0.02).tre_mm == pytest.approx(np.sqrt(0.27 + 2.0 * 0.02**2 * (arm**2).sum(axis=1).mean()))
    assert a.centre_mm == pytest.approx(middle)


def test_the_bound_is_a_quantile_times_its_factor_and_counts_for_single_targets(a):
    drawn = np.linalg.norm(np.random.default_rng(0).normal(0.0, 0.3, (200_000, 3)), axis=1)
    shifts = known(a, 0.3, 0.0)
    assert shifts.tre95_mm == pytest.approx(np.quantile(drawn, 0.95), rel=0.01)
    assert replace(shifts, factor95=1.7).tre95_mm == pytest.approx(1.7 * shifts.tre95_mm)
    near, far = (known(a, 1e-4, 0.02).bound_mm(a.centre_mm + [[x, 0.0, 0.0]]) for x in (10.0, 30.0))
    assert far == pytest.approx(3.0 * near, rel=1e-3)


def test_the_confidence_is_that_of_the_right_pose_on_the_right_bone(a):
    assert a.confidence == pytest.approx(1.0 / (1.0 + np.exp(-3.0)))
    rare = replace(a, other_bone_prior=0.3, judgement=replace(a.judgement, bone_evidence=0.5))
    assert rare.confidence == pytest.approx(a.confidence * bone_probability(0.5, 0.3))


def test_hypotheses_begin_with_the_refined_pose_and_share_the_confidence(a):
    found = a.hypotheses
    assert np.array_equal(found[0].T_target_source, T)
    assert np.array_equal(found[1].T_target_source, a.candidates.poses[1]) and len(found) == 3
    assert [h.probability for h in found] == list(shared_probability(a.confidence, a.candidates.scores))


@pytest.mark.parametrize(
    ("best", "scores", "n", "expected"),
    [
        (0.6, [1.0, 1.0], 30.0, [0.6, 0.4]),  # as good: all that is left
        (0.3, [1.0, 1.0], 30.0, [0.3, 0.3]),  # but never more than the best
        (0.6, [2.0, 2.2], 0.0, [0.6, 0.4]),
        (0.2, [2.0, 3.0], 4.0, [0.2, 0.2 * np.exp(-1.0)]),
        (0.9, [1.0, 1.2, 1.5], 10.0, [0.9, 0.1 / (1 + np.exp(-1.5)), 0.1 / (1 + np.exp(1.5))]),
        (0.5, [1.0, 0.5, 0.25], 9.0, [0.5, 0.25, 0.25]),  # smaller residuals than the best's count as the same
        (0.7, [1.0], 30.0, [0.7]),
        (1.0, [1.0, 1.0], 30.0, [1.0, 0.0]),
    ],
)
def test_a_rival_gets_its_likelihood_of_what_is_left(monkeypatch, best, scores, n, expected):
    monkeypatch.setattr(assessment, "INDEPENDENT_POINTS", n)
    assert shared_probability(best, np.array(scores)) == pytest.approx(expected, abs=1e-12)


def test_residuals_are_those_of_all_points_that_the_pose_rests_on(a):
    for found in (a.residuals, part_of(a).residuals):
        assert np.array_equal(found.points, a.source.points)
        assert np.array_equal(found.distance_mm, a.fit.signed_mm, equal_nan=True)
        assert np.array_equal(found.inlier, a.fit.weights > 0.0)


def part_of(a):
    """The same, of which ten points are fitted."""
    source = sources.prepare(a.source.whole, SourceConfig(fitted_points=100))
    fit = replace(a.fit, signed_mm=np.full(10, 9.0), weights=np.zeros(10), whole=a.fit)
    return replace(a, source=replace(source, points=source.points[:10]), fit=fit)


def test_residuals_of_a_scene_are_plain_distances_of_the_whole_cloud_and_inliers_those_of_the_part():
    """What noise adds on a curved surface is not taken off: the fit's own residuals hold that."""
    egg, above = tiny.ellipsoid(), np.tile([0.3, -0.2, 0.0, 0.4], 15)
    on_bone = egg.points[::6][:60] + above[:, None] * egg.normals[::6][:60]
    cloud = se3.apply(se3.inverse(T), np.vstack([on_bone, [[0.0, 0.0, 200.0]]]))
    whole = tiny.assessed(cloud, egg, T).source
    members = np.arange(61) % 3 > 0
    of_part = tiny.assessed(whole.points[members], egg, T)
    found = replace(of_part, seen=whole, members=members).residuals
    assert found.points is whole.points and np.isnan(found.distance_mm[whole.points[:, 2] > 100.0]).all()
    assert np.sort(found.distance_mm)[:60] == pytest.approx(np.sort(above), abs=1e-6)
    assert np.array_equal(np.flatnonzero(found.inlier), np.flatnonzero(members)[of_part.fit.counts])


def test_a_pose_reaches_a_limit_unless_a_finding_refuses_it(a):
    assert a.reaches(a.confidence) and not a.reaches(np.nextafter(a.confidence, 1.0))
    wider = a.with_finding(WIDENED, np.diag([1.0, 4.0, 9.0, 0.0, 0.0, 0.0]))
    assert wider.refusal is None and wider.reaches(0.9)
    added = wider.uncertainty.covariance - a.uncertainty.covariance
    np.testing.assert_allclose(added, np.diag([1.0, 4.0, 9.0, 0.0, 0.0, 0.0]), atol=1e-12)
    refused = wider.with_finding(REFUSED).with_finding(replace(REFUSED, check="mirror image"))
    assert refused.refusal is REFUSED and not refused.reaches(0.0)
    assert [each.check for each in refused.findings] == ["strained", "equal rival", "mirror image"]


def test_what_was_learned_scales_standard_deviations_and_the_bound(a):
    class Learned(Precision):
        def scale(self, features, tre_mm):
            assert features is a.features and tre_mm == a.tre_mm
            return 1.5

    at = (a.confidence - 0.1, a.confidence + 0.1)
    found = a.corrected(Learned(None, at, (1.4, 1.0), {}))
    assert found.tre_mm == pytest.approx(1.5 * a.tre_mm) and found.factor95 == pytest.approx(1.2)
    assert found.uncertainty.covariance == pytest.approx(2.25 * a.uncertainty.covariance)
    assert found.tre95_mm == pytest.approx(1.2 * 1.5 * a.tre95_mm)
    assert a.corrected(Precision.unscaled()).tre95_mm == pytest.approx(a.tre95_mm)


def test_a_fit_is_assessed_by_its_covariance_and_features(a):
    config, classifier = replace(CONFIG, sensor=SensorConfig("ultrasound"), other_bone_prior=0.2), Classifier.load()
    config = replace(config, covariance=CovarianceConfig(model_mm=2.0))
    found = assess_fit(a.fit, a.candidates, a.source, a.target, classifier, config)
    expected = covariance.estimate(a.fit, config.covariance, config.sensor, a.source.around)
    np.testing.assert_array_equal(found.uncertainty.covariance, expected.covariance)
    assert found.judgement == classifier.judge(BONE, found.features) and found.other_bone_prior == 0.2
    assert found.refusal.check == "unobserved turn" and found.refusal.status is RegistrationStatus.DEGENERATE


@pytest.mark.parametrize(("both_mm", "own_mm", "flatness_mm", "follows"), [
    (0.40, 0.5, 0.3, True), (0.42, 0.5, 0.3, False), (0.40, 0.5, 0.26, False), (0.22, 0.5, 0.1, True),
    (0.23, 0.5, 0.1, False),
])  # fmt: skip
def test_a_source_follows_both_cortices_where_they_leave_nothing_but_its_noise(
    a, monkeypatch, both_mm, own_mm, flatness_mm, follows
):
    """Less than .82 of the residuals of the outer one, and 1.5 of the noise, which is .15 mm at least."""
    assert with_both_cortices(a, CONFIG) is None, "a bone of one surface"
    hollow = replace(a.target, both_cortices=replace(a.target))
    source = replace(a.source, flatness_mm=np.full(len(a.source.points), flatness_mm))
    left_mm = {id(hollow): own_mm, id(hollow.both_cortices): both_mm}
    monkeypatch.setattr(assess, "evaluate", lambda *on: replace(a.fit, sigma_mm=left_mm[id(on[2])]))
    seen = replace(a, target=hollow, source=source, fit=replace(a.fit, sigma_mm=own_mm))
    assert with_both_cortices(seen, CONFIG) is (hollow.both_cortices if follows else None)
