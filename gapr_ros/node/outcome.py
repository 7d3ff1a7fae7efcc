"""One cloud: its job, the reasons why it may get no pose, and its outcome."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from enum import Enum
from textwrap import shorten
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.time import Time
from std_msgs.msg import Header

from gapr_core.results import RegistrationResult, RegistrationStatus, confidence_text

Array = NDArray[np.float64]
LINE = 200  # characters of a line in the log
LAST_NS = 2**31 * 1_000_000_000  # the seconds of a stamp are an int32
OLD_S, NO_CLOCK_S = 1.0, 86_400.0  # older clouds: said with the answer; of another clock, as a bag without /clock


class Reason(str, Enum):
    """Why a cloud gets no pose: the words of logs, diagnostics and service answers."""

    EMPTY_CLOUD = "empty_cloud"
    TOO_FEW_POINTS = "too_few_points"
    BAD_FIELDS = "bad_fields"
    NON_FINITE = "non_finite"
    UNIT_MISMATCH = "unit_mismatch"
    BAD_FRAME = "bad_frame"
    STALE = "stale"
    FUTURE = "future"
    TF_MISSING = "tf_missing"
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
ADVICE = {  # one sentence for the log, where the core's own says more than a line holds
    Reason.AMBIGUOUS: "two poses explain the cloud as well: show a part of the bone that tells them apart",
    Reason.DEGENERATE: "the bone could slide or turn under the cloud: show an end of it",
    Reason.LOW_CONFIDENCE: "no pose is likely enough: show more of the bone, or check that it is this bone",
    Reason.IMPRECISE: "the bound of the error is too large: show the far parts of the bone, or raise max_tre",
    Reason.CLUTTER: "most of the cloud is not this bone: set crop_min and crop_max to a box around the bone",
    Reason.TOO_FEW_POINTS: "too few points: send larger clouds, or register several as one (accumulate)",
}


class RefusedError(Exception):
    """Raised inside the node to end the way of one cloud; never leaves it."""

    def __init__(self, reason: Reason, text: str = "") -> None:
        super().__init__(f"{reason}: {text}" if text else str(reason))
        self.reason, self.text = reason, text


@dataclass(eq=False)
class Job:
    """One cloud on its way through the worker.

    Attributes:
        cloud: serialised message, as it came from the middleware.
        epoch: the reset count when it arrived; a later reset makes its result worthless.
        received_ns: the node's clock when it arrived, ns.
        waiters: futures of service calls that want its outcome.
        urgent: asked for by a service: `continuous: false` does not hold it back.
        arrived_s: by the wall clock (`time.monotonic`).
    """

    cloud: bytes
    epoch: int
    received_ns: int
    waiters: list[Any] = field(default_factory=list)
    urgent: bool = False
    arrived_s: float = field(default_factory=time.monotonic)


@dataclass(frozen=True)
class Place:
    """A pose of the bone: T_frame_model (4, 4), metres, in `frame` (empty: that of the cloud)."""

    T_frame_model: Array
    frame: str


@dataclass(frozen=True, eq=False)
class Found:
    """Where the bone is.

    Attributes:
        pose: (4, 4) T_frame_model, metres.
        covariance: (6, 6) of that pose, metres and radians, fixed axes of the frame, about the model's origin.
    """

    pose: Array
    covariance: Array


@dataclass
class Outcome:
    """Filled step by step while a cloud is processed; a pose only when there is no reason against it.

    Attributes:
        job: where the cloud came from and who waits for it.
        cloud_frame: frame of the cloud.
        header: frame of the pose (`output_frame` or that of the cloud) and stamp of the cloud.
        reason: why there is no pose, or None.
        text: the reason in full.
        found: where the bone is in the frame; None when refused.
        points_in: of the message.
        points_on_table: left out, since they lie on a plane that is larger than the bone.
        points_used: given to registration, with those of the clouds that are registered with it.
        seen_from: (3,) mm, frame of the cloud: the camera by its pixels, if they were asked and say it.
        age_s: of the cloud when it was taken in hand; None while the clock does not run.
        result: answer of the registration; None where it was not asked.
        has_initial_pose: the registration began at a pose from outside.
        tf_wait_s: of `exec_s`, how long transforms were waited for.
        exec_s: wall time of the whole way.
    """

    job: Job
    cloud_frame: str = ""
    header: Header = field(default_factory=Header)
    reason: Reason | None = None
    text: str = ""
    found: Found | None = None
    points_in: int = 0
    points_on_table: int = 0
    points_used: int = 0
    seen_from: Array | None = None
    age_s: float | None = None
    result: RegistrationResult | None = None
    has_initial_pose: bool = False
    tf_wait_s: float = 0.0
    exec_s: float = 0.0

    @property
    def ok(self) -> bool:
        """True when the pose goes out."""
        return self.found is not None

    @property
    def confidence(self) -> float:
        """Of the registration, 0 to 1, whatever was decided later."""
        return 0.0 if self.result is None else float(self.result.confidence)

    def refuse(self, reason: Reason, text: str) -> None:
        """Take the pose away."""
        self.reason, self.text, self.found = reason, text, None

    def answer_waiters(self) -> None:
        """Give it to those who wait for it."""
        for waiter in self.job.waiters:
            waiter.set_result(self)

    @property
    def line(self) -> str:
        """One sentence of at most 200 characters; a refusal's says what to do."""
        if self.ok:
            assert self.result is not None
            bound = "" if self.result.tre95_mm is None else f", tre95 {self.result.tre95_mm / 1000.0:.4f} m"
            is_old = OLD_S < (self.age_s or 0.0) < NO_CLOCK_S
            age = f", of a cloud {self.age_s:.1f} s old" if is_old else ""
            return f"pose with confidence {confidence_text(self.confidence)}{bound}{age}"
        advice = self.text
        if self.result is not None and self.reason in ADVICE and not self.result.ok:
            found = [each.advice for each in self.result.findings if each.advice and each.status is self.result.status]
            advice = (found or [ADVICE[self.reason]])[0]
        return shorten(f"refused ({self.reason}): {advice}" if advice else f"refused ({self.reason})", LINE)


@dataclass
class Counters:
    """Every cloud that was received is accepted, refused, dropped, merged with a newer one, or on its way.

    One that ~/register asks for again is accepted or refused again. `lost` are those that a publisher sent and that
    never arrived.
    """

    received: int = 0
    dropped: int = 0
    accepted: int = 0
    refused: int = 0
    merged: int = 0
    lost: int = 0
    consecutive_refusals: int = 0
    last_refusal: str = ""
    last_cloud_at: float | None = None
    last_lost_at: float = float("-inf")

    def count_lost(self, count: int) -> None:
        """So many clouds more were sent and never came."""
        self.lost += count
        if count > 0:
            self.last_lost_at = time.monotonic()

    def count_received(self) -> None:
        """Count a cloud that came."""
        self.received += 1
        self.last_cloud_at = time.monotonic()

    def forget_refusals(self) -> None:
        """Nothing was refused yet of what comes now; the counts go on."""
        self.consecutive_refusals, self.last_refusal = 0, ""

    def count_answer(self, outcome: Outcome) -> None:
        """Count a cloud that was answered."""
        if outcome.ok:
            self.accepted += 1
            self.forget_refusals()
            return
        self.refused += 1
        self.consecutive_refusals += 1
        self.last_refusal = f"{outcome.reason}: {outcome.text}" if outcome.text else str(outcome.reason)


def stamp_ns(header: Header) -> int:
    """Return the stamp, ns; 0 if there is none."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def normal(header: Header) -> Header:
    """Return the header with less than a second of nanoseconds; a stamp that is no time becomes 0."""
    stamp = stamp_ns(header)
    known = stamp if 0 <= stamp < LAST_NS else 0
    return Header(frame_id=header.frame_id, stamp=Time(nanoseconds=known).to_msg())


def age_s(stamp: int, now_ns: int) -> float | None:
    """Return the age, s, of a stamp, ns; None without one, and while no clock runs."""
    return (now_ns - stamp) * 1e-9 if stamp and now_ns else None
