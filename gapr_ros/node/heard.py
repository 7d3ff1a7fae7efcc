"""What of /tf goes into the buffer, no future and never two rounds of time, and what must not be looked up in it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from gapr_ros.node.guard import THROTTLE_S
from gapr_ros.node.intake import plain_frame
from gapr_ros.node.links import Links
from gapr_ros.node.timeline import BACK_NS, RESTART_AFTER, stamp_ns

if TYPE_CHECKING:
    from geometry_msgs.msg import TransformStamped

LATE_NS = 50_000_000  # a cloud that is so much older than a transform came late, or the clock was set back before it
OUT_OF_ORDER_NS = 10_000_000  # a transform may be so much older than the newest of its frame, as where threads race

UNIT = 0.01  # the squared length of a quaternion is within this of 1
AFTER_A_STEP_S = 1.0  # of the clock: what comes may be of before it


class Heard:
    """Stands between tf2's listener and its buffer, which takes everything and interpolates between any two stamps.

    A stamp that goes back is judged as those of clouds are: one is a straggler and is left out; several in a row that
    go forward among themselves are another round, and what was heard before is forgotten. So are two that go back and a
    third that is the newest of all: the step may have been a short one, and to forget is the safe side. Until it is
    clear which, nothing is looked up; nor is it where a frame was not heard for a while, as of a marker that was
    hidden, jumps, is at the very origin where it jumped to, or goes to and fro, as one that two nodes send. Frames
    through which nothing was looked up yet may be out of order by a second; while there are others, theirs are left out
    then: they are no reason to forget the others.

    Args:
        buffer: of tf2.
        is_future: whether a stamp, ns, is too far ahead of the clock.
        node: logs what is left out.
        moved: is called where a frame through which something was looked up has another place on /tf_static now.
    """

    def __init__(
        self,
        buffer: Any,
        is_future: Callable[[int], bool],
        node: Any,
        moved: Callable[[str], None] = lambda frame: None,
    ) -> None:
        self._buffer, self._is_future, self._node, self._moved = buffer, is_future, node, moved
        self._back_ns: dict[str, list[int]] = {}  # by child frame: stamps in a row that went back
        self._came_s: dict[str, float] = {}  # when the last one came, `time.monotonic`
        self._links, self._needed = Links(), set[str]()  # frames through which something was looked up
        self._asked: set[tuple[str, str]] = set()  # between which
        self._any_older: set[str] = set()
        self._began_s = -AFTER_A_STEP_S  # when the clock stepped last, `time.monotonic`

    def start_over(self) -> None:
        """Forget all but what is static: between that and what comes tf2 would interpolate."""
        self._back_ns, self._any_older, self._began_s = {}, set(), time.monotonic()
        self._links.forget()
        self._buffer.clear()

    def expect_older(self) -> None:
        """After a reset: the next stamp of a frame begins another round however small the step back is."""
        self._any_older = self._links.moving

    def set_transform(self, transform: TransformStamped, authority: str) -> None:
        """One that was heard on /tf."""
        child, stamp = plain_frame(transform.child_frame_id), stamp_ns(transform.header)
        if why := _why_none(transform):
            self._warn(f"a transform of '{child}' is left out: {why}")
            return
        self._came_s[child] = time.monotonic()
        if self._is_future(stamp):
            if time.monotonic() - self._began_s < AFTER_A_STEP_S:
                return  # the last ones of the round before
            self._warn(f"a transform of '{child}' is left out: its stamp is ahead of the clock; synchronise the clocks")
        elif self._is_of_now(child, stamp):
            self._links.note(transform, stamp)
            self._buffer.set_transform(transform, authority)

    def set_transform_static(self, transform: TransformStamped, authority: str) -> None:
        """One that was heard on /tf_static: for tf2 it holds at all times, also where the frame came on /tf before."""
        frame = plain_frame(transform.child_frame_id)
        if why := _why_none(transform):
            self._warn(f"a transform of '{frame}' on /tf_static is left out: {why}")
            return
        if frame in self._links.moving:
            self._warn(f"'{frame}' came on /tf, and what /tf_static says of it is left out: let one node send it")
            return
        changed = self._links.note_static(transform)
        self._buffer.set_transform_static(transform, authority)
        if changed:
            what = f"'{frame}' came on /tf_static once more, and {changed}: this holds now"
            self._node.get_logger().warning(f"{what}; if two nodes send it, end one")
            if any(self._links.leads(frame, *pair) for pair in list(self._asked)):
                self._moved(frame)

    def why_not(self, frame: str, other: str, stamp: int, most_gap_s: float) -> str:
        """Why no transform between two frames at a stamp, ns, can be believed; empty where one can.

        Args:
            frame, other: names.
            stamp: ns; 0 for the newest transform there is.
            most_gap_s: the transforms of a frame around the stamp may be so far apart, s; 0: any.
        """
        if turned := self.turned(frame, other):
            return f"the stamps of the transforms of '{turned}' went back, and whether time did is not clear yet"
        frames = self._links.between(frame, other)
        for each in sorted(frames):
            if how := self._links.to_and_fro(each, stamp):
                return f"'{each}' is not to be believed, {how}: do two nodes send it on /tf?"
            if self._links.is_lost(each, stamp):
                return f"'{each}' jumped to the very origin of its parent: does the tracker see its marker?"
            if parents := self._links.parents_around(each, stamp):
                old, new = parents
                return f"the parent of '{each}' was '{old}' and is '{new}' after this stamp: tf2 has the place before"
            if glitch := self._links.glitch(each, stamp):
                return f"'{each}' was {_way(*glitch)} away for one transform alone around this stamp"
            if jump := self._links.jump(each, stamp):
                way = _way(jump.metres, jump.radians)
                return f"'{each}' jumped by {way} around this stamp: tf2 would say a place at which it never was"
        gap_s, child = max(((self._links.gap_ns(each, stamp) * 1e-9, each) for each in frames), default=(0.0, ""))
        if stamp == 0 or not 0.0 < most_gap_s < gap_s:
            return ""
        return f"'{child}' was not heard for {gap_s:.3g} s around this stamp, max_tf_gap is {most_gap_s:g} s"

    def turned(self, frame: str, other: str) -> str:
        """A frame between two whose stamps went back, and the next one will say why; empty without one."""
        frames = self._links.between(frame, other)
        self._needed |= frames
        self._asked.add((frame, other))
        return min((each for each in frames if each in self._back_ns), default="")

    def is_final(self, frame: str, other: str, stamp: int, arrived_s: float) -> bool:
        """False where a cloud has to wait for another transform, which shows what the last one meant.

        One that came late: whether time went back. One around whose stamp a frame jumped: whether it moves on, or back.

        Args:
            frame, other: names.
            stamp: of the cloud, ns; 0 for none.
            arrived_s: when it came, `time.monotonic`.
        """
        if stamp == 0:
            return True
        frames = self._links.between(frame, other)
        late = [each for each in frames if self._links.newest_ns(each) > stamp + LATE_NS]
        if any(self._came_s[each] <= arrived_s for each in late):
            return False
        jumps = (self._links.jump(each, stamp) for each in frames)
        is_open = any(jump and jump.is_open for jump in jumps)
        return not is_open and not any(self._links.may_be_glitch(each, stamp) for each in frames)

    def _is_of_now(self, child: str, stamp: int) -> bool:
        newest, any_older = self._links.newest_ns(child), child in self._any_older
        self._any_older.discard(child)
        is_needed = any_older or not self._needed or child in self._needed
        row, most_ns = self._back_ns.get(child, []), OUT_OF_ORDER_NS if child in self._needed else BACK_NS
        if stamp < newest - (0 if any_older or row else most_ns) or len(row) > 1:
            if not (any_older or self._is_another_round(child, stamp)) or not is_needed:
                return False
            self._warn(f"the stamps of the transforms of '{child}' went back: those of before are forgotten")
            self.start_over()
        self._back_ns.pop(child, None)
        return True

    def _is_another_round(self, child: str, stamp: int) -> bool:
        row = self._back_ns.get(child, [])
        self._back_ns[child] = [*row, stamp][-RESTART_AFTER:] if row and stamp > row[-1] else [stamp]
        return len(self._back_ns[child]) >= RESTART_AFTER

    def _warn(self, text: str) -> None:
        self._node.get_logger().warning(text, throttle_duration_sec=THROTTLE_S)


def _way(metres: float, radians: float) -> str:
    return f"{1e3 * metres:.1f} mm and {np.degrees(radians):.1f} deg"


def _why_none(transform: TransformStamped) -> str:
    """Why a transform is none, as tf2 judges, which would drop it and draw a line over the gap; empty where it is one.

    Some trackers send such ones for as long as they do not see a marker.
    """
    p, q = transform.transform.translation, transform.transform.rotation
    child, parent = plain_frame(transform.child_frame_id), plain_frame(transform.header.frame_id)
    if not child or not parent or child == parent:
        return f"its frames are '{parent}' and '{child}'"
    norm_sq = q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w
    if not np.isfinite([p.x, p.y, p.z, norm_sq]).all():
        return "it is not finite; does the tracker see its marker?"
    if abs(norm_sq - 1.0) >= UNIT:
        return f"its quaternion has a length of {np.sqrt(norm_sq):.3g} and not of 1; does the tracker see its marker?"
    return ""
