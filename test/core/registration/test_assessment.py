"""What a refusal rests on: every rule and every threshold alone."""

from dataclasses import replace

import numpy as np
import pytest

from gapr_core import Registrar, RegistrarConfig, RegistrationStatus
from gapr_core.data.protocols import make_pair
from gapr_core.data.specimen import Specimen
from gapr_core.errors import MethodUnavailableError
from gapr_core.geometry import se3
from gapr_core.registration.checks import rules
from gapr_core.registration.checks.assessment import answer
from gapr_core.registration.proposals.base import Proposals
from gapr_core.registration.proposals.network import NetworkProposer

ONE_THREAD = RegistrarConfig(num_threads=1)


@pytest.fixture(scope="module")
def right(registrar, femur):
    """An assessment that nothing speaks against."""
    pair = make_pair("L1", Specimen(femur, "femur", "parametric-3", "parametric"), seed=5)
    assessment = registrar.assess(pair.source, registrar.prepare(pair.target))
    assert assessment.refusal is None and assessment.probability > 0.9
    return assessment


def judged(a, config=ONE_THREAD):
    return rules.by_geometry(a.fit, a.candidates, a.uncertainty, a.probability, a.source, a.target, config)


def test_nothing_refuses_a_right_pose(right):
    assert judged(right) is None
    result = answer(right, ONE_THREAD)
    assert result.ok and 0.0 < result.tre_mm < result.tre95_mm
    assert np.array_equal(result.hypotheses[0].T_target_source, result.T_target_source)


@pytest.mark.parametrize(("block", "value"), [(slice(0, 3), 5.1**2), (slice(3, 6), np.radians(6.1) ** 2)])
def test_a_motion_that_is_not_observed_refuses_alone(right, block, value):
    covariance = right.uncertainty.covariance.copy()
    covariance[block, block] += value * np.diag([1.0, 0.0, 0.0])
    loose = replace(right, uncertainty=replace(right.uncertainty, covariance=covariance))
    assert judged(loose).status is RegistrationStatus.DEGENERATE
    assert judged(replace(right, uncertainty=right.uncertainty)) is None


def test_a_rival_that_is_as_good_refuses_alone_and_is_named(right):
    scores = right.candidates.scores.copy()
    scores[1] = scores[0]
    shift = se3.exp([0.0, 30.0, 0.0, 0.0, 0.0, 0.0])
    poses = right.candidates.poses.copy()
    poses[1] = shift @ poses[0]
    refusal = judged(replace(right, candidates=replace(right.candidates, scores=scores, poses=poses)))
    assert refusal.status is RegistrationStatus.AMBIGUOUS
    assert "30 mm and 0 deg away" in refusal.reason


def test_a_pose_that_can_be_pushed_refuses_alone(right, monkeypatch):
    monkeypatch.setattr(rules, "can_be_pushed", lambda *_: True)
    assert judged(right).status is RegistrationStatus.DEGENERATE


@pytest.mark.parametrize("min_confidence", [0.0, 0.2, 0.5])
def test_a_refusal_by_rule_does_not_depend_on_the_threshold(right, monkeypatch, min_confidence):
    monkeypatch.setattr(rules, "can_be_pushed", lambda *_: True)
    config = replace(ONE_THREAD, min_confidence=min_confidence)
    refused = replace(right, refusal=judged(right, config), probability=config.rules.ruled_out)
    result = answer(refused, config)
    assert result.status is RegistrationStatus.DEGENERATE and result.T_target_source is None
    assert result.hypotheses and np.array_equal(result.best, right.fit.T)


@pytest.mark.parametrize("probability", [0.49, np.nan])
def test_a_probability_below_the_threshold_or_none_at_all_refuses_alone(right, probability):
    result = answer(replace(right, probability=probability), ONE_THREAD)
    assert result.status is RegistrationStatus.LOW_CONFIDENCE and not result.ok


def test_an_error_bound_above_the_allowed_one_refuses_alone(right):
    bound = right.tre95_mm
    for allowed, ok in ((0.99 * bound, False), (1.01 * bound, True), (0.0, True)):
        result = answer(right, replace(ONE_THREAD, max_tre_mm=allowed))
        assert result.ok is ok
        assert ok or result.status is RegistrationStatus.IMPRECISE


def test_a_proposer_without_a_fitted_confidence_is_named(registrar):
    class Own:
        name = "mine"

        def prepare(self, target):
            return None

        def propose(self, source, target, rng):
            return Proposals(np.empty((0, 4, 4)), np.empty(0))

    with pytest.raises(MethodUnavailableError, match="'mine'.*calibrations="):
        Registrar(ONE_THREAD, [Own()])
    assert Registrar(ONE_THREAD, [NetworkProposer.from_weights()]).calibrations
