"""What the node sends: the bone once, for every cloud what became of it, and a pose when it is accepted."""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseArray, PoseStamped, PoseWithCovarianceStamped, TransformStamped
from numpy.typing import NDArray
from rclpy.lifecycle import LifecyclePublisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64, Header

from gapr_core.geometry import se3
from gapr_ros.node import messages, timeline, units
from gapr_ros.node.frames import Frames
from gapr_ros.node.host import Host
from gapr_ros.node.model import Model
from gapr_ros.node.outcome import Found, Outcome
from msg_adapters import covariance_to_list, matrix_to_pose, matrix_to_transform, xyz_to_cloud

Array = NDArray[np.float64]
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
TOPICS = {
    "pose": (PoseWithCovarianceStamped, LATCHED),
    "transform": (TransformStamped, 10),
    "followed_pose": (PoseStamped, 10),
    "confidence": (Float64, 10),
    "status": (DiagnosticStatus, 10),
    "check": (DiagnosticStatus, 10),
    "hypotheses": (PoseArray, 10),
    "residuals": (PointCloud2, 1),
    "guidance": (PointCloud2, 1),
    "next_view": (PoseStamped, 1),
    "model": (PointCloud2, LATCHED),
    "aligned": (PointCloud2, 1),
}


class Publishers:
    """The topics under `~/`, and /tf; silent while the node is not active."""

    def __init__(self, host: Host, frames: Frames) -> None:
        self._host, self._frames, self._vision = host, frames, messages.vision_types()
        self._kinds = dict(TOPICS)
        if self._vision is not None:
            self._kinds["detection"] = self._vision.Detection3DArray, 10
        self._topics = {name: self._advertise(name) for name in self._kinds}

    def send_model(self, model: Model) -> None:
        """The bone, latched, in its own frame."""
        header = self._of_model(Time())  # stamp 0: wherever the frame is now; tf2 has forgotten the start after 10 s
        self._topics["model"].publish(xyz_to_cloud(units.to_metres(model.points_mm).astype("f4"), header))

    def send(self, outcome: Outcome, model: Model) -> None:
        """What became of a cloud, then its pose where it has one, then what there is to look at."""
        self._topics["confidence"].publish(Float64(data=outcome.confidence_out))
        name = self._host.ros.get_fully_qualified_name()
        self._topics["status"].publish(messages.status(outcome, name, model.file))
        if outcome.found is not None:
            self._send_pose(outcome.found, outcome.header)
            self._send_aligned(outcome.found, outcome.header, model)
        self._send_seen(outcome)
        if self._vision is not None:
            detection = messages.detection(self._vision, outcome, model.name, model.points_mm)
            self._topics["detection"].publish(detection)

    def send_followed(self, T_frame_model: Array, header: Header) -> None:
        """Where the bone is, (4, 4), metres, by a cloud that was not assessed: to be shown."""
        self._topics["followed_pose"].publish(PoseStamped(header=header, pose=matrix_to_pose(T_frame_model)))

    def send_check(self, found: DiagnosticStatus) -> None:
        """What touched points say of the last accepted pose."""
        self._topics["check"].publish(found)

    def withdraw(self, *names: str) -> None:
        """No late listener gets the last message of these any more: they are given up and advertised again."""
        for name in names:
            old, self._topics[name] = self._topics[name], self._advertise(name)
            if old.is_activated:
                self._topics[name].on_activate(None)
            self._host.ros.destroy_lifecycle_publisher(old)

    def close(self) -> None:
        """Give the topics back."""
        for publisher in self._topics.values():
            self._host.ros.destroy_lifecycle_publisher(publisher)

    def _advertise(self, name: str) -> LifecyclePublisher:
        kind, qos = self._kinds[name]
        return self._host.ros.create_lifecycle_publisher(kind, f"~/{name}", qos)

    def _of_model(self, stamp: Time) -> Header:
        return Header(frame_id=self._host.parameters.model_frame, stamp=stamp)

    def _is_heard(self, name: str) -> bool:
        return self._topics[name].get_subscription_count() > 0

    def _send_pose(self, found: Found, header: Header) -> None:
        message = PoseWithCovarianceStamped(header=header)
        message.pose.pose = matrix_to_pose(found.pose)
        message.pose.covariance = covariance_to_list(found.covariance)
        self._topics["pose"].publish(message)
        transform = TransformStamped(header=header, child_frame_id=self._host.parameters.model_frame)
        transform.transform = matrix_to_transform(found.pose)
        self._topics["transform"].publish(transform)
        self._frames.send(transform, timeline.stamp_ns(header))

    def _send_aligned(self, found: Found, header: Header, model: Model) -> None:
        if self._is_heard("aligned"):
            points = se3.apply(found.pose, units.to_metres(model.points_mm))
            self._topics["aligned"].publish(xyz_to_cloud(points.astype("f4"), header))

    def _send_seen(self, outcome: Outcome) -> None:
        """What users look at: with refusals above all."""
        if self._host.parameters.publish_hypotheses:
            self._topics["hypotheses"].publish(messages.hypotheses(outcome))
        if outcome.result is None:
            return
        residuals, guidance = outcome.result.residuals, outcome.result.guidance
        if residuals is not None and self._is_heard("residuals"):
            self._topics["residuals"].publish(messages.residuals(residuals, outcome.header))
        if guidance is not None and guidance.patches:
            # tf2 has the bone at the stamp of an accepted cloud; of a refused one, where it was last: at stamp 0
            header = self._of_model(outcome.header.stamp if outcome.ok else Time())
            self._topics["guidance"].publish(messages.guidance(guidance, header))
            self._topics["next_view"].publish(messages.next_view(guidance, header))
