"""What the node says about itself: counters, and two DiagnosticStatus for /diagnostics."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from gapr_ros.model import Model
from gapr_ros.outcome import Outcome
from gapr_ros.refusal import Reason

SILENCE_S = 2.0
THROTTLE_S = 5.0


@dataclass
class Counters:
    """Every cloud that was received is accepted, refused, dropped, merged with a newer one, or still on its way.

    One that ~/register asks for again is accepted or refused again.

    `lost` are those that a publisher sent and that never arrived.
    """

    received: int = 0
    dropped: int = 0
    accepted: int = 0
    refused: int = 0
    merged: int = 0
    lost: int = 0
    consecutive_refusals: int = 0
    last_refusal: str = ""
    last_cloud_at: float = field(default_factory=time.monotonic)

    def receive(self) -> None:
        """A cloud came."""
        self.received += 1
        self.last_cloud_at = time.monotonic()

    def leave(self, merged: bool) -> None:
        """A cloud that was pushed out is registered with a newer one, or could not be."""
        self.merged += merged
        self.dropped += not merged

    def settle(self, outcome: Outcome) -> None:
        """A cloud was answered."""
        if outcome.ok:
            self.accepted += 1
            self.consecutive_refusals = 0
            return
        self.refused += 1
        self.consecutive_refusals += 1
        self.last_refusal = f"{outcome.reason}: {outcome.text}" if outcome.text else str(outcome.reason)


@dataclass
class Input:
    """What is known about the topic of the clouds."""

    qos: str = ""
    publishers: int = 0
    mismatch: str = ""


class Gaps:
    """Finds clouds that were sent and never came, from the numbers that each publisher gives to its messages.

    Which publisher a message is from is not known: a number belongs to the one whose last number is nearest below.
    """

    MOST_PUBLISHERS = 8

    def __init__(self) -> None:
        self._last: list[int] = []  # of every publisher, the one heard last at the end

    def note(self, number: int) -> int:
        """How many numbers are missing before this one; 0 for the first of a publisher."""
        before = max((last for last in self._last if last < number), default=None)
        if before is not None:
            self._last.remove(before)
        self._last = [*self._last[1 - self.MOST_PUBLISHERS :], number]
        return 0 if before is None else number - before - 1


class RefusalLog:
    """Writes a refusal when its reason is new or the last line is 5 s old, with the number of those in between."""

    def __init__(self, write: Callable[[str], None]) -> None:
        self._write, self._reason, self._at, self._silent = write, None, float("-inf"), 0

    def __call__(self, outcome: Outcome) -> None:
        """Log one refusal, or count it."""
        if outcome.reason == self._reason and time.monotonic() - self._at < THROTTLE_S:
            self._silent += 1
            return
        more = f" ({self._silent} more since the last line)" if self._silent else ""
        self._write(f"cloud in '{outcome.cloud_frame}' {outcome}{more}")
        self._reason, self._at, self._silent = outcome.reason, time.monotonic(), 0


def registration_status(
    name: str, state: str, failure: str, model: Model | None, counters: Counters, last: Outcome | None, source: Input
) -> DiagnosticStatus:
    """The state of the registration."""
    level, message = DiagnosticStatus.OK, f"{state}, {counters.accepted} accepted, {counters.refused} refused"
    if counters.consecutive_refusals:
        level, message = DiagnosticStatus.WARN, f"refused: {counters.last_refusal}"
    if state != "active":
        level, message = DiagnosticStatus.WARN, state
    if failure:
        level, message = DiagnosticStatus.ERROR, failure
    path, points = ("", 0) if model is None else (model.path, len(model.target.points))
    values = {"state": state, "model_path": path, "model_points": points, **_of_cloud(last)}
    values |= {
        "frames_received": counters.received, "frames_dropped": counters.dropped,
        "frames_accepted": counters.accepted, "frames_refused": counters.refused, "frames_merged": counters.merged,
        "frames_lost": counters.lost,
        "consecutive_refusals": counters.consecutive_refusals, "last_refusal": counters.last_refusal,
        "cloud_qos": source.qos, "publishers_on_points": source.publishers,
    }  # fmt: skip
    return _status(level, f"{name}: registration", message, values)


def input_status(name: str, counters: Counters, source: Input | None, last: Outcome | None) -> DiagnosticStatus:
    """Whether clouds come, and come whole."""
    silent_s = time.monotonic() - counters.last_cloud_at
    level, message = DiagnosticStatus.OK, f"{counters.received} clouds"
    if source is None:
        message, source = "not listening", Input()
    elif source.mismatch:
        level, message = DiagnosticStatus.ERROR, source.mismatch
    elif last is not None and last.reason is Reason.BAD_FIELDS:
        level, message = DiagnosticStatus.ERROR, f"{last.reason}: {last.text}"
    elif not source.publishers:
        level, message = DiagnosticStatus.WARN, "nobody publishes clouds"
    elif silent_s > SILENCE_S:
        level, message = DiagnosticStatus.WARN, f"no cloud for {silent_s:.0f} s"
    values = {"frames_received": counters.received, "frames_lost": counters.lost, "seconds_since_last": silent_s,
              "publishers_on_points": source.publishers, "cloud_qos": source.qos}  # fmt: skip
    return _status(level, f"{name}: input", message, values)


def _of_cloud(last: Outcome | None) -> dict[str, object]:
    names = ("cloud_stamp", "cloud_frame", "points_in", "points_used", "cloud_age_s", "confidence", "tre_mm",
             "inlier_ratio", "found_by", "exec_ms")  # fmt: skip
    if last is None:
        return dict.fromkeys(names, "")
    stamp = f"{last.header.stamp.sec}.{last.header.stamp.nanosec:09d}"
    values = (stamp, last.cloud_frame, last.points_in, last.points_used, last.age_s, last.confidence_out,
              last.tre_mm, last.inlier_ratio, last.found_by, last.exec_ms)  # fmt: skip
    return dict(zip(names, values, strict=True))


def _status(level: bytes, name: str, message: str, values: dict[str, object]) -> DiagnosticStatus:
    pairs = [KeyValue(key=key, value=_text(value)) for key, value in values.items()]
    return DiagnosticStatus(level=level, name=name, message=message, hardware_id="gapr", values=pairs)


def _text(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)
