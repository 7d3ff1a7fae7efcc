"""Watches what register_node answers, as any other ROS program could: which cloud, pose or reason, how late."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from numpy.typing import NDArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from gapr_ros.node import units
from gapr_ros.node.outcome import stamp_ns
from msg_adapters import cloud_to_field, cloud_to_xyz, pose_to_matrix

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Used:
    """The points of a cloud that the node looked at: (N, 3) mm in the cloud's frame, and which it took for bone."""

    points: Array
    is_taken: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Advice:
    """Where the node wants to look next.

    Attributes:
        points: (M, 3) of the bone, mm, in its own frame.
        gain_mm: (M,) what a look there would gain.
        centre: (3,) mm, of the best look.
    """

    points: Array
    gain_mm: Array
    centre: Array


@dataclass
class Answer:
    """What came back for one cloud.

    Attributes:
        T_target_source: (4, 4), mm, of an accepted pose.
        refusal: why there is none.
        confidence, tre_mm, tre95_mm: as the node says.
        exec_ms: what the node says that it took.
        heard_s: when the answer arrived here, on the monotonic clock.
        sent_s: when the cloud was sent.
        used: which points the node looked at and took for bone.
    """

    T_target_source: Array | None = None
    refusal: str = ""
    confidence: float = 0.0
    tre_mm: float | None = None
    tre95_mm: float | None = None
    exec_ms: float = 0.0
    heard_s: float = float("nan")
    sent_s: float = float("nan")
    used: Used | None = None

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
        self.node_state, self.node_failure = "", ""
        self.player_found, self.dropped = False, 0
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self)
        self._status_name = f"{self.get_namespace().rstrip('/')}/{node_name}: registration"
        self._sent: dict[int, float] = {}
        self._poses: dict[int, Array] = {}
        self._used: dict[int, Used] = {}
        self._gain: tuple[Array, Array] | None = None
        self._centre: Array | None = None
        listen = self.create_subscription
        self._heard = [
            listen(DiagnosticArray, f"{node_name}/status", self._on_status, 50),
            listen(PoseWithCovarianceStamped, f"{node_name}/pose", self._on_pose, 50),
            listen(PointCloud2, f"{node_name}/debug/residuals", self._on_residuals, 50),
            listen(PointCloud2, f"{node_name}/debug/guidance", self._on_guidance, 10),
            listen(PoseStamped, f"{node_name}/debug/next_view", self._on_next_view, 10),
        ]
        listen(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)

    def listen(self, seconds: float) -> None:
        """Take in what comes, one message or nothing, waiting at most that long."""
        self._executor.spin_once(timeout_sec=seconds)

    @property
    def sent(self) -> int:
        """How many clouds have been sent."""
        return len(self._sent)

    @property
    def node_ready(self) -> bool:
        """The node is active, has found who sends clouds, and is heard here: what is sent now is not lost."""
        heard = all(subscription.get_publisher_count() for subscription in self._heard)
        return self.node_state == "active" and self.player_found and heard

    @property
    def advice(self) -> Advice | None:
        """The last word on where to look next; None before the first, or once `forget_advice` was called."""
        return None if self._gain is None or self._centre is None else Advice(*self._gain, self._centre)

    def forget_advice(self) -> None:
        """Forget the advice of the cloud before."""
        self._gain = self._centre = None

    def note_sent(self, topic: str, stamp_ns: int) -> None:
        """Note that a cloud with this stamp has just been sent."""
        self._sent[_ms(stamp_ns)] = time.monotonic()

    def complete(self) -> None:
        """Add poses and used points to the answers: they come as messages of their own, a moment later."""
        for stamp, answer in self.answers.items():
            answer.T_target_source, answer.used = self._poses.get(stamp), self._used.get(stamp)

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        self._poses[_ms(stamp_ns(message.header))] = units.core_pose(pose_to_matrix(message))

    def _on_residuals(self, message: PointCloud2) -> None:
        points_mm = units.to_mm(cloud_to_xyz(message, keep_nan=True), "m")
        used = Used(points_mm, cloud_to_field(message, "inlier").astype(bool))
        self._used[_ms(stamp_ns(message.header))] = used

    def _on_guidance(self, message: PointCloud2) -> None:
        gain_mm = units.to_mm(cloud_to_field(message, "intensity").astype(np.float64), "m")
        self._gain = units.to_mm(cloud_to_xyz(message, keep_nan=True), "m"), gain_mm

    def _on_next_view(self, message: PoseStamped) -> None:
        self._centre = units.to_mm(pose_to_matrix(message)[:3, 3], "m")

    def _on_status(self, message: DiagnosticArray) -> None:
        (status,) = message.status
        values = {pair.key: pair.value for pair in status.values}
        if values["reason"] == "withdrawn":  # of no cloud
            return
        stamp, refused = _ms(stamp_ns(message.header)), bool(values["reason"])
        self.answers[stamp] = Answer(
            refusal=f"{values['reason']}: {values['detail']}" if refused else "",
            confidence=float(values["confidence"] or 0.0),
            tre_mm=_millimetres(values["tre"]),
            tre95_mm=_millimetres(values["tre95"]),
            exec_ms=1000.0 * float(values["seconds"] or 0.0),
            heard_s=time.monotonic(),
            sent_s=self._sent.get(stamp, float("nan")),
        )

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == self._status_name:
                self._on_registration(status, {pair.key: pair.value for pair in status.values})

    def _on_registration(self, status: DiagnosticStatus, values: dict[str, str]) -> None:
        self.node_state = values["state"]
        self.player_found, self.dropped = int(values["publishers_on_points"]) > 0, int(values["frames_dropped"])
        self.node_failure = status.message if status.level == DiagnosticStatus.ERROR else ""


def _ms(stamp_ns: int) -> int:
    return round(stamp_ns * 1e-6)


def _millimetres(metres: str) -> float | None:
    return float(units.to_mm(np.array(float(metres)), "m")) if metres else None
