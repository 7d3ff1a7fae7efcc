"""Every safety rule refuses alone, at its limit, and says what it saw."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.linalg
import tiny

from gapr_core.config import RegistrarConfig, SourceConfig, VerificationConfig
from gapr_core.geometry import se3
from gapr_core.registration.checks import feature_labels as words
from gapr_core.registration.checks import limits, rules
from gapr_core.registration.checks.assessment import shared_probability
from gapr_core.registration.confidence.features import FEATURES, SCENE_FEATURES, STREAM_FEATURES
from gapr_core.registration.fit import mirror, refinement
from gapr_core.registration.fit.verification import Candidates
from gapr_core.registration.problem import source as sources
from gapr_core.registration.uncertainty.covariance import PoseUncertainty
from gapr_core.results import RegistrationStatus

CONFIG = RegistrarConfig(num_threads=1)
PUSHED = replace(
    CONFIG, verification=VerificationConfig(middle_points=60, final_limits_mm=(5.0, 4.0, 5), same_pose_mm=2.0)
)


def uncertainty(shift_mm=0.1, turn_deg=0.1):
    covariance = np.diag([shift_mm**2, 1e-4, 1e-4, 1e-8, 1e-8, np.radians(turn_deg) ** 2])
    return PoseUncertainty(covariance, 0.1, 0.1, 0.1)


def candidates(*scores, shift=30.0):
    poses = [se3.exp([shift * i, 0.0, 0.0, 0.0, 0.0, 0.0]) for i in range(len(scores))]
    return Candidates(np.array(poses), np.array(scores), np.ones(len(scores)))


@pytest.fixture(scope="module")
def plate():
    """A source on a plane, its prepared form and its fit."""
    rng, target = np.random.default_rng(0), tiny.plane()
    points = np.column_stack([rng.uniform(-10.0, 10.0, (80, 2)), rng.normal(0.0, 0.1, 80)])
    return described(np.round(points * 1024.0) / 1024.0, target)  # a shift by 2 mm is exact


@pytest.fixture(scope="module")
def egg():
    target = tiny.ellipsoid(count=500)
    return described(tiny.on_ellipsoid(80) + np.random.default_rng(1).normal(0.0, 0.1, (80, 3)), target)


def described(points, target):
    source = sources.prepare(points, SourceConfig(normal_neighbours=10))
    return refinement.evaluate(np.eye(4), source.points, target, CONFIG.refinement), source, target


def judged(case, found, known, probability=0.9, config=CONFIG):
    fit, source, target = case
    return rules.by_geometry(fit, found, known, probability, source, target, config)


@pytest.fixture(autouse=True)
def never_pushed(monkeypatch, request):
    if "pushed" not in request.keywords and "push" not in request.node.name:
        monkeypatch.setattr(rules, "can_be_pushed", lambda *_: False)


def test_nothing_refuses_what_is_observed_alone_and_firm(egg):
    assert judged(egg, candidates(1.0, 2.0), uncertainty()) is None
    assert rules.by_threshold(0.9, 1.0, CONFIG) is None


@pytest.mark.parametrize(
    ("shift_mm", "turn_deg", "refused"),
    [(4.99, 0.1, False), (5.01, 0.1, True), (0.1, 5.99, False), (0.1, 6.01, True)],
)
def test_a_direction_that_is_not_observed_refuses_alone(egg, shift_mm, turn_deg, refused):
    refusal = judged(egg, candidates(1.0, 2.0), uncertainty(shift_mm, turn_deg))
    assert (refusal is not None) is refused
    if refusal:
        assert refusal.status is RegistrationStatus.DEGENERATE
        assert f"{turn_deg:.1f} deg" in refusal.reason and f"{shift_mm:.1f} mm" in refusal.reason
        assert "(0.00, 0.00, 1.00)" in refusal.reason and "(1.00, 0.00, 0.00)" in refusal.reason


def test_a_motion_that_is_just_known_well_enough_does_not_refuse():
    assert not rules.has_unobserved_motion(SimpleNamespace(largest_turn_deg=6.0, largest_shift_mm=5.0), CONFIG.rules)


@pytest.mark.parametrize(
    ("scores", "matched"),
    [((4.0, 4.0624), True), ((4.0, 4.0625), False), ((4.0, 4.0626), False), ((16.0, 16.239), True),
     ((16.0, 16.241), False), ((1.0,), False), ((0.01, 0.0724), True), ((0.01, 0.0726), False)],
)  # fmt: skip
def test_a_rival_within_the_roughness_or_within_a_share_refuses_alone(egg, scores, matched):
    refusal = judged(egg, candidates(*scores), uncertainty())
    assert rules.has_equal_rival(candidates(*scores), CONFIG.rules) is matched
    assert (refusal is not None) is matched
    if refusal:
        assert refusal.status is RegistrationStatus.AMBIGUOUS and "30 mm and 0 deg away" in refusal.reason


@pytest.mark.parametrize(("scale_z", "refused"), [(2.99, False), (3.0, False), (3.01, True)])
def test_a_source_of_another_size_refuses_alone(scale_z, refused):
    refusal = rules.by_size({"scale_z": scale_z}, CONFIG.rules)
    assert (refusal is not None) is refused
    if refusal:
        assert refusal.status is RegistrationStatus.LOW_CONFIDENCE
        assert f"{scale_z:.1f} standard deviations" in refusal.reason and "scale" in refusal.reason


@pytest.mark.parametrize(("log_ratio", "refused"), [(-0.011, True), (-0.01, False), (0.0, False), (1.0, False)])
def test_a_source_whose_mirror_image_fits_better_refuses_alone(log_ratio, refused):
    refusal = rules.by_mirror(log_ratio, CONFIG.rules)
    assert (refusal is not None) is refused
    if refusal:
        assert refusal.status is RegistrationStatus.LOW_CONFIDENCE
        assert "other side" in refusal.reason and "flipped" in refusal.reason


@pytest.mark.parametrize(
    ("mean_square_mm2", "sigma_mm", "ratio"),
    [(0.99, 0.3, np.log(1.0 / 1.01)), (0.49, 0.4, np.log(0.17 / 0.26)), (0.49, 1.0, np.log(1.01 / 0.26))],
)
def test_an_image_fits_better_where_all_points_and_most_points_say_so(mean_square_mm2, sigma_mm, ratio):
    """Of mean square 1 and deviation .5 mm: by mean squares, by variances, and by the larger of the two."""
    found = mirror.Misfit(mean_square_mm2, sigma_mm).log_ratio(mirror.Misfit(1.0, 0.5))
    assert found == pytest.approx(ratio)


def test_the_ratio_of_a_mirrored_source_is_that_of_mean_squares_above_a_tenth_of_a_millimetre():
    assert mirror.log_ratio(0.03, 0.09) == pytest.approx(np.log(0.04 / 0.10))
    assert mirror.log_ratio(1e-9, 1e-12) == pytest.approx(0.0, abs=1e-6)  # both exact: no sign of either
    assert (mirror.log_ratio(0.0, 1e3), mirror.log_ratio(1e3, 0.0)) == (-1.5, 4.0)


def test_a_pose_that_can_be_pushed_refuses_alone_where_it_would_be_accepted(egg, monkeypatch):
    asked = []
    monkeypatch.setattr(rules, "can_be_pushed", lambda *args: asked.append(args) or True)
    refusal = judged(egg, candidates(1.0, 2.0), uncertainty(), probability=0.5)
    assert refusal.status is RegistrationStatus.DEGENERATE and "flat or straight" in refusal.reason
    assert asked[0][3] is CONFIG
    assert judged(egg, candidates(1.0, 2.0), uncertainty(), probability=0.24) is None and len(asked) == 1
    streamed = judged(egg, candidates(1.0, 2.0), uncertainty(), probability=0.26)  # a stream may raise it to 0.51
    assert streamed.status is RegistrationStatus.DEGENERATE
    strict = replace(CONFIG, min_confidence=0.8)  # and 0.64 to 0.8
    assert judged(egg, candidates(1.0, 2.0), uncertainty(), 0.63, strict) is None
    assert judged(egg, candidates(1.0, 2.0), uncertainty(), 0.65, strict) is not None
    zero = replace(CONFIG, min_confidence=0.0)
    assert judged(egg, candidates(1.0, 2.0), uncertainty(), 0.0, zero).status is RegistrationStatus.DEGENERATE


def test_a_pose_on_a_plane_stays_where_it_is_pushed_and_one_on_an_egg_comes_back(plate, egg):
    for case, pushed in ((plate, True), (egg, False)):
        fit, source, target = case
        assert rules.can_be_pushed(fit, source, target, PUSHED) is pushed


def test_a_push_goes_both_ways_along_the_weakest_motions_by_its_length(plate, monkeypatch):
    fit, source, target = plate
    seen = []

    def note(poses, points, target, limits, threads):
        seen.append((poses, points, limits))
        return poses, np.r_[1.0, np.full(len(poses) - 1, 5.0)]

    monkeypatch.setattr(rules, "refine_many", note)
    assert not rules.can_be_pushed(fit, source, target, PUSHED)  # all are worse
    ((poses, points, limits),) = seen
    assert len(poses) == 1 + 2 * 3 and tuple(limits) == (5.0, 4.75, 4.5, 4.25, 4.0)
    assert len(points) == PUSHED.verification.middle_points and np.array_equal(poses[0], fit.T)
    moves = np.array([se3.apply(T, source.points) - fit.moved for T in poses[1:]])
    assert np.sqrt((moves**2).sum(axis=2).mean(axis=1)) == pytest.approx(
        1.5 * PUSHED.verification.same_pose_mm, rel=0.02
    )
    assert moves[0] == pytest.approx(-moves[1], abs=0.4)


@pytest.mark.parametrize(("apart_mm", "score", "pushed"), [
    (2.01, 1.0, True), (2.0, 1.0, True), (1.99, 1.0, False), (3.0, 1.0625, False), (3.0, 1.07, False),
])  # fmt: skip
def test_only_a_pose_that_rests_elsewhere_and_fits_as_well_is_a_push(plate, monkeypatch, apart_mm, score, pushed):
    fit, source, target = plate

    def rest(poses, points, target, limits, threads):
        rested = np.tile(np.eye(4), (len(poses), 1, 1))
        rested[3] = se3.exp([apart_mm, 0.0, 0.0, 0.0, 0.0, 0.0])
        scores = np.full(len(poses), 9.0)
        scores[0], scores[3] = 1.0, score
        return rested, scores

    monkeypatch.setattr(rules, "refine_many", rest)
    assert rules.can_be_pushed(fit, source, target, PUSHED) is pushed


def test_the_weakest_motions_of_a_plane_lie_in_it_and_move_the_source_by_1_mm(plate):
    fit = plate[0]
    motions = rules._weakest_motions(fit, 3)
    centre = fit.moved.mean(axis=0)
    moves = np.array([m[:3] + np.cross(m[3:], fit.moved - centre) for m in motions])
    assert np.sqrt((moves**2).sum(axis=2).mean(axis=1)) == pytest.approx(1.0)
    assert np.abs(moves[:, :, 2]).max() < 0.05


@pytest.mark.parametrize("size", [1.0, 0.02])
def test_the_weakest_motions_are_those_of_the_generalised_eigenproblem(egg, size):
    """Of m^T J^T W J m against |shift|^2 + |turn|^2 arm^2, for an arm of the points' spread, at least 1 mm."""
    rng, fit = np.random.default_rng(3), egg[0]
    fit = replace(fit, moved=size * (fit.moved - fit.moved.mean(axis=0)) + 30.0, weights=rng.uniform(0.1, 1.0, 80))
    away = fit.moved - fit.moved.mean(axis=0)
    arm_mm = max(np.sqrt((away**2).sum() / 80), 1.0)
    J = np.column_stack([fit.gradients, np.cross(away, fit.gradients)])
    metric = np.diag([1.0] * 3 + [arm_mm**2] * 3)
    expected = scipy.linalg.eigh(J.T @ np.diag(fit.weights) @ J, metric)[1].T[:3]
    moves = expected[:, None, :3] + np.cross(expected[:, None, 3:], away)
    expected /= np.sqrt((moves**2).sum(axis=2).mean(axis=1))[:, None]
    motions = rules._weakest_motions(fit, 3)
    motions *= np.sign((motions * expected).sum(axis=1))[:, None]
    np.testing.assert_allclose(motions, expected, rtol=1e-6, atol=1e-9)


def test_a_motion_that_moves_no_point_is_finite(egg):
    """A source of one point, many times, can be turned about it."""
    fit = egg[0]
    fit = replace(fit, moved=np.zeros_like(fit.moved), gradients=np.tile([0.0, 0.0, 1.0], (80, 1)))
    assert np.isfinite(rules._weakest_motions(fit, 6)).all()


def test_points_without_weight_say_nothing_of_the_weakest_motions(egg):
    fit = egg[0]
    top = fit.moved[:, 2] > 0.0
    ignored = replace(fit, weights=np.where(top, 1.0, 0.0))
    turned = np.where(top[:, None], fit.gradients, [0.0, 0.0, 1.0])
    same = replace(ignored, gradients=turned)
    assert np.abs(rules._weakest_motions(ignored, 3)) == pytest.approx(np.abs(rules._weakest_motions(same, 3)))


@pytest.mark.parametrize("probability", [0.499, np.nan])
def test_a_probability_below_the_threshold_refuses_alone(probability):
    refusal = rules.by_threshold(probability, 0.1, CONFIG)
    assert refusal.status is RegistrationStatus.LOW_CONFIDENCE
    assert rules.by_threshold(0.5, 0.1, CONFIG) is None
    assert "against" not in refusal.reason


def test_a_low_probability_names_the_two_features_that_speak_most_against_the_pose():
    adds = {"mirror_margin": -1.72, "log_sigma": -0.8, "margin": 2.0, "size_margin": -0.6, "extent": -0.1}
    reason = rules.by_threshold(0.16, 0.1, CONFIG, adds).reason
    assert reason.endswith("against it: fit of the mirrored source (-1.7), size of the residuals (-0.8)")
    assert "against" not in rules.by_threshold(0.16, 0.1, CONFIG, {"log_sigma": -0.49, "margin": 2.0}).reason


def test_every_feature_and_limit_of_the_confidence_has_words():
    named = {*FEATURES, *SCENE_FEATURES, *STREAM_FEATURES[1:], *(limit.name for limit in limits.LIMITS)}
    assert set(words.WORDS) == named  # the first of a stream is the answer of the frames themselves


def test_an_error_bound_above_the_allowed_one_refuses_alone():
    allowed = replace(CONFIG, max_tre_mm=2.0)
    assert rules.by_threshold(0.9, 2.01, allowed).status is RegistrationStatus.IMPRECISE
    assert rules.by_threshold(0.9, np.nan, allowed).status is RegistrationStatus.IMPRECISE
    assert rules.by_threshold(0.9, 2.0, allowed) is None and rules.by_threshold(0.9, 1.5, allowed) is None
    assert rules.by_threshold(0.9, 0.6, replace(CONFIG, max_tre_mm=0.5)).status is RegistrationStatus.IMPRECISE
    assert rules.by_threshold(0.9, 1e6, CONFIG) is None  # 0 switches it off


def test_rivals_share_what_the_best_leaves_in_the_order_of_their_residuals():
    shares = shared_probability(0.9, np.array([1.0, 1.1, 1.1, 2.0]), 30.0)
    assert shares[0] == 0.9 and sum(shares) == pytest.approx(1.0)
    assert shares[1] == shares[2] > shares[3]
    assert shares[1] / shares[3] == pytest.approx(np.exp(15.0 * 0.9))
    assert shared_probability(0.2, np.array([1.0, 1.0]), 30.0)[1] == 0.2  # never above the best
    assert shared_probability(0.7, np.array([1.0]), 30.0) == (0.7,)
