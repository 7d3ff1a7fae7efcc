"""What the node says about itself: counters, and two DiagnosticStatus for /diagnostics."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from gapr_ros.node import timeline, units
from gapr_ros.node.guard import THROTTLE_S
from gapr_ros.node.model import Model
from gapr_ros.node.outcome import Outcome
from gapr_ros.node.refusal import Reason

SILENCE_S = 2.0
LARGE = "; by best effort clouds of more than 0.5 MB may never come: let their publisher be reliable"
LOST_FOR_S = 5.0  # after a cloud was lost the input is not well


@dataclass
class Counters:
    """Every cloud that was received is accepted, refused, followed, dropped, merged with a newer one, or on its way.

    One that ~/register asks for again is accepted or refused again.

    `lost` are those that a publisher sent and that never arrived.
    """

    received: int = 0
    dropped: int = 0
    accepted: int = 0
    refused: int = 0
    followed: int = 0
    merged: int = 0
    lost: int = 0
    consecutive_refusals: int = 0
    last_refusal: str = ""
    last_cloud_at: float = field(default_factory=time.monotonic)
    last_lost_at: float = float("-inf")

    def count_lost(self, count: int) -> None:
        """So many clouds more were sent and never came; fewer than none where some were missed by mistake."""
        self.lost += count
        if count > 0:
            self.last_lost_at = time.monotonic()

    def count_received(self) -> None:
        """A cloud came."""
        self.received += 1
        self.last_cloud_at = time.monotonic()

    def forget_refusals(self) -> None:
        """Nothing was refused yet of what comes now; the counts go on."""
        self.consecutive_refusals, self.last_refusal = 0, ""

    def count_pushed_out(self, merged: bool) -> None:
        """A cloud that was pushed out is registered with a newer one, or could not be."""
        self.merged += merged
        self.dropped += not merged

    def count_followed(self, shown: bool) -> None:
        """A cloud was followed; where its pose may not be shown any more, it is dropped."""
        self.followed += shown
        self.dropped += not shown

    def count_answer(self, outcome: Outcome) -> None:
        """A cloud was answered."""
        if outcome.ok:
            self.accepted += 1
            self.consecutive_refusals = 0
            return
        self.refused += 1
        self.consecutive_refusals += 1
        self.last_refusal = f"{outcome.reason}: {outcome.text}" if outcome.text else str(outcome.reason)


@dataclass
class CloudTopic:
    """What is known about the topic of the clouds.

    Attributes:
        qos: what it is subscribed with.
        publishers: how many there are.
        mismatch: why no cloud of some of them comes; empty when all can.
    """

    qos: str = ""
    publishers: int = 0
    mismatch: str = ""


class RefusalLog:
    """Writes a refusal when the last line of its reason is `THROTTLE_S` old, with the number of those in between."""

    def __init__(self, write: Callable[[str], None]) -> None:
        self._write = write
        self._at: dict[Reason | None, float] = {}
        self._silent: Counter[Reason | None] = Counter()

    def __call__(self, outcome: Outcome) -> None:
        """Log one refusal, or count it."""
        reason, now = outcome.reason, time.monotonic()
        if now - self._at.get(reason, float("-inf")) < THROTTLE_S:
            self._silent[reason] += 1
            return
        silent = self._silent.pop(reason, 0)
        more = f" ({silent} more of these since the last line)" if silent else ""
        self._write(f"cloud in '{outcome.cloud_frame}' {outcome}{more}")
        self._at[reason] = now


@dataclass(frozen=True)
class Snapshot:
    """What the node knows of itself at one moment.

    Attributes:
        name: of the node, with its namespace.
        state: of its lifecycle.
        enabled: by ~/set_enabled.
        loading: which bone is being read, and for how long; empty when none is.
        failure: why the last transition failed; empty when it did not.
        counters: what became of every cloud.
        model: the bone, when there is one.
        last: what became of the last cloud.
        topic: of the clouds, what is known about it.
        listening: whether it is subscribed to.
        conflicts: what is wrong around the node.
        hardware_id: the bone's file.
        child_frame: what goes to /tf as child; empty when nothing does.
        overdue_s: how long a cloud has been in hand, where that is longer than `tf_timeout` and `timeout`; else 0.
    """

    name: str
    state: str
    enabled: bool
    loading: str
    failure: str
    counters: Counters
    model: Model | None
    last: Outcome | None
    topic: CloudTopic
    listening: bool
    conflicts: tuple[str, ...]
    hardware_id: str
    child_frame: str
    overdue_s: float


def registration_status(now: Snapshot) -> DiagnosticStatus:
    """The state of the registration."""
    level, message = _level(now)
    counters, topic = now.counters, now.topic
    path, points = ("", 0) if now.model is None else (now.model.path, len(now.model.target.points))
    values = {
        "state": now.state,
        "child_frame": now.child_frame,
        "model_path": path,
        "model_points": points,
        **_of_cloud(now.last),
    }
    values |= {
        "frames_received": counters.received, "frames_dropped": counters.dropped,
        "frames_accepted": counters.accepted, "frames_refused": counters.refused, "frames_merged": counters.merged,
        "frames_followed": counters.followed, "frames_lost": counters.lost,
        "consecutive_refusals": counters.consecutive_refusals, "last_refusal": counters.last_refusal,
        "cloud_qos": topic.qos, "publishers_on_points": topic.publishers,
    }  # fmt: skip
    return status_message(level, f"{now.name}: registration", now.hardware_id, message, values)


def _level(now: Snapshot) -> tuple[bytes, str]:
    """How bad it is, and the sentence that says so; the worst wins."""
    if now.failure and not now.loading:
        return DiagnosticStatus.ERROR, now.failure
    if now.state != "active":
        return DiagnosticStatus.WARN, f"{now.state}, {now.loading}" if now.loading else now.state
    if not now.enabled:
        return DiagnosticStatus.WARN, "disabled: clouds are dropped until ~/set_enabled"
    if now.overdue_s:
        how = "no pose comes before it ends; start the node again if it does not"
        return DiagnosticStatus.WARN, f"a cloud has been registered for {now.overdue_s:.0f} s, beyond timeout: {how}"
    if now.counters.consecutive_refusals:
        return DiagnosticStatus.WARN, f"refused: {now.counters.last_refusal}"
    return DiagnosticStatus.OK, f"{now.state}, {now.counters.accepted} accepted, {now.counters.refused} refused"


def input_status(now: Snapshot) -> DiagnosticStatus:
    """Whether clouds come, and come whole."""
    silent_s = time.monotonic() - now.counters.last_cloud_at
    level, message = _level_of_input(now, silent_s)
    values = {
        "frames_received": now.counters.received,
        "frames_lost": now.counters.lost,
        "seconds_since_last": silent_s,
        "publishers_on_points": now.topic.publishers,
        "cloud_qos": now.topic.qos,
        "conflicts": "; ".join(now.conflicts),
    }
    return status_message(level, f"{now.name}: input", now.hardware_id, message, values)


def _level_of_input(now: Snapshot, silent_s: float) -> tuple[bytes, str]:
    if not now.listening:
        return DiagnosticStatus.OK, "not listening"
    if now.topic.mismatch:
        return DiagnosticStatus.ERROR, now.topic.mismatch
    if now.last is not None and now.last.reason is Reason.BAD_FIELDS:
        return DiagnosticStatus.ERROR, f"{now.last.reason}: {now.last.text}"
    if now.conflicts:
        return DiagnosticStatus.WARN, "; ".join(now.conflicts)
    if not now.topic.publishers:
        return DiagnosticStatus.WARN, "nobody publishes clouds"
    may_be_large = LARGE if "best_effort" in now.topic.qos else ""
    if time.monotonic() - now.counters.last_lost_at < LOST_FOR_S:
        how = f"crop or thin clouds before they are sent, or send fewer{may_be_large}"
        return DiagnosticStatus.WARN, f"{now.counters.lost} clouds were sent and never came: {how}"
    if silent_s > SILENCE_S:
        return DiagnosticStatus.WARN, f"no cloud for {silent_s:.0f} s{may_be_large}"
    return DiagnosticStatus.OK, f"{now.counters.received} clouds"


def _of_cloud(last: Outcome | None) -> dict[str, object]:
    names = ("cloud_stamp", "cloud_frame", "points_in", "points_used", "cloud_age_s", "confidence", "tre_mm",
             "tre95_mm", "inlier_ratio", "found_by", "seen_from", "exec_ms")  # fmt: skip
    if last is None:
        return dict.fromkeys(names, "")
    stamp = timeline.stamp_text(last.header)
    camera_m = "" if last.seen_from is None else " ".join(f"{x:.3f}" for x in units.to_metres(last.seen_from))
    values = (stamp, last.cloud_frame, last.points_in, last.points_used, last.age_s, last.confidence_out,
              last.tre_mm, last.tre95_mm, last.inlier_ratio, last.found_by, camera_m, last.exec_ms)  # fmt: skip
    return dict(zip(names, values, strict=True))


def status_message(
    level: bytes, name: str, hardware_id: str, message: str, values: Mapping[str, object]
) -> DiagnosticStatus:
    """A status with its values as text."""
    pairs = [KeyValue(key=key, value=_text(value)) for key, value in values.items()]
    return DiagnosticStatus(level=level, name=name, message=message, hardware_id=hardware_id, values=pairs)


def _text(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.0f}" if 1e4 <= abs(value) < 1e15 else f"{value:.4g}"
    return str(value)
