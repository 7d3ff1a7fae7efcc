"""tf2, imported only when it is needed and there: it is part of a ROS installation, not of the Python wheels."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.errors import ConfigError
from gapr_ros.node.cloud import plain_frame
from gapr_ros.node.outcome import Reason, RefusedError
from gapr_ros.node.tf_guard import KEPT_NS, TfHistory
from gapr_ros.parameters import NO_FRAME, NodeParameters
from msg_adapters import InvalidMessageError

if TYPE_CHECKING:
    from geometry_msgs.msg import TransformStamped
    from rclpy.node import Node
    from rclpy.time import Time

Array = NDArray[np.float64]
MISSING = "tf2_ros is not installed (it comes with a ROS installation, not with the wheels)"
POLL_S = 0.005
FARTHEST_M = 50.0  # of a cloud from a frame that its pose is asked in


class Frames:
    """Looks transforms up and sends them; without tf2_ros it says so once and refuses look-ups.

    Args:
        node: publishes and subscribes.
        publish: send to /tf.
        listen: look up from the start; else from the first `listen()`.
        is_future: whether the stamp, ns, of a transform that was heard is too far ahead of the clock.
        moved: called where a frame that was looked up has another place on /tf_static.

    Attributes:
        behind: the last transform was not sent, because buffers still hold those of another round of time.
    """

    def __init__(
        self,
        node: Node,
        publish: bool,
        listen: bool,
        is_future: Callable[[int], bool] = lambda stamp: False,
        moved: Callable[[str], None] = lambda frame: None,
    ) -> None:
        self._node, self._is_future, self._moved = node, is_future, moved
        self._sent_ns, self._held_ns, self.behind = -1, -1, False
        self._tf2 = _import_tf2() if publish or listen else None
        if self._tf2 is None and (publish or listen):
            node.get_logger().warning(f"{MISSING}: nothing goes to /tf and no other frame can be used")
        self._broadcaster = self._tf2.TransformBroadcaster(node) if self._tf2 and publish else None
        self._buffer: Any = None
        self._history: TfHistory | None = None
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
            self._history = TfHistory(self._buffer, self._is_future, self._node, self._moved)
            self._listener = self._tf2.TransformListener(self._history, self._node)

    def lookup(self, parent: str, child: str, stamp: Time, timeout_s: float) -> Array:
        """T_parent_child (4, 4), metres, at a time. Waits in the caller's thread, by the wall clock.

        Raises:
            RefusedError: tf_missing or bad_frame, never the identity.
        """
        if parent == child:
            return np.eye(4)
        buffer, history = self._buffer, self._history  # `close` may take them away meanwhile
        if self._tf2 is None or buffer is None or history is None:
            raise RefusedError(Reason.TF_MISSING, f"{parent} <- {child}: {MISSING}")
        start = time.monotonic()  # tf2's own wait never ends while simulated time stands still
        while not buffer.can_transform(parent, child, stamp) and time.monotonic() - start < timeout_s:
            time.sleep(POLL_S)
        try:
            found = history.lookup(parent, child, stamp)
        except (self._tf2.TransformException, InvalidMessageError) as error:
            why = history.why_missing(parent, child, stamp.nanoseconds)
            raise RefusedError(Reason.TF_MISSING, f"{parent} <- {child}: {why}") from error
        away_m = float(np.linalg.norm(found[:3, 3]))
        if away_m > FARTHEST_M:
            text = f"'{child}' is {away_m:.0f} m from '{parent}': are the transforms between them in millimetres?"
            raise RefusedError(Reason.BAD_FRAME, text)
        return found

    def start_over(self) -> None:
        """Forget what was heard so far: it is of another round of time."""
        if self._history is not None:
            self._history.start_over()

    def send(self, transform: TransformStamped, stamp_ns: int) -> bool:
        """To /tf, if it has frames, and a stamp newer than that of the last one or none (0).

        `Gate` lets no other pose of an older or the same stamp pass; tf2 warns about repeated data.
        """
        is_new = stamp_ns > max(self._sent_ns, self._held_ns) or stamp_ns == 0 == self._sent_ns
        self.behind = self._broadcaster is not None and stamp_ns <= self._held_ns
        if self._broadcaster is None or not is_new or not transform.header.frame_id:
            return False
        self._broadcaster.sendTransform(transform)
        self._sent_ns = stamp_ns
        return True

    def hold(self) -> None:
        """Another round begins, and other listeners do not know: wait until their buffers have dropped this one."""
        self.start_over()
        if self._sent_ns > 0:
            self._held_ns = self._sent_ns + KEPT_NS

    def forget(self) -> None:
        """Start the listeners again, so that older stamps count as new."""
        self.start_over()
        self._sent_ns, self._held_ns, self.behind = -1, -1, False

    def close(self) -> None:
        """Give back what was subscribed and advertised."""
        if self._listener is not None:
            self._listener.unregister()
        if self._buffer is not None:  # it offers a service for as long as the node lives
            self._node.destroy_service(self._buffer.srv)
        if self._broadcaster is not None:
            self._node.destroy_publisher(self._broadcaster.pub_tf)
        self._listener = self._history = self._buffer = self._broadcaster = None


def needs_frames(parameters: NodeParameters) -> bool:
    """Say if clouds cannot be read without tf2."""
    has_frame = parameters.viewpoint not in (*NO_FRAME, "origin")
    return bool(parameters.output_frame or parameters.crop_frame or has_frame)


def check_names(parameters: NodeParameters) -> None:
    """Refuse frames of the node's own that tf2 would not take, or that cannot be what they are meant for.

    Raises:
        ConfigError: an empty model_frame or viewpoint, a leading slash, or the bone's own frame for something else.
    """
    model = parameters.model_frame
    for name in ("model_frame", "output_frame"):
        value = getattr(parameters, name)
        if value.startswith("/"):
            raise ConfigError(f"{name} without a leading slash", f"'{value}'", f"write {plain_frame(value)}")
    for name in ("model_frame", "viewpoint"):
        if not getattr(parameters, name):
            raise ConfigError(f"a {name}", "an empty one", "leave it out for the default")
    for name in ("output_frame", "crop_frame", "viewpoint") if parameters.publish_tf else ("output_frame",):
        if plain_frame(getattr(parameters, name)) == model:
            how = "the bone's frame is not known before its pose; name another frame"
            raise ConfigError(f"another {name} than model_frame", f"'{model}' for both", how)


def _import_tf2() -> Any | None:
    try:
        import tf2_ros
    except ImportError:
        return None
    return tf2_ros
