"""Usage: python examples/ros/trusted_pose.py --ros-args -p topic:=/register_node/detection -p min_confidence:=0.9."""

from contextlib import suppress

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time
from vision_msgs.msg import Detection3DArray


class TrustedPose(Node):
    """Calls `act` with every pose that may be used, else `hold` with the reason: one subscription, to ~/detection."""

    def __init__(self, **kwargs):
        super().__init__("trusted_pose", **kwargs)
        self.least = self.declare_parameter("min_confidence", 0.9).value
        self.oldest = self.declare_parameter("max_age", 1.0).value  # s; 0: any, as of a bag without /clock
        topic = self.declare_parameter("topic", "/register_node/detection").value
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(Detection3DArray, topic, self.on_detection, latched)

    def on_detection(self, message):
        age = (self.get_clock().now() - Time.from_msg(message.header.stamp)).nanoseconds / 1e9
        best = message.detections[0].results[0] if message.detections else None
        if best is None or not best.hypothesis.score >= self.least or 0 < self.oldest < age:
            return self.hold("no pose" if best is None else f"confidence {best.hypothesis.score:.2f}, {age:.1f} s old")
        return self.act(best.hypothesis.class_id, message.header.frame_id, best.pose.pose, best.pose.covariance)

    def act(self, bone, frame, pose, covariance):  # replace this
        self.get_logger().info(f"{bone} in {frame} at {pose.position}, sd of x {covariance[0] ** 0.5:.4f} m")

    def hold(self, why):  # and this
        self.get_logger().warning(f"hold: {why}")


if __name__ == "__main__":
    rclpy.init()
    with suppress(KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        rclpy.spin(TrustedPose())
