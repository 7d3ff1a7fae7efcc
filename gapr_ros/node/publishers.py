"""What the node sends: the bone once, and for every cloud a confidence and, when accepted, a pose."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64, Header

from gapr_core.geometry import se3
from gapr_ros import intake, wire
from gapr_ros.frames import Frames
from gapr_ros.model import Model
from gapr_ros.outcome import Outcome
from msg_adapters import covariance_to_list, matrix_to_pose, matrix_to_transform, xyz_to_cloud

if TYPE_CHECKING:
    from rclpy.lifecycle import LifecycleNode, LifecyclePublisher

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Publishers:
    """The topics under `~/`, and /tf; silent while the node is not active."""

    def __init__(self, node: LifecycleNode, frames: Frames, model_frame: str) -> None:
        self._node, self._frames, self._model_frame = node, frames, model_frame
        self._pose = self._advertise_pose()
        self._transform = node.create_lifecycle_publisher(TransformStamped, "~/transform", 10)
        self._confidence = node.create_lifecycle_publisher(Float64, "~/confidence", 10)
        self._model = node.create_lifecycle_publisher(PointCloud2, "~/model", LATCHED)
        self._aligned = node.create_lifecycle_publisher(PointCloud2, "~/aligned", 1)

    def send_model(self, model: Model) -> None:
        """The bone, latched, in its own frame."""
        header = Header(frame_id=self._model_frame, stamp=self._node.get_clock().now().to_msg())
        self._model.publish(xyz_to_cloud(wire.to_metres(model.points_mm).astype("f4"), header))

    def send(self, outcome: Outcome, model: Model) -> None:
        """The confidence of every cloud, then the pose of an accepted one."""
        self._confidence.publish(Float64(data=outcome.confidence_out))
        if not outcome.ok:
            return
        message = PoseWithCovarianceStamped(header=outcome.header)
        message.pose.pose = matrix_to_pose(outcome.pose)
        message.pose.covariance = covariance_to_list(outcome.covariance)
        self._pose.publish(message)
        self._send_transform(outcome)
        self._send_aligned(outcome, model)

    def withdraw_pose(self) -> None:
        """No late listener gets the last pose any more: the topic is given up and taken anew."""
        old, self._pose = self._pose, self._advertise_pose()
        if old.is_activated:
            self._pose.on_activate(None)
        self._node.destroy_lifecycle_publisher(old)

    def close(self) -> None:
        """Give the topics back."""
        for publisher in (self._pose, self._transform, self._confidence, self._model, self._aligned):
            self._node.destroy_lifecycle_publisher(publisher)

    def _advertise_pose(self) -> LifecyclePublisher:
        return self._node.create_lifecycle_publisher(PoseWithCovarianceStamped, "~/pose", LATCHED)

    def _send_transform(self, outcome: Outcome) -> None:
        transform = TransformStamped(header=outcome.header, child_frame_id=self._model_frame)
        transform.transform = matrix_to_transform(outcome.pose)
        self._transform.publish(transform)
        self._frames.send(transform, intake.stamp_ns(outcome.header))

    def _send_aligned(self, outcome: Outcome, model: Model) -> None:
        if self._aligned.get_subscription_count():
            points = se3.apply(outcome.pose, wire.to_metres(model.points_mm))
            self._aligned.publish(xyz_to_cloud(points.astype("f4"), outcome.header))
