"""The history of what was heard on /tf, and the one judgement of the places that tf2 draws from it."""

from __future__ import annotations

import threading
from bisect import bisect_left, bisect_right, insort
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gapr_ros.node.cloud import plain_frame
from gapr_ros.node.host import THROTTLE_S
from gapr_ros.node.outcome import Reason, RefusedError, stamp_ns
from msg_adapters import transform_to_matrix

if TYPE_CHECKING:
    from geometry_msgs.msg import TransformStamped
    from rclpy.time import Time

Array = NDArray[np.float64]
KEPT_NS = 10_000_000_000  # behind the newest stamp of a frame, as a tf2 buffer keeps transforms
GAP_NS = 250_000_000  # farther apart, two transforms must have one place
AGREE_M, AGREE_RAD = 0.005, np.radians(2.0)  # farther apart, two places do not agree
FAR_S, LATE_S = 600.0, 2.0  # apart: not of one clock; late: its sender has stopped
UNIT = 0.01  # the squared length of a quaternion is within this of 1
ORIGIN = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)  # what trackers send of a marker that they do not see


class Heard(NamedTuple):
    """One transform of a frame: stamp, ns, place in its parent (x y z, m, and quaternion x y z w), and that parent."""

    stamp: int
    place: tuple[float, ...]
    parent: str


class TfHistory:
    """Stands between tf2's listener and its buffer, and refuses what tf2 would draw wrongly.

    tf2 draws a straight line between the two transforms around a stamp. That place is believed only where

    1. the two are at most 0.25 s apart, or have one place: no motion is drawn over a gap;
    2. the later one agrees with where the two before it lead: not so of a jump, a glitch, or two senders;
    3. neither is exactly the origin of its parent, which trackers send of a marker that they do not see.

    A tracker that repeats the last place of a hidden marker with new stamps cannot be told from one at rest.

    Args:
        buffer: of tf2.
        is_future: whether a stamp, ns, is too far ahead of the clock: tf2 would drop all that comes after it.
        node: logs what is left out.
        moved: called where a frame that was looked up has another place on /tf_static.
    """

    def __init__(
        self,
        buffer: Any,
        is_future: Callable[[int], bool],
        node: Any,
        moved: Callable[[str], None] = lambda frame: None,
    ) -> None:
        self._buffer, self._is_future, self._node, self._moved = buffer, is_future, node, moved
        self._lock = threading.RLock()
        self._heard: dict[str, list[Heard]] = {}  # of moving frames, by stamp
        self._static: dict[str, Heard] = {}
        self._asked: set[tuple[str, str]] = set()

    def start_over(self) -> None:
        """Forget all but what is static: between that and what comes tf2 would draw a line."""
        with self._lock:
            self._heard = {}
            self._buffer.clear()

    def set_transform(self, transform: TransformStamped, authority: str) -> None:
        """Take one that was heard on /tf."""
        child, stamp = plain_frame(transform.child_frame_id), stamp_ns(transform.header)
        if why := _why_none(transform):
            self._warn(f"a transform of '{child}' is left out: {why}")
        elif self._is_future(stamp):
            self._warn(f"a transform of '{child}' is left out: its stamp is ahead of the clock; synchronise the clocks")
        else:
            with self._lock:
                if child in self._heard and stamp < self._heard[child][-1].stamp - KEPT_NS:
                    self.start_over()  # time went back; tf2 would drop what comes
                row = self._heard.setdefault(child, [])
                insort(row, Heard(stamp, _place(transform), plain_frame(transform.header.frame_id)))
                if row[0].stamp < row[-1].stamp - 2 * KEPT_NS:
                    del row[: bisect_left(row, (row[-1].stamp - KEPT_NS,))]
                self._buffer.set_transform(transform, authority)

    def set_transform_static(self, transform: TransformStamped, authority: str) -> None:
        """Take one that was heard on /tf_static: for tf2 it holds at all times."""
        frame = plain_frame(transform.child_frame_id)
        if why := _why_none(transform):
            self._warn(f"a transform of '{frame}' on /tf_static is left out: {why}")
            return
        now = Heard(0, _place(transform), plain_frame(transform.header.frame_id))
        with self._lock:
            before, self._static[frame] = self._static.get(frame, now), now
            self._buffer.set_transform_static(transform, authority)
            is_used = any(frame in self._between(*pair) for pair in self._asked)
        if before.parent != now.parent or not _agree(before, now):
            self._warn(f"'{frame}' has another place on /tf_static than before; if two nodes send it, end one")
            if is_used:
                self._moved(frame)

    def lookup(self, parent: str, child: str, time: Time) -> Array:
        """T_parent_child (4, 4), metres, at a time; 0 is the newest.

        Raises:
            RefusedError: tf_missing, where the place is not believed.
            tf2_ros.TransformException: tf2 has none.
        """
        with self._lock:  # what is judged is what was drawn
            self._asked.add((parent, child))
            found = transform_to_matrix(self._buffer.lookup_transform(parent, child, time))
            for frame in sorted(self._between(parent, child)):
                if why := self._why_not(frame, time.nanoseconds):
                    raise RefusedError(Reason.TF_MISSING, f"{parent} <- {child}: {why}")
        return found

    def why_missing(self, parent: str, child: str, stamp: int) -> str:
        """Say what to do if tf2 has no transform at a stamp, ns."""
        with self._lock:
            frames = self._between(parent, child)
            known = {*self._heard, *self._static, *(self._up_from(parent) | self._up_from(child)) - {parent, child}}
            known |= {row[-1].parent for row in self._heard.values()} | {each.parent for each in self._static.values()}
            for frame in (parent, child):
                if frame not in known:
                    return f"nobody sends '{frame}' on /tf or /tf_static: start the node that does, or correct the name"
            late = [(stamp - self._heard[frame][-1].stamp, frame) for frame in frames if frame in self._heard]
            early = [(self._heard[frame][0].stamp - stamp, frame) for frame in frames if frame in self._heard]
        if not late:
            return f"no transforms lead from '{child}' to '{parent}': send the one that is missing"
        apart_ns, frame = max(*late, *early)
        apart_s = apart_ns * 1e-9
        if apart_s > FAR_S:
            how = "play /tf and --clock of the same bag, with use_sim_time:=true"
            return f"the clouds and '{frame}' on /tf are {_span(apart_s)} apart: {how}"
        if max(early)[0] > 0:
            return f"the cloud is {apart_s:.3g} s older than all that was heard of '{frame}': send the next one"
        if apart_s > LATE_S:
            return f"'{frame}' was last heard {apart_s:.3g} s before the cloud: does its node still run, by this clock?"
        return f"'{frame}' comes late: raise tf_timeout, or send it more often"

    def _why_not(self, frame: str, stamp: int) -> str:
        """Say why the place of a frame at a stamp, ns, is not believed; empty if it is."""
        row = self._heard.get(frame, [])
        if not row:
            return ""
        if frame in self._static:
            return f"'{frame}' comes on /tf and on /tf_static: let one node send it"
        at = bisect_left(row, (stamp,)) if stamp else len(row) - 1
        later = row[min(at, len(row) - 1)]
        is_exact = later.stamp == stamp or not stamp
        before = row[at - 1] if at > 0 else later
        if any(tuple(map(abs, each.place)) == ORIGIN for each in ([later] if is_exact else [before, later])):
            return f"'{frame}' is exactly at the origin of '{later.parent}': does the tracker see its marker?"
        if before.parent != later.parent:
            return f"the parent of '{frame}' changed from '{before.parent}' to '{later.parent}': let one node send it"
        gap_ns = later.stamp - before.stamp
        if gap_ns > GAP_NS:
            moved = not (is_exact or _agree(before, later))
            return f"'{frame}' moved while it was not heard for {gap_ns * 1e-9:.2g} s around the cloud" if moved else ""
        first = bisect_right(row, before.stamp - gap_ns // 2, hi=max(at, 1) - 1, key=lambda each: each.stamp) - 1
        led = _led_to(row[first], before, later) if first >= 0 and before is not later else before
        if not _agree(led, later):
            return f"'{frame}' jumped around the cloud: a flickering marker, a fast motion, or two senders"
        return ""

    def _between(self, parent: str, child: str) -> set[str]:
        """List the frames whose transforms lead from one frame to the other."""
        return self._up_from(plain_frame(parent)) ^ self._up_from(plain_frame(child))

    def _up_from(self, frame: str) -> set[str]:
        """List a frame and all above it."""
        found: set[str] = set()
        while frame and frame not in found:
            found.add(frame)
            row = self._heard.get(frame) or ([self._static[frame]] if frame in self._static else [])
            frame = row[-1].parent if row else ""
        return found

    def _warn(self, text: str) -> None:
        self._node.get_logger().warning(text, throttle_duration_sec=THROTTLE_S)


def _led_to(first: Heard, second: Heard, third: Heard) -> Heard:
    """Continue the motion from the first to the second to the time of the third."""
    share = (third.stamp - second.stamp) / max(second.stamp - first.stamp, 1)
    (p0, q0), (p1, q1) = ((np.array(each.place[:3]), Rotation.from_quat(each.place[3:])) for each in (first, second))
    turn = Rotation.from_rotvec(share * (q1 * q0.inv()).as_rotvec())
    place = (*(p1 + share * (p1 - p0)), *(turn * q1).as_quat())
    return Heard(third.stamp, tuple(map(float, place)), third.parent)


def _agree(one: Heard, other: Heard) -> bool:
    """Say if two places are one."""
    way_m = np.linalg.norm(np.subtract(one.place[:3], other.place[:3]))
    cos_half = min(abs(float(np.dot(one.place[3:], other.place[3:]))), 1.0)
    return bool(way_m <= AGREE_M and 2.0 * np.arccos(cos_half) <= AGREE_RAD)


def _place(transform: TransformStamped) -> tuple[float, ...]:
    p, q = transform.transform.translation, transform.transform.rotation
    unit = np.array([q.x, q.y, q.z, q.w]) / np.linalg.norm([q.x, q.y, q.z, q.w])
    return (p.x, p.y, p.z, *unit.tolist())


def _why_none(transform: TransformStamped) -> str:
    """Say why a transform is none, as tf2 judges; empty if it is one. Trackers send such of a hidden marker."""
    p, q = transform.transform.translation, transform.transform.rotation
    child, parent = plain_frame(transform.child_frame_id), plain_frame(transform.header.frame_id)
    if not child or not parent or child == parent:
        return f"its frames are '{parent}' and '{child}'"
    norm_sq = q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w
    if not np.isfinite([p.x, p.y, p.z, norm_sq]).all() or abs(norm_sq - 1.0) >= UNIT:
        return "it is not finite, or its quaternion is not of length 1; does the tracker see its marker?"
    return ""


def _span(seconds: float) -> str:
    for unit, name in ((86400.0, "days"), (3600.0, "h")):
        if seconds >= 2.0 * unit:
            return f"{seconds / unit:.0f} {name}"
    return f"{seconds / 60.0:.0f} min"
