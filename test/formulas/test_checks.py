"""Every check finds alone, at its threshold, and says what it saw."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import tiny

from gapr_core.config import RegistrarConfig, VerificationConfig
from gapr_core.geometry import se3
from gapr_core.registration.checks import table
from gapr_core.registration.checks.assess import checked_geometry
from gapr_core.registration.fit import alternatives
from gapr_core.registration.fit.alternatives import Trial
from gapr_core.results import Effect, RegistrationStatus

CONFIG = RegistrarConfig(
    num_threads=1, verification=VerificationConfig(middle_points=60, middle_limits_mm=(5.0, 4.0, 5), same_pose_mm=2.0)
)


@pytest.fixture(scope="module")
def plate():
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-10.0, 10.0, (80, 2)), rng.normal(0.0, 0.1, 80)])
    return tiny.assessed(np.round(points * 1024.0) / 1024.0, tiny.plane())  # a shift by 2 mm is exact


@pytest.fixture(scope="module")
def egg():
    points = tiny.on_ellipsoid(80) + np.random.default_rng(1).normal(0.0, 0.1, (80, 3))
    return tiny.assessed(points, tiny.ellipsoid(count=500))


def loose(shift_mm=0.1, turn_deg=0.1):
    return lambda a: replace(a, uncertainty=tiny.uncertainty(shift_mm, turn_deg))


def rivalled(*scores):
    return lambda a: replace(a, candidates=tiny.candidates(*scores))


def mirrored(log_ratio):
    return lambda a: table.mirror_image(a, log_ratio)


DEGENERATE, AMBIGUOUS = RegistrationStatus.DEGENERATE, RegistrationStatus.AMBIGUOUS
TURN, SHIFT, RIVAL, IMAGE = "unobserved turn", "unobserved shift", "equal rival", "mirror image"


@pytest.mark.parametrize(
    ("change", "check", "status", "says"),
    [
        (loose(), None, None, ""),
        (loose(4.99, 5.99), None, None, ""),
        (loose(turn_deg=6.01), TURN, DEGENERATE, "could still be turned about its short axis by 6 degrees"),
        (loose(turn_deg=200.0), TURN, DEGENERATE, "about its short axis freely"),
        (loose(shift_mm=5.01), SHIFT, DEGENERATE, "the bone could still be shifted along its long axis by 5 mm"),
        (loose(shift_mm=1001.0), SHIFT, DEGENERATE, "shifted along its long axis freely"),
        (rivalled(1.0), None, None, ""),
        (rivalled(4.0, 4.0624), RIVAL, AMBIGUOUS, "another pose, 30 mm and 0 deg away"),
        (rivalled(4.0, 4.0626), None, None, ""),
        (rivalled(16.0, 16.239), RIVAL, AMBIGUOUS, "explains the source as well"),
        (rivalled(16.0, 16.241), None, None, ""),
        (rivalled(0.01, 0.0724), RIVAL, AMBIGUOUS, ""),
        (rivalled(0.01, 0.0726), None, None, ""),
        (mirrored(-0.011), IMAGE, RegistrationStatus.LOW_CONFIDENCE, "mirror image of the source fits the bone better"),
        (mirrored(-0.01), None, None, ""),
        (mirrored(np.inf), None, None, ""),
    ],
)
def test_each_check_refuses_alone_beyond_its_threshold(egg, change, check, status, says):
    changed = change(egg)
    found = checked_geometry(changed, CONFIG)
    assert [each.check for each in found.findings] == ([] if check is None else [check])
    if check is not None:
        (finding,) = found.findings
        assert finding.effect is Effect.REFUSE and finding.status is status
        assert says in finding.text and finding.advice and found.uncertainty is changed.uncertainty


def test_a_finding_holds_the_statistic_and_its_threshold(egg):
    changes = {loose(turn_deg=7.0): (7.0, 6.0), loose(shift_mm=8.0): (8.0, 5.0), mirrored(-0.5): (-0.5, -0.01),
               rivalled(4.0, 4.05): (1.0125, 1.015)}  # fmt: skip
    for change, expected in changes.items():
        finding = checked_geometry(change(egg), CONFIG).refusal
        assert (finding.statistic, finding.threshold) == pytest.approx(expected)


def test_a_pose_on_a_plane_stays_where_it_is_pushed_and_one_on_an_egg_comes_back(plate, egg):
    flat = checked_geometry(plate, CONFIG)
    assert [each.check for each in flat.findings] == ["flat valley"] and flat.refusal.status is DEGENERATE
    assert flat.refusal.statistic < flat.refusal.threshold and "flat or straight" in flat.refusal.text
    assert checked_geometry(egg, CONFIG).refusal is None


@pytest.mark.parametrize(("least", "probability", "is_pushed"), [
    (0.5, 0.24, False), (0.5, 0.26, True), (0.8, 0.63, False), (0.8, 0.65, True), (0.0, 1e-3, True),
])  # fmt: skip
def test_only_a_pose_that_may_be_accepted_is_pushed(plate, least, probability, is_pushed):
    judgement = replace(plate.judgement, pose_log_odds=float(np.log(probability / (1.0 - probability))))
    found = checked_geometry(replace(plate, judgement=judgement), replace(CONFIG, min_confidence=least))
    assert (found.refusal is not None) is is_pushed


@pytest.mark.parametrize(("same_mm", "rests"), [(2.0, True), (2.5, True), (30.0, False)])
def test_only_a_pose_that_rests_elsewhere_and_fits_as_well_is_a_valley(plate, egg, same_mm, rests):
    """On a plate of 20 mm a push by 1.5 times 30 mm leaves it, and is no rest at all."""
    config = replace(CONFIG, verification=replace(CONFIG.verification, same_pose_mm=same_mm))
    trial = alternatives.trial_of(plate.fit, plate.source, plate.target, config)
    assert (alternatives.pushed(trial, plate.fit) < table.as_good_as(trial.own_mm2)) is rests
    trial = alternatives.trial_of(egg.fit, egg.source, egg.target, CONFIG)
    assert alternatives.pushed(trial, egg.fit) > table.as_good_as(1.0)


def test_a_push_goes_both_ways_along_the_weakest_motions_by_its_length(plate):
    class Noting(Trial):
        def refined(self, poses, points=None, target=None):
            seen.append(poses)
            rested = np.tile(poses[0], (len(poses), 1, 1))
            rested[3], rested[5] = se3.exp([2.0, 0, 0, 0, 0, 0]) @ poses[0], se3.exp([1.9, 0, 0, 0, 0, 0]) @ poses[0]
            return rested, np.array([1.0, 0.5, 0.5, 7.0, 0.5, 0.5, 0.5])

    seen = []
    trial = Noting(plate.fit.T, plate.source.points, plate.target, CONFIG)
    assert alternatives.pushed(trial, plate.fit) == 7.0, "of those that rest at least 2 mm away"
    ((own, *pushes),) = seen
    moves = np.array([se3.apply(T, plate.source.points) - plate.fit.moved for T in pushes])
    assert np.array_equal(own, plate.fit.T) and len(moves) == 2 * 3
    assert np.sqrt((moves**2).sum(axis=2).mean(axis=1)) == pytest.approx(1.5 * 2.0, rel=0.02)
    assert moves[0] == pytest.approx(-moves[1], abs=0.4) and ((moves[::2] * moves[1::2]).sum(axis=(1, 2)) < 0.0).all()
    assert np.abs(moves[:, :, 2]).max() < 0.2, "along the plane, never across"


@pytest.mark.parametrize("size", [1.0, 0.02])
def test_the_weakest_motions_are_those_of_the_generalised_eigenproblem(egg, size):
    """Of m^T J^T W J m against |shift|^2 + |turn|^2 arm^2, for an arm of the points' spread, at least 1 mm."""
    rng, fit = np.random.default_rng(3), egg.fit
    fit = replace(fit, moved=size * (fit.moved - fit.moved.mean(axis=0)) + 30.0, weights=rng.uniform(0.0, 1.0, 80))
    away = fit.moved - fit.moved.mean(axis=0)
    arm_mm = max(np.sqrt((away**2).sum() / 80), 1.0)
    J = np.column_stack([fit.gradients, np.cross(away, fit.gradients)])
    expected = scipy.linalg.eigh(J.T @ np.diag(fit.weights) @ J, np.diag([1.0] * 3 + [arm_mm**2] * 3))[1].T[:3]
    moves = expected[:, None, :3] + np.cross(expected[:, None, 3:], away)
    expected /= np.sqrt((moves**2).sum(axis=2).mean(axis=1))[:, None]
    motions = alternatives._weakest_motions(fit)
    motions *= np.sign((motions * expected).sum(axis=1))[:, None]
    np.testing.assert_allclose(motions, expected, rtol=1e-6, atol=1e-9)
    one_point = replace(fit, moved=np.zeros_like(fit.moved), gradients=np.tile([0.0, 0.0, 1.0], (80, 1)))
    assert np.isfinite(alternatives._weakest_motions(one_point)).all(), "of one point a turn moves nothing"
