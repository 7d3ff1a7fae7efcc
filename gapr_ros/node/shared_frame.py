"""Finds others that publish this bone's frame on /tf: the frame would jump between their poses and ours."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped

from gapr_ros.node.conflicts import Conflicts
from gapr_ros.node.guard import guarded
from gapr_ros.node.host import Host
from gapr_ros.node.intake import plain_frame

KIND = "child frame"
LASTS_S = 5.0  # a conflict that is not seen again for so long is over
REMEMBERED = 50  # own transforms, to know them when they come back from /tf


class SharedFrame:
    """Watches /diagnostics, where every register_node names the frame that it publishes, and /tf where tf2_msgs is.

    Args:
        host: the node.
        conflicts: where a finding goes.
    """

    def __init__(self, host: Host, conflicts: Conflicts) -> None:
        self._host, self._conflicts = host, conflicts
        self._frame, self._own = host.parameters.model_frame, host.ros.get_fully_qualified_name()
        self._sent: deque[tuple[int, int, str]] = deque(maxlen=REMEMBERED)
        self._who, self._has_name, self._seen_at = "", False, float("-inf")
        listen = host.ros.create_subscription
        self._subscriptions = [listen(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)]
        kind = _tf_message()
        if kind is not None:
            self._subscriptions.append(listen(kind, "/tf", self._on_tf, 100))

    def get_logger(self) -> Any:
        """The node's logger (for `guarded`)."""
        return self._host.ros.get_logger()

    def note_own(self, transform: TransformStamped) -> None:
        """This one is ours."""
        self._sent.append(_key(transform))

    def close(self) -> None:
        """Listen no more."""
        for subscription in self._subscriptions:
            self._host.ros.destroy_subscription(subscription)

    @guarded
    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            name, _, task = status.name.rpartition(": ")
            values = {pair.key: pair.value for pair in status.values}
            if task == "registration" and name != self._own and values.get("child_frame") == self._frame:
                self._note(name, has_name=True)

    @guarded
    def _on_tf(self, message: Any) -> None:
        for transform in message.transforms:
            if plain_frame(transform.child_frame_id) == self._frame and _key(transform) not in self._sent:
                self._note(f"another node, as child of '{transform.header.frame_id}',", has_name=False)

    def _note(self, who: str, has_name: bool) -> None:
        """One conflict is one sentence, though it is seen on two topics and with several others: news are logged."""
        now = time.monotonic()
        if now - self._seen_at > LASTS_S or has_name > self._has_name:
            self._who, self._has_name = who, has_name
        if who == self._who:
            self._seen_at = now
        text = f"{self._who} publishes '{self._frame}' on /tf too: give each bone a model_frame of its own"
        self._conflicts.note(KIND, text, LASTS_S)


def _key(transform: TransformStamped) -> tuple[int, int, str]:
    stamp = transform.header.stamp
    return stamp.sec, stamp.nanosec, transform.header.frame_id


def _tf_message() -> Any | None:
    """Part of a ROS installation, not of the wheels."""
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError:
        return None
    return TFMessage
