"""A consumer that acts on a pose only when it may: enough confidence, a bounded error, and the right time.

python examples/ros/trusted_pose.py --ros-args -p min_confidence:=0.9 -p max_tre:=0.002 -p max_age:=1.0

It hears ~/status, which comes with every cloud and carries the cloud's stamp, and takes the pose that ~/transform has
for exactly that stamp. Neither the latest transform nor tf2's transform of the bone is used: they may be those of
another cloud. For a pose in another frame (`frame`) tf2 gives where the cloud's frame was at that stamp, unless that
was not heard for a while: tf2 draws a straight line over any gap. `max_age` leaves the pose of an old cloud, such as
one that ~/register answered once more after the camera stopped; a bag that is played without /clock needs 0, any age.
"""

from __future__ import annotations

import argparse
import math
import sys
import time

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.signals import uninstall_signal_handlers
from rclpy.time import Time
from rclpy.utilities import remove_ros_args
from std_msgs.msg import Header

from gapr_ros.node.heard import Heard
from msg_adapters import matrix_to_transform, transform_to_matrix

Stamp = tuple[int, int]
WAIT_S = 0.5  # for tf2 to know the frames at the stamp of a pose; /tf may come after ~/transform
SHUTDOWN_S = 0.5
POLL_S = 0.05


class TrustedPose(Node):
    """Calls `act` with every pose that may be used, and `hold` with the reason for every other cloud."""

    def __init__(self, **kwargs: object) -> None:
        super().__init__("trusted_pose", **kwargs)
        declare = self.declare_parameter
        self.min_confidence = declare("min_confidence", 0.9).value
        self.max_tre = declare("max_tre", 0.002).value  # m, 95 % bound over the whole bone
        self.frame = declare("frame", "").value  # that of the pose when empty; another one needs tf2
        self.bone = declare("bone_frame", "").value  # the only bone that is acted on; empty: any
        self.max_tf_gap = declare("max_tf_gap", 0.25).value  # s, between the transforms around a pose; 0: any
        self.max_age = declare("max_age", 0.0).value  # s, of the cloud when its pose is acted on; 0: any
        source = declare("register_node", "register_node").value
        self.waiting: dict[Stamp, dict[str, str]] = {}  # statuses without their transform
        self.transforms: dict[Stamp, TransformStamped] = {}  # and the other way round
        self.since: dict[Stamp, float] = {}
        self.held: set[Stamp] = set()  # whose transform is still to come, and to be left
        self.newest: Stamp = (-1, 0)  # of the statuses that come with a transform
        self.heard: Heard | None = None  # what goes into the buffer
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
        key, why = _key(values["stamp"]), self._why_not(status, values)
        if status.level == DiagnosticStatus.OK:
            self._note_newest(key)
        if why:
            self._leave(key, its_transform_comes=status.level == DiagnosticStatus.OK)
            self.hold(why)
            return
        self.waiting[key] = values
        self._meet()

    def _note_newest(self, key: Stamp) -> None:
        """Stamps that do not go forward: time starts over, or a cloud was registered once more."""
        if key < self.newest:
            self._forget(max(self.newest, *self.transforms, *self.waiting))
            self.held.clear()
            if self.heard is not None and not self.get_parameter("use_sim_time").value:  # with it, tf2 does so itself
                self.heard.start_over()  # or tf2 interpolates between what it heard before and after
        self.newest = key

    def _leave(self, key: Stamp, its_transform_comes: bool) -> None:
        """A status was held back: neither an earlier one of its stamp nor its transform may be acted on later."""
        if its_transform_comes and key not in self.transforms:
            self.held.add(key)
        for kept in (self.waiting, self.transforms, self.since):
            kept.pop(key, None)

    def _why_not(self, status: DiagnosticStatus, values: dict[str, str]) -> str:
        """Empty when the pose may be used."""
        if status.level != DiagnosticStatus.OK:
            return values["reason"]
        if not float(values["confidence"]) >= self.min_confidence:  # NaN is no confidence
            return f"confidence {values['confidence']} is below {self.min_confidence:g}"
        if not values["tre95"] or not float(values["tre95"]) <= self.max_tre:
            return f"the error is bounded by {values['tre95'] or 'nothing'} m only, {self.max_tre:g} m are allowed"
        return ""

    def _on_transform(self, transform: TransformStamped) -> None:
        key = transform.header.stamp.sec, transform.header.stamp.nanosec
        if key in self.held:
            self.held.remove(key)
            return
        self.transforms[key] = transform
        self._meet()

    def _meet(self) -> None:
        """Act on every stamp of which both messages are here, and forget what is older."""
        for key in sorted(set(self.waiting) & set(self.transforms)):
            since = self.since.setdefault(key, time.monotonic())
            why = self._not_yet(self.transforms[key])
            if why and time.monotonic() - since < WAIT_S:
                return
            values, transform = self.waiting[key], self.transforms[key]
            self._forget(key)
            why = why or self._not_mine(transform) or self._too_old(transform)
            if why:
                self.hold(why)
            else:
                self.act(self._at(transform), values)

    def _forget(self, last: Stamp) -> None:
        """All up to a stamp."""
        for kept in (self.waiting, self.transforms, self.since):
            for old in [key for key in kept if key <= last]:
                del kept[old]
        self.held = {key for key in self.held if key > last}

    def _not_mine(self, transform: TransformStamped) -> str:
        """Why this is not the bone that was asked for; empty when it is."""
        bone = transform.child_frame_id
        return f"it is that of {bone}, bone_frame is {self.bone}" if self.bone and bone != self.bone else ""

    def _too_old(self, transform: TransformStamped) -> str:
        """Why the cloud is not one of now; empty when it is, or when any will do."""
        age_s = (self.get_clock().now() - Time.from_msg(transform.header.stamp)).nanoseconds / 1e9
        return f"its cloud is {age_s:.1f} s old, max_age is {self.max_age:g} s" if 0.0 < self.max_age < age_s else ""

    def _not_yet(self, transform: TransformStamped) -> str:
        """Why the pose cannot be had in the frame that was asked for; empty when it can."""
        cloud_frame = transform.header.frame_id
        if self.buffer is None or self.frame == cloud_frame:
            return ""
        stamp = Time.from_msg(transform.header.stamp)
        there, why = self.buffer.can_transform(self.frame, cloud_frame, stamp, return_debug_tuple=True)
        if there and self.heard is not None:
            why = self.heard.why_not(self.frame, cloud_frame, stamp.nanoseconds, self.max_tf_gap)
            if not why and not self.heard.is_final(self.frame, cloud_frame, stamp.nanoseconds, -math.inf):
                why = "whether the last transform jumped is seen by the next one, which has not come"
        return "" if there and not why else f"no transform {self.frame} <- {cloud_frame}: {why}"

    def _at(self, transform: TransformStamped) -> TransformStamped:
        """The pose in the frame that was asked for, at the stamp of the cloud."""
        cloud_frame = transform.header.frame_id
        if self.buffer is None or self.frame == cloud_frame:
            return transform
        stamp = Time.from_msg(transform.header.stamp)
        moved = transform_to_matrix(self.buffer.lookup_transform(self.frame, cloud_frame, stamp))
        header = Header(frame_id=self.frame, stamp=transform.header.stamp)
        pose = TransformStamped(header=header, child_frame_id=transform.child_frame_id)
        pose.transform = matrix_to_transform(moved @ transform_to_matrix(transform))
        return pose

    def _listen_to_tf2(self) -> object | None:
        if not self.frame:
            return None
        import tf2_ros

        buffer = tf2_ros.Buffer(node=self)
        self.heard = Heard(buffer, lambda stamp: False, self)
        self.listener = tf2_ros.TransformListener(self.heard, self)  # no thread: it would not end with the program
        self.create_timer(POLL_S, self._meet)
        return buffer


def _key(stamp: str) -> Stamp:
    """`12.000000034` as (12, 34)."""
    seconds, _, nanoseconds = stamp.partition(".")
    return int(seconds), int(nanoseconds)


def parser(description: str) -> argparse.ArgumentParser:
    """What may stand before --ros-args: `--help`, which prints the description, and nothing else."""
    shape = argparse.RawDescriptionHelpFormatter
    return argparse.ArgumentParser(description=description, formatter_class=shape, allow_abbrev=False)


def main() -> None:
    """Run until it is stopped."""
    parser(__doc__).parse_args(remove_ros_args(sys.argv)[1:])
    rclpy.init(args=sys.argv)
    node = None
    try:
        node = TrustedPose()
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except RuntimeError:  # of rclpy, where Ctrl-C comes while it takes a message
        time.sleep(SHUTDOWN_S)  # its shutdown is on the way
        if rclpy.ok():
            raise
    uninstall_signal_handlers()  # ends rclpy's thread for signals first: it shuts down too, and twice is an error
    if node is not None:
        node.destroy_node()  # not at the interpreter's end, in any order
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
