"""tf2, imported only when it is needed and there: it is part of a ROS installation, not of the Python wheels."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.errors import ConfigError
from gapr_ros.node import missing
from gapr_ros.node.heard import Heard
from gapr_ros.node.intake import plain_frame
from gapr_ros.node.refusal import Reason, RefusedError
from gapr_ros.node.timeline import BACK_NS
from gapr_ros.parameters import NodeParameters
from msg_adapters import InvalidMessageError, transform_to_matrix

if TYPE_CHECKING:
    from geometry_msgs.msg import TransformStamped
    from rclpy.node import Node
    from rclpy.time import Time

Array = NDArray[np.float64]
MISSING = "tf2_ros is not installed (it comes with a ROS installation, not with the wheels)"
POLL_S = 0.005
CACHE_NS = 10_000_000_000  # what a tf2 buffer keeps behind its newest transform, if nobody asked for more


class Frames:
    """Looks transforms up and sends them; without tf2_ros it says so once and refuses look-ups.

    Args:
        node: publishes and subscribes.
        publish: send to /tf.
        listen: look up from the start; else from the first `listen()`.
        note_sent: is given every transform that goes to /tf.
        is_future: whether the stamp, ns, of a transform that was heard is too far ahead of the clock.
        moved: is called where a frame that was looked up through has another place on /tf_static now.

    Attributes:
        behind: the last transform was not sent, because buffers still hold those of another round.
    """

    def __init__(
        self,
        node: Node,
        publish: bool,
        listen: bool,
        note_sent: Callable[[TransformStamped], None] | None = None,
        is_future: Callable[[int], bool] = lambda stamp: False,
        moved: Callable[[str], None] = lambda frame: None,
    ) -> None:
        self._node, self._note_sent, self._is_future, self._moved = node, note_sent, is_future, moved
        self._ahead_ns = 0  # stamp of the last transform that was left out as too far ahead of the clock
        self._sent_ns, self._held_ns, self.behind = -1, -1, False
        self._newest_ns, self._any_older = -1, False  # stamp of the clouds of this round of time
        self._tf2 = _import_tf2() if publish or listen else None
        if self._tf2 is None and (publish or listen):
            node.get_logger().warning(f"{MISSING}: nothing goes to /tf and no other frame can be used")
        self._broadcaster = self._tf2.TransformBroadcaster(node) if self._tf2 and publish else None
        self._buffer: Any = None
        self._heard: Heard | None = None
        self._listener: Any = None
        if listen:
            self.listen()

    def listen(self) -> None:
        """Start filling the buffer, if tf2 is there and it has not been started; call it from the executor."""
        if self._tf2 is None:  # neither `publish` nor `listen` asked for it
            self._tf2 = _import_tf2()
        if self._tf2 is not None and self._buffer is None:
            self._buffer = self._tf2.Buffer(node=self._node)
            self._buffer.jump_handle.unregister()  # `start_over` clears it; that of Jazzy's first tf2_ros_py raises
            self._heard = Heard(self._buffer, self._is_ahead, self._node, self._moved)
            self._listener = self._tf2.TransformListener(self._heard, self._node)

    def lookup(
        self,
        parent: str,
        child: str,
        stamp: Time,
        timeout_s: float,
        most_gap_s: float = 0.0,
        arrived_s: float = -math.inf,
    ) -> Array:
        """T_parent_child (4, 4), metres, at a time. Waits in the caller's thread, by the wall clock.

        Args:
            parent, child: names of frames.
            stamp: when; 0 for the newest transform there is.
            timeout_s: longest wait.
            most_gap_s: between transforms that are farther apart than this, s, nothing is interpolated; 0: any.
            arrived_s: when the cloud came that asks, `time.monotonic`; one that came late waits for another transform.

        Raises:
            RefusedError: tf_missing, never the identity.
        """
        if parent == child:
            return np.eye(4)
        buffer, heard = self._buffer, self._heard  # `close` may take them away meanwhile
        if self._tf2 is None or buffer is None or heard is None:
            raise RefusedError(Reason.TF_MISSING, f"{parent} <- {child}: {MISSING}")
        start = time.monotonic()  # tf2's own wait never ends while simulated time stands still

        def is_ready() -> bool:
            is_known = buffer.can_transform(parent, child, stamp) and not heard.turned(parent, child)
            return is_known and heard.is_final(parent, child, stamp.nanoseconds, arrived_s)

        while not is_ready() and time.monotonic() - start < timeout_s:
            time.sleep(POLL_S)
        try:
            found = transform_to_matrix(buffer.lookup_transform(parent, child, stamp))
        except (self._tf2.TransformException, InvalidMessageError) as error:
            waited_s = time.monotonic() - start
            why = missing.explained(error, parent, child, stamp.nanoseconds, waited_s, self._ahead_ns)
            raise RefusedError(Reason.TF_MISSING, f"{parent} <- {child}: {why}") from error
        if why := heard.why_not(parent, child, stamp.nanoseconds, most_gap_s):
            raise RefusedError(Reason.TF_MISSING, f"{parent} <- {child}: {why}")
        return found

    def start_over(self) -> None:
        """What was heard so far is of another round of time: between that and what comes tf2 would interpolate."""
        self._newest_ns, self._ahead_ns = -1, 0
        if self._heard is not None:
            self._heard.start_over()

    def _is_ahead(self, stamp_ns: int) -> bool:
        """Of a transform that was heard; one that is left out for it may be the one that is missed."""
        is_ahead = self._is_future(stamp_ns)
        self._ahead_ns = stamp_ns if is_ahead else self._ahead_ns
        return is_ahead

    def note_cloud(self, stamp_ns: int) -> None:
        """A cloud was let in; one that is older than those of a round can be begins another one, as after a reset."""
        oldest_ns = self._newest_ns - (0 if self._any_older else BACK_NS)
        if 0 < stamp_ns < oldest_ns:
            self.start_over()
        self._newest_ns, self._any_older = max(self._newest_ns, stamp_ns), False

    def send(self, transform: TransformStamped, stamp_ns: int) -> bool:
        """To /tf, if it has frames, and a stamp newer than that of the last one or none (0).

        `Timeline` lets no other pose of an older or the same stamp pass; tf2 warns about repeated data.
        """
        is_new = stamp_ns > max(self._sent_ns, self._held_ns) or stamp_ns == 0 == self._sent_ns
        self.behind = self._broadcaster is not None and stamp_ns <= self._held_ns
        if self._broadcaster is None or not is_new or not transform.header.frame_id:
            return False
        if self._note_sent is not None:
            self._note_sent(transform)
        self._broadcaster.sendTransform(transform)
        self._sent_ns = stamp_ns
        return True

    def hold(self) -> None:
        """Another round begins, and other listeners do not know: wait until their buffers have dropped this one."""
        self.start_over()
        if self._sent_ns > 0:
            self._held_ns = self._sent_ns + CACHE_NS

    def forget(self) -> None:
        """The listeners start over: older stamps are news again."""
        self._any_older = True
        if self._heard is not None:
            self._heard.expect_older()
        self._sent_ns, self._held_ns, self.behind = -1, -1, False

    def close(self) -> None:
        """Give back what was subscribed and advertised."""
        if self._listener is not None:
            self._listener.unregister()
        if self._buffer is not None:  # it offers a service for as long as the node lives
            self._node.destroy_service(self._buffer.srv)
        if self._broadcaster is not None:
            self._node.destroy_publisher(self._broadcaster.pub_tf)
        self._listener = self._heard = self._buffer = self._broadcaster = None


def check_names(parameters: NodeParameters) -> None:
    """Frames of the node's own that tf2 would not take, or that cannot be what they are meant for.

    Raises:
        ConfigError: an empty model_frame or viewpoint, a leading slash, or the bone's own frame for something else.
    """
    for name in ("model_frame", "output_frame"):
        value = getattr(parameters, name)
        if value.startswith("/"):
            raise ConfigError(f"{name} without a leading slash", f"'{value}'", f"write {plain_frame(value)}")
    if not parameters.model_frame:
        raise ConfigError("a model_frame", "an empty one", "give the bone's frame a name, such as femur_preop")
    if not parameters.viewpoint:
        raise ConfigError("a viewpoint", "an empty one", "write auto, none, origin, or the name of a frame")
    _check_not_the_bones(parameters)


def _check_not_the_bones(parameters: NodeParameters) -> None:
    """Refuse frames that tf2 would have from the poses alone, which need those frames first."""
    why = {"output_frame": "poses of the bone cannot be in its own frame"}
    if parameters.publish_tf:  # else somebody else may
        why["crop_frame"] = "the bone's frame is not known before its pose; crop_to_track crops near its last one"
        why["viewpoint"] = "the bone's frame is not known before its pose; name the frame of the camera"
    for name, text in why.items():
        if plain_frame(getattr(parameters, name)) == parameters.model_frame:
            raise ConfigError(f"another {name} than model_frame", f"'{parameters.model_frame}' for both", text)


def _import_tf2() -> Any | None:
    try:
        import tf2_ros
    except ImportError:
        return None
    return tf2_ros
