"""Answers of a registration: a pose with its certainty, or a refusal with its reason; the verdict of check points."""

from gapr_core.results.parts import (
    Effect,
    Finding,
    Guidance,
    Hypothesis,
    LookAnswer,
    LookFit,
    Patch,
    Refusal,
    RegistrationStatus,
    Residuals,
    ResultWarning,
    TargetError,
    confidence_text,
)
from gapr_core.results.point_check import PointCheck, Verdict
from gapr_core.results.result import RegistrationResult

__all__ = [
    "Effect",
    "Finding",
    "Guidance",
    "Hypothesis",
    "LookAnswer",
    "LookFit",
    "Patch",
    "PointCheck",
    "Refusal",
    "RegistrationResult",
    "RegistrationStatus",
    "Residuals",
    "ResultWarning",
    "TargetError",
    "Verdict",
    "confidence_text",
]
