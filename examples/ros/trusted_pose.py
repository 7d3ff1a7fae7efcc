"""A consumer that acts on a pose only when it may: enough confidence, a bounded error, and the right time.

python examples/ros/trusted_pose.py --ros-args -p min_confidence:=0.9 -p max_tre:=0.002

It hears ~/status, which comes with every cloud and carries the cloud's stamp, and takes the pose of exactly that stamp:
from tf2 where it is installed, so that any other frame can be asked for, else from ~/transform. The latest transform is
never used: it may be that of another cloud.
"""

from __future__ import annotations

import sys

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.signals import uninstall_signal_handlers
from rclpy.time import Time

WAIT_S = 0.5  # a status and its transform are sent together; more than this apart, one of them was lost


class TrustedPose(Node):
    """Calls `act` with every pose that may be used, and `hold` with the reason for every other cloud."""

    def __init__(self, **kwargs: object) -> None:
        super().__init__("trusted_pose", **kwargs)
        declare = self.declare_parameter
        self.min_confidence = declare("min_confidence", 0.9).value
        self.max_tre = declare("max_tre", 0.002).value  # m, 95 % bound over the whole bone
        self.frame = declare("frame", "").value  # that of the pose when empty; another one needs tf2
        self.bone = declare("bone_frame", "bone_preop").value
        source = declare("register_node", "register_node").value
        self.waiting: dict[tuple[int, int], dict[str, str]] = {}
        self.transforms: dict[tuple[int, int], TransformStamped] = {}
        self.buffer = self._listen_to_tf2()
        self.create_subscription(DiagnosticStatus, f"{source}/status", self._on_status, 10)
        self.create_subscription(TransformStamped, f"{source}/transform", self._on_transform, 10)

    def act(self, transform: TransformStamped, values: dict[str, str]) -> None:
        """Use the pose; replace this."""
        t = transform.transform.translation
        place = f"({t.x:.4f}, {t.y:.4f}, {t.z:.4f}) m in {transform.header.frame_id}"
        self.get_logger().info(f"bone at {place}, confidence {values['confidence']}, within {values['tre95']} m")

    def hold(self, why: str) -> None:
        """Do without; replace this."""
        self.get_logger().warning(f"no pose: {why}")

    def _on_status(self, status: DiagnosticStatus) -> None:
        values = {pair.key: pair.value for pair in status.values}
        why = self._why_not(status, values)
        if why:
            self.hold(why)
            return
        self.waiting[_key(values["stamp"])] = values
        self._meet()

    def _why_not(self, status: DiagnosticStatus, values: dict[str, str]) -> str:
        """Empty when the pose may be used."""
        if status.level != DiagnosticStatus.OK:
            return values["reason"]
        if float(values["confidence"]) < self.min_confidence:
            return f"confidence {values['confidence']} is below {self.min_confidence:g}"
        if not values["tre95"] or float(values["tre95"]) > self.max_tre:
            return f"the error is bounded by {values['tre95'] or 'nothing'} m only, {self.max_tre:g} m are allowed"
        return ""

    def _on_transform(self, transform: TransformStamped) -> None:
        stamp = transform.header.stamp
        self.transforms[stamp.sec, stamp.nanosec] = transform
        self._meet()

    def _meet(self) -> None:
        """Act on every stamp of which both messages are here, and forget what is older."""
        for key in sorted(set(self.waiting) & set(self.transforms)):
            self.act(self._at(self.transforms[key]), self.waiting[key])
            self.waiting = {k: v for k, v in self.waiting.items() if k > key}
            self.transforms = {k: v for k, v in self.transforms.items() if k > key}

    def _at(self, transform: TransformStamped) -> TransformStamped:
        """The pose in the frame that was asked for, at the stamp of the cloud."""
        if not self.frame or self.frame == transform.header.frame_id:
            return transform
        if self.buffer is None:
            raise RuntimeError(f"frame {self.frame} needs tf2_ros, which is part of a ROS installation")
        stamp = Time.from_msg(transform.header.stamp)
        return self.buffer.lookup_transform(self.frame, self.bone, stamp, Duration(seconds=WAIT_S))

    def _listen_to_tf2(self) -> object | None:
        if not self.frame:
            return None
        import tf2_ros

        buffer = tf2_ros.Buffer(node=self)
        self.listener = tf2_ros.TransformListener(buffer, self, spin_thread=True)
        return buffer


def _key(stamp: str) -> tuple[int, int]:
    """`12.000000034` as (12, 34)."""
    seconds, _, nanoseconds = stamp.partition(".")
    return int(seconds), int(nanoseconds)


def main() -> None:
    """Run until it is stopped."""
    rclpy.init(args=sys.argv)
    try:
        rclpy.spin(TrustedPose())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    uninstall_signal_handlers()  # ends rclpy's thread for signals first: it shuts down too, and twice is an error
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
