"""What the node says about itself: conflicts around it, the log of refusals, and /diagnostics in every state."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.qos import QoSProfile

from gapr_core.results import RegistrationResult
from gapr_ros.node import units
from gapr_ros.node.host import THROTTLE_S, Host, guarded
from gapr_ros.node.outcome import Counters, Outcome, Reason

if TYPE_CHECKING:
    from gapr_ros.node.model import Loader

SILENCE_S = 5.0  # without a cloud: said in the log, and an error once one has come
OVERDUE_S = 10.0  # a registration that takes longer may never end
LOST_FOR_S = 5.0  # after a cloud was lost the input is not well
PERIOD_S = 1.0
LARGE = "; by best effort clouds above 0.5 MB may never come: let their publisher be reliable"


class Conflicts:
    """What is wrong around the node and not in a cloud: said once, and shown while it lasts.

    The executor's thread only.

    Args:
        write: logs a sentence when it is new.
    """

    def __init__(self, write: Callable[[str], None]) -> None:
        self._write = write
        self._texts: dict[str, str] = {}
        self._until: dict[str, float] = {}

    def note(self, kind: str, text: str, for_s: float = float("inf")) -> None:
        """Note one of this kind, for `for_s` unless it is seen again; an empty text ends it."""
        now = time.monotonic()
        lasts = now < self._until.get(kind, now)
        if text and not (lasts and text == self._texts[kind]):
            self._write(text)
        self._texts[kind], self._until[kind] = text, now + for_s

    @property
    def texts(self) -> tuple[str, ...]:
        """Those that last, in the order in which their kinds were first seen."""
        now = time.monotonic()
        return tuple(text for kind, text in self._texts.items() if text and now < self._until[kind])


def names_of(publishers: Iterable[Any]) -> str:
    """Join the full names of the nodes that publish with commas."""
    return ", ".join(f"{each.node_namespace.rstrip('/')}/{each.node_name}" for each in publishers)


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
        self._write(outcome.line + (f" (+{silent})" if silent else ""))
        self._at[reason] = now


@dataclass
class CloudTopic:
    """The topic of the clouds: its QoS here, the number of its publishers, and why no cloud of some of them comes."""

    qos: str = ""
    publishers: int = 0
    mismatch: str = ""


@dataclass(frozen=True)
class Snapshot:
    """The node at one moment.

    Attributes:
        name: of the node, with its namespace.
        state: of its lifecycle.
        enabled: by ~/set_enabled.
        loading: which bone is being read, and for how long; empty when none is.
        failure: why the last transition failed; empty when it did not.
        counters: what became of every cloud.
        error_after: refusals in a row that are an error; 0: none.
        withdrawn: why the last pose was withdrawn; empty while one stands, and before the first.
        last: what became of the last cloud.
        topic: of the clouds; None when it is not subscribed.
        conflicts: what is wrong around the node.
        hardware_id: the bone's file.
        overdue_s: how long a cloud has been in hand, where that is long; else 0.
    """

    name: str
    state: str
    enabled: bool
    loading: str
    failure: str
    counters: Counters
    error_after: int
    withdrawn: str
    last: Outcome | None
    topic: CloudTopic | None
    conflicts: tuple[str, ...]
    hardware_id: str
    overdue_s: float


def registration_status(now: Snapshot) -> DiagnosticStatus:
    """Report the state of the registration."""
    level, message = _level(now)
    counters, topic, last = now.counters, now.topic or CloudTopic(), now.last
    result = None if last is None else last.result
    seen = None if last is None or last.seen_from is None else units.to_metres(last.seen_from)
    values = {
        "state": now.state,
        "cloud_age": None if last is None else last.age_s,
        "points_in": None if last is None else last.points_in,
        "points_on_table": None if last is None else last.points_on_table,
        "points_used": None if last is None else last.points_used,
        "found_by": "" if result is None else result.proposer,
        "seen_from": "" if seen is None else " ".join(f"{x:.3f}" for x in seen),
        "seconds": None if last is None else last.exec_s,
        "frames_received": counters.received, "frames_dropped": counters.dropped,
        "frames_accepted": counters.accepted, "frames_refused": counters.refused, "frames_merged": counters.merged,
        "frames_lost": counters.lost, "consecutive_refusals": counters.consecutive_refusals,
        "last_refusal": counters.last_refusal, "cloud_qos": topic.qos, "publishers_on_points": topic.publishers,
        "warnings": warnings_of(result),
    }  # fmt: skip
    return status_message(level, f"{now.name}: registration", now.hardware_id, message, values)


def warnings_of(result: RegistrationResult | None) -> str:
    """List the caveats of a result, each with its code."""
    return "" if result is None else "; ".join(f"{each.code}: {each.text}" for each in result.warnings)


def _level(now: Snapshot) -> tuple[bytes, str]:
    """Choose level and sentence; the worst wins."""
    refusals, counters = now.counters.consecutive_refusals, now.counters
    if now.failure and not now.loading:
        return DiagnosticStatus.ERROR, now.failure
    if now.state != "active":
        return DiagnosticStatus.WARN, f"{now.state}, {now.loading}" if now.loading else now.state
    if not now.enabled:
        return DiagnosticStatus.WARN, "disabled: clouds are dropped until ~/set_enabled"
    if now.overdue_s:
        how = "no pose comes before it ends; start the node again if it does not"
        return DiagnosticStatus.WARN, f"a cloud has been registered for {now.overdue_s:.0f} s: {how}"
    if 0 < now.error_after <= refusals:
        return DiagnosticStatus.ERROR, f"{refusals} refusals in a row: {counters.last_refusal}"
    if now.withdrawn:
        return DiagnosticStatus.ERROR, f"the pose was withdrawn: {now.withdrawn}"
    if refusals:
        return DiagnosticStatus.WARN, f"refused: {counters.last_refusal}"
    return DiagnosticStatus.OK, f"{now.state}, {counters.accepted} accepted, {counters.refused} refused"


def input_status(now: Snapshot) -> DiagnosticStatus:
    """Report if clouds come, and come whole."""
    last_at = now.counters.last_cloud_at
    silent_s = None if last_at is None else time.monotonic() - last_at
    level, message = _level_of_input(now, silent_s)
    topic = now.topic or CloudTopic()
    values = {
        "frames_received": now.counters.received,
        "frames_lost": now.counters.lost,
        "seconds_since_last": silent_s,
        "publishers_on_points": topic.publishers,
        "cloud_qos": topic.qos,
        "conflicts": "; ".join(now.conflicts),
    }
    return status_message(level, f"{now.name}: input", now.hardware_id, message, values)


def _level_of_input(now: Snapshot, silent_s: float | None) -> tuple[bytes, str]:
    if now.topic is None:
        return DiagnosticStatus.OK, "not listening"
    if now.topic.mismatch:
        return DiagnosticStatus.ERROR, now.topic.mismatch
    if now.last is not None and now.last.reason is Reason.BAD_FIELDS:
        return DiagnosticStatus.ERROR, f"{now.last.reason}: {now.last.text}"
    may_be_large = LARGE if "best_effort" in now.topic.qos else ""
    if silent_s is not None and silent_s > SILENCE_S:
        return DiagnosticStatus.ERROR, f"no cloud for {silent_s:.0f} s{may_be_large}"
    if now.conflicts:
        return DiagnosticStatus.WARN, "; ".join(now.conflicts)
    if silent_s is None:
        return DiagnosticStatus.WARN, f"no cloud has come yet{may_be_large}"
    if time.monotonic() - now.counters.last_lost_at < LOST_FOR_S:
        how = f"crop or thin clouds before they are sent, or send fewer{may_be_large}"
        return DiagnosticStatus.WARN, f"{now.counters.lost} clouds were sent and never came: {how}"
    return DiagnosticStatus.OK, f"{now.counters.received} clouds"


def status_message(
    level: bytes, name: str, hardware_id: str, message: str, values: Mapping[str, object]
) -> DiagnosticStatus:
    """Make a status with its values as text; None is empty."""
    pairs = [KeyValue(key=key, value=_text(value)) for key, value in values.items()]
    return DiagnosticStatus(level=level, name=name, message=message, hardware_id=hardware_id, values=pairs)


def _text(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.9g}" if isinstance(value, float) else str(value)


class Reported(Host, Protocol):
    """The node, as it is reported on.

    Attributes:
        failure: why the last transition failed; empty when it did not.
        session: what lives between configure and cleanup.
        subscriptions_in: what it listens with while it is active.
    """

    failure: str
    session: Any  # a Session or None
    subscriptions_in: Any  # Subscriptions or None

    @property
    def state(self) -> str:
        """Of its lifecycle."""
        ...


class Reporter:
    """Sends /diagnostics.

    Args:
        node: publishes.
        loader: reads bones.
    """

    def __init__(self, node: Reported, loader: Loader) -> None:
        self._node, self._loader = node, loader
        self._publisher = node.ros.create_publisher(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))

    def get_logger(self) -> object:
        """Return the node's logger (for `guarded`)."""
        return self._node.ros.get_logger()

    @guarded
    def send(self) -> None:
        """Two statuses: registration and input."""
        now = self._look()
        message = DiagnosticArray(status=[registration_status(now), input_status(now)])
        message.header.stamp = self._node.ros.get_clock().now().to_msg()
        self._publisher.publish(message)

    def _look(self) -> Snapshot:
        node, session, listening = self._node, self._node.session, self._node.subscriptions_in
        busy_s = 0.0 if session is None else session.worker.busy_s
        path = node.parameters.model_path if session is None else session.model.path  # the one in use
        return Snapshot(
            name=node.ros.get_fully_qualified_name(),
            state=node.state,
            enabled=session is None or session.enabled,
            loading=str(self._loader),
            failure=node.failure,
            counters=node.counters,
            error_after=node.parameters.error_after,
            withdrawn="" if session is None else session.withdrawn,
            last=None if session is None else session.last_outcome,
            topic=None if listening is None else listening.describe(),
            conflicts=() if session is None else session.conflicts.texts,
            hardware_id=Path(path).name or "no model",
            overdue_s=busy_s if busy_s > OVERDUE_S else 0.0,
        )
