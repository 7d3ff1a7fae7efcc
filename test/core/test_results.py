"""What an answer keeps once it is refused."""

from dataclasses import fields

import numpy as np
import pytest

from gapr_core.results import Effect, Finding, Hypothesis, RegistrationResult, RegistrationStatus, confidence_text


def test_a_refusal_keeps_what_is_looked_at_and_nothing_that_goes_with_a_pose():
    pose = {"T_target_source": np.eye(4), "covariance": np.eye(6), "centre_mm": np.ones(3), "factor95": 1.7}
    looked_at = {"hypotheses": (Hypothesis(np.eye(4), 0.9),), "confidence": 0.9, "inlier_ratio": 0.8}
    answer = RegistrationResult(RegistrationStatus.OK, tre_mm=0.5, tre95_mm=0.9, **pose, **looked_at)
    finding = Finding("check", Effect.REFUSE, 2.0, 1.0, RegistrationStatus.AMBIGUOUS, "why", "do")
    refused = answer.refused(finding)
    nothing = RegistrationResult(RegistrationStatus.AMBIGUOUS, reason="why; do", findings=(finding,), **looked_at)
    for each in fields(RegistrationResult):
        assert getattr(refused, each.name) == getattr(nothing, each.name), each.name


@pytest.mark.parametrize(
    ("confidence", "text"),
    [(0.9964, "0.99"), (0.8999, "0.89"), (0.29, "0.29"), (0.57, "0.57"), (1.0, "1.00"), (0.0, "0.00"), (np.nan, "nan")],
)
def test_no_confidence_is_shown_larger_than_it_is(confidence, text):
    assert confidence_text(confidence) == text
    assert f"confidence {text}" in str(RegistrationResult(RegistrationStatus.LOW_CONFIDENCE, confidence=confidence))


def test_a_refusal_is_no_pose_for_an_if_either():
    refused = RegistrationResult(RegistrationStatus.LOW_CONFIDENCE, reason="too little bone")
    assert not refused and RegistrationResult(RegistrationStatus.OK, np.eye(4))
    assert repr(refused) == f"<RegistrationResult: {refused}>" and "\n" not in repr(refused)
