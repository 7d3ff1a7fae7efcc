"""Why a cloud gets no pose."""

from __future__ import annotations

from enum import Enum

from gapr_core.results import RegistrationStatus


class Reason(str, Enum):
    """The words that logs, diagnostics and service answers use."""

    EMPTY_CLOUD = "empty_cloud"
    TOO_FEW_POINTS = "too_few_points"
    BAD_FIELDS = "bad_fields"
    NON_FINITE = "non_finite"
    UNIT_MISMATCH = "unit_mismatch"
    BAD_FRAME = "bad_frame"
    STALE = "stale"
    FUTURE = "future"
    TF_MISSING = "tf_missing"
    TIMEOUT = "timeout"
    NOT_CONVERGED = "not_converged"
    AMBIGUOUS = "ambiguous"
    DEGENERATE = "degenerate"
    LOW_CONFIDENCE = "low_confidence"
    IMPRECISE = "imprecise"
    CLUTTER = "clutter"
    JUMP = "jump"
    SUPERSEDED_BY_RESET = "superseded_by_reset"

    def __str__(self) -> str:
        return self.value


# the node has the core's own words for what the data decided
OF_STATUS: dict[RegistrationStatus, Reason] = {
    status: Reason(status.value.lower()) for status in RegistrationStatus if status is not RegistrationStatus.OK
}


class RefusedError(Exception):
    """Raised inside the node to end the way of one cloud; never leaves it."""

    def __init__(self, reason: Reason, text: str = "") -> None:
        super().__init__(f"{reason}: {text}" if text else str(reason))
        self.reason, self.text = reason, text
