"""What of /tf goes into the buffer: no transform from the future, and never those of two rounds of time."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from gapr_ros.node.timeline import BACK_NS, RESTART_AFTER, stamp_ns

if TYPE_CHECKING:
    from geometry_msgs.msg import TransformStamped

THROTTLE_S = 5.0


class Heard:
    """Stands between tf2's listener and its buffer, which takes everything and interpolates between any two stamps.

    A stamp that goes back by more than a second is judged as those of clouds are: one is a straggler and is left out;
    several in a row that go forward among themselves are another round, and what was heard before is forgotten.

    Args:
        buffer: of tf2.
        is_future: whether a stamp, ns, is too far ahead of the clock.
        node: logs what is left out.
    """

    def __init__(self, buffer: Any, is_future: Callable[[int], bool], node: Any) -> None:
        self._buffer, self._is_future, self._node = buffer, is_future, node
        self._newest_ns: dict[str, int] = {}  # by child frame
        self._back_ns: dict[str, list[int]] = {}  # stamps in a row that went back
        self._any_older: set[str] = set()

    def start_over(self) -> None:
        """Forget all but what is static: between that and what comes tf2 would interpolate."""
        self._newest_ns, self._back_ns, self._any_older = {}, {}, set()
        self._buffer.clear()

    def expect_older(self) -> None:
        """After a reset: the next stamp of a frame begins another round however small the step back is."""
        self._any_older = set(self._newest_ns)

    def set_transform(self, transform: TransformStamped, authority: str) -> None:
        """One that was heard on /tf."""
        child, stamp = transform.child_frame_id, stamp_ns(transform.header)
        if self._is_future(stamp):
            self._warn(f"a transform of '{child}' is left out: its stamp is ahead of the clock; synchronise the clocks")
        elif self._is_of_now(child, stamp):
            self._buffer.set_transform(transform, authority)

    def set_transform_static(self, transform: TransformStamped, authority: str) -> None:
        """One that was heard on /tf_static: it holds at all times."""
        self._buffer.set_transform_static(transform, authority)

    def _is_of_now(self, child: str, stamp: int) -> bool:
        newest, any_older = self._newest_ns.get(child, 0), child in self._any_older
        self._any_older.discard(child)
        if stamp < newest - (0 if any_older else BACK_NS):
            if not (any_older or self._is_another_round(child, stamp)):
                return False
            self._warn(f"the stamps of the transforms of '{child}' went back: those of before are forgotten")
            self.start_over()
            newest = 0
        self._newest_ns[child] = max(stamp, newest)
        self._back_ns.pop(child, None)
        return True

    def _is_another_round(self, child: str, stamp: int) -> bool:
        row = self._back_ns.get(child, [])
        self._back_ns[child] = [*row, stamp] if row and stamp > row[-1] else [stamp]
        return len(self._back_ns[child]) >= RESTART_AFTER

    def _warn(self, text: str) -> None:
        self._node.get_logger().warning(text, throttle_duration_sec=THROTTLE_S)
