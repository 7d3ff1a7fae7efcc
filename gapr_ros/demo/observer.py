"""Watches what register_node answers, as any other ROS program could: which cloud, pose or reason, how late."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from numpy.typing import NDArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Float64

from gapr_ros import intake, wire
from msg_adapters import pose_to_matrix


@dataclass
class Answer:
    """What came back for one cloud.

    Attributes:
        T_target_source: (4, 4), mm, of an accepted pose.
        refusal: why there is none.
        confidence, tre_mm: as the node says.
        exec_ms: what the node says that it took.
        heard_s: when the answer arrived here, on the monotonic clock.
        sent_s: when the cloud was sent.
    """

    T_target_source: NDArray[np.float64] | None = None
    refusal: str = ""
    confidence: float = 0.0
    tre_mm: float | None = None
    exec_ms: float = 0.0
    heard_s: float = float("nan")
    sent_s: float = float("nan")

    @property
    def latency_ms(self) -> float:
        """From sending the cloud to hearing the answer."""
        return 1000.0 * (self.heard_s - self.sent_s)


class Observer(Node):
    """Collects answers by the stamp of the cloud, ms, and what the node says of itself.

    Args:
        node_name: of the register_node to watch.
        kwargs: of rclpy's Node.
    """

    def __init__(self, node_name: str = "register_node", **kwargs: Any) -> None:
        super().__init__("gapr_observer", **kwargs)
        self.answers: dict[int, Answer] = {}
        self.confidences = 0
        self.node_state, self.node_failure = "", ""
        self.player_found, self.dropped = False, 0
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self)
        self._status_name = f"{node_name}: registration"
        self._sent: dict[int, float] = {}
        self._poses: dict[int, NDArray[np.float64]] = {}
        self.create_subscription(PoseWithCovarianceStamped, f"{node_name}/pose", self._on_pose, 50)
        self.create_subscription(Float64, f"{node_name}/confidence", self._on_confidence, 50)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)

    def listen(self, seconds: float) -> None:
        """Take in what comes, one message or nothing, waiting at most that long."""
        self._executor.spin_once(timeout_sec=seconds)

    @property
    def sent(self) -> int:
        """How many clouds have been sent."""
        return len(self._sent)

    def note_sent(self, topic: str, stamp_ns: int) -> None:
        """A cloud with this stamp has just been sent."""
        self._sent[_ms(stamp_ns)] = time.monotonic()

    def _on_confidence(self, message: Float64) -> None:
        self.confidences += 1

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        stamp = _ms(intake.stamp_ns(message.header))
        self._poses[stamp] = wire.core_pose(pose_to_matrix(message))
        if stamp in self.answers:
            self.answers[stamp].T_target_source = self._poses[stamp]

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == self._status_name:
                self._on_registration(status, {pair.key: pair.value for pair in status.values})

    def _on_registration(self, status: DiagnosticStatus, values: dict[str, str]) -> None:
        self.node_state = values["state"]
        self.player_found, self.dropped = int(values["publishers_on_points"]) > 0, int(values["frames_dropped"])
        self.node_failure = status.message if status.level == DiagnosticStatus.ERROR else ""
        stamp = _milliseconds(values["cloud_stamp"])
        if stamp is None or stamp in self.answers:
            return
        refused = int(values["consecutive_refusals"]) > 0
        self.answers[stamp] = Answer(
            T_target_source=self._poses.get(stamp),
            refusal=values["last_refusal"] if refused else "",
            confidence=float(values["confidence"] or 0.0),
            tre_mm=float(values["tre_mm"]) if values["tre_mm"] else None,
            exec_ms=float(values["exec_ms"] or 0.0),
            heard_s=time.monotonic(),
            sent_s=self._sent.get(stamp, float("nan")),
        )


def _ms(stamp_ns: int) -> int:
    return round(stamp_ns * 1e-6)


def _milliseconds(stamp_s: str) -> int | None:
    """Seconds in decimal, as diagnostics write them; None when no cloud has come yet."""
    return round(float(stamp_s) * 1e3) if stamp_s else None
