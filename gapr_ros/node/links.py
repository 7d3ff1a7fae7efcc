"""Which moving frames lie between two, and what was heard of each: what tf2 does not say of what it interpolates."""

from __future__ import annotations

import math
import threading
from bisect import bisect_left, bisect_right
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gapr_ros.node.intake import plain_frame

if TYPE_CHECKING:
    from geometry_msgs.msg import TransformStamped

Array = NDArray[np.float64]
Place = tuple[float, ...]  # x y z of a frame in its parent, metres, and its quaternion, x y z w

KEPT_NS = 10_000_000_000  # behind the newest stamp of a frame, as a tf2 buffer keeps transforms
# A frame goes to and fro as no tracker sees one thing move: ways there and back, one transform after the other
NEAR_NS = 1_000_000_000  # looked for on either side of a stamp
TO_AND_FRO = 2  # so many are not chance
LEAST = 0.003, np.radians(2.0)  # shortest way that counts
LEAST_PER_S = 0.15, np.radians(50.0)  # slowest, m/s and rad/s
BACK = 0.25  # share of a way that may be left after it
# ... one place off its way is enough where nothing that is tracked turns so fast
GLITCH = 0.006, np.radians(3.0)
GLITCH_PER_S2 = 30.0, 300.0  # m/s^2 and rad/s^2
CALM = 0.25  # share of a jump that a frame moves by before and after it where it rests there
REST_NS = 50_000_000  # looked at before and after, at least: over less the noise of a tracker looks like a motion
SAME_M, SAME_RAD = 1e-4, np.radians(0.02)  # a static frame that moves by less is where it was
ORIGIN = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)  # what some trackers send of a marker that they do not see


class Jump(NamedTuple):
    """A step from rest to rest, from one transform to the next: nothing that is tracked moves so.

    Attributes:
        metres, radians: how far.
        is_open: not enough was heard after it, so that it may yet be the beginning of a motion.
    """

    metres: float
    radians: float
    is_open: bool


@dataclass
class Track:
    """What was heard of one moving frame, by its stamps, ns, ascending."""

    stamps: list[int] = field(default_factory=list)
    places: list[Place] = field(default_factory=list)
    parents: list[str] = field(default_factory=list)
    lost: list[bool] = field(default_factory=list)  # at the very origin of its parent, where it jumped to and stays

    def insert(self, stamp: int, place: Place, parent: str) -> None:
        """One more; what is far behind the newest is forgotten."""
        at = bisect_right(self.stamps, stamp)
        self.stamps.insert(at, stamp)
        self.places.insert(at, place)
        self.parents.insert(at, parent)
        self.lost.insert(at, False)
        self._note_lost(at)
        if self.stamps[0] < self.stamps[-1] - 2 * KEPT_NS:
            old = bisect_left(self.stamps, self.stamps[-1] - KEPT_NS)
            del self.stamps[:old], self.places[:old], self.parents[:old], self.lost[:old]

    def near(self, stamp: int) -> tuple[Array, Array, list[str]]:
        """Seconds (N,), places (N, 7) and parents of those within a second of a stamp, ns; of 0 of the newest one."""
        stamp = stamp or self.stamps[-1]
        some = slice(bisect_left(self.stamps, stamp - NEAR_NS), bisect_right(self.stamps, stamp + NEAR_NS))
        seconds = 1e-9 * (np.array(self.stamps[some], dtype=np.float64) - stamp)
        return seconds, np.array(self.places[some]).reshape(-1, 7), self.parents[some]

    def jump(self, stamp: int) -> Jump | None:
        """Whether it jumped between the two transforms around a stamp, ns; None at one of them.

        It rests where it stays within a quarter of the way: for half as long as the step took, before it and after, and
        50 ms at least. Where nothing was heard before them, nobody knows that it rested.
        """
        after = bisect_left(self.stamps, stamp)
        if after in (0, len(self.stamps)) or self.stamps[after] == stamp:
            return None
        before = after - 1
        rest_ns = max(REST_NS, (self.stamps[after] - self.stamps[before]) // 2)
        first = bisect_right(self.stamps, self.stamps[before] - rest_ns) - 1
        last = bisect_left(self.stamps, self.stamps[after] + rest_ns)
        if first < 0 or self.parents[before] != self.parents[after]:
            return None
        is_open, took_ns = last == len(self.stamps), self.stamps[after] - self.stamps[before]
        way = self._largest_way(before, [after])
        rests = [self._largest_way(before, range(first, before)), self._largest_way(after, range(after, last + 1))]
        is_jump = [
            way[kind] >= max(LEAST[kind], LEAST_PER_S[kind] * 1e-9 * took_ns)
            and all(rest[kind] <= CALM * way[kind] for rest in rests)
            for kind in range(2)
        ]
        return Jump(*way, is_open) if any(is_jump) else None

    def is_lost(self, stamp: int) -> bool:
        """Whether a transform around a stamp, ns, of 0 the newest one, is what a tracker sends without its marker."""
        stamp = stamp or self.stamps[-1]
        after = bisect_left(self.stamps, stamp)
        is_between = after < len(self.stamps) and self.stamps[after] != stamp
        return any(self.lost[max(after - is_between, 0) : after + 1])

    def glitch(self, stamp: int) -> tuple[float, float] | None:
        """How far away, metres and radians, the frame was for one transform alone, at a stamp, ns, or next to it."""
        after = bisect_left(self.stamps, stamp)
        is_at_one = after < len(self.stamps) and self.stamps[after] == stamp
        return next(filter(None, map(self._glitch_at, range(after - (not is_at_one), after + 1))), None)

    def may_be_glitch(self, stamp: int) -> bool:
        """Whether the newest transform, after a stamp, ns, is farther away than what is tracked gets so fast."""
        last = len(self.stamps) - 1
        if last < 2 or not self.stamps[last - 1] < stamp < self.stamps[last]:
            return False
        before_s, took_s = (1e-9 * max(self.stamps[i] - self.stamps[i - 1], 1) for i in (last - 1, last))
        before, way = self._largest_way(last - 2, [last - 1]), self._largest_way(last - 1, [last])
        return any(
            way[kind] >= GLITCH[kind] and way[kind] / took_s - before[kind] / before_s >= GLITCH_PER_S2[kind] * took_s
            for kind in range(2)
        )

    def _glitch_at(self, at: int) -> tuple[float, float] | None:
        if not 0 < at < len(self.stamps) - 1:
            return None
        took_s = 1e-9 * max(self.stamps[at] - self.stamps[at - 1], self.stamps[at + 1] - self.stamps[at])
        there, away = self._largest_way(at, [at - 1]), self._largest_way(at, [at + 1])
        back = self._largest_way(at - 1, [at + 1])
        off = [0.5 * (there[kind] + away[kind] - back[kind]) for kind in range(2)]  # its way, at least
        is_glitch = (off[kind] >= max(GLITCH[kind], 0.5 * GLITCH_PER_S2[kind] * took_s**2) for kind in range(2))
        return there if any(is_glitch) else None

    def parents_around(self, stamp: int) -> tuple[str, str] | None:
        """The parents before and after a stamp, ns, where they are two; tf2 has the place before it then."""
        after = bisect_left(self.stamps, stamp)
        if after in (0, len(self.stamps)) or self.stamps[after] == stamp:
            return None
        before, now = self.parents[after - 1 : after + 1]
        return None if before == now else (before, now)

    def _note_lost(self, last: int) -> None:
        """Mark two in a row at the very origin, where the frame jumped to, or was lost before: it stays there."""
        two = slice(max(last - 1, 0), last + 1)
        if last < 1 or not all(tuple(map(abs, place)) == ORIGIN for place in self.places[two]):
            return
        if self.lost[last - 1] or (last > 1 and self._leaps(last - 2)):
            self.lost[two] = [True, True]

    def _leaps(self, before: int) -> bool:
        """Whether the frame moves on farther and faster than what counts, from one transform to the next."""
        way, took_s = self._largest_way(before, [before + 1]), 1e-9 * (self.stamps[before + 1] - self.stamps[before])
        return any(way[kind] >= max(LEAST[kind], LEAST_PER_S[kind] * took_s) for kind in range(2))

    def _largest_way(self, start: int, to: Iterable[int]) -> tuple[float, float]:
        """From one place to the farthest of some others, metres and radians; those not heard yet are left out."""
        others = np.array([self.places[i] for i in to if i < len(self.places)]).reshape(-1, 7)
        metres, radians = _apart(np.broadcast_to(self.places[start], others.shape), others)
        return float(metres.max(initial=0.0)), float(radians.max(initial=0.0))


class Links:
    """The parent of every frame, and what was heard of it. May be asked from another thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._parents: dict[str, str] = {}
        self._tracks: dict[str, Track] = {}  # none of a static frame
        self._static: dict[str, tuple[str, Place]] = {}

    def note(self, transform: TransformStamped, stamp: int) -> None:
        """A transform of /tf with this stamp, ns."""
        child, parent = plain_frame(transform.child_frame_id), plain_frame(transform.header.frame_id)
        with self._lock:
            self._parents[child] = parent
            self._tracks.setdefault(child, Track()).insert(stamp, _place(transform), parent)

    def note_static(self, transform: TransformStamped) -> str:
        """A transform of /tf_static; what it says otherwise than the last one of this frame did, empty if nothing.

        Of a frame that is not a moving one.
        """
        child, parent = plain_frame(transform.child_frame_id), plain_frame(transform.header.frame_id)
        now = parent, _place(transform)
        with self._lock:
            self._parents[child] = parent
            before, self._static[child] = self._static.get(child, now), now
        if before[0] != parent:
            return f"'{parent}' is its parent, and no longer '{before[0]}'"
        moved_m, turned_rad = _apart(np.array([before[1]]), np.array([now[1]]))
        is_moved = moved_m[0] > SAME_M or turned_rad[0] > SAME_RAD
        return f"it moved by {1e3 * moved_m[0]:.1f} mm, {np.degrees(turned_rad[0]):.2f} deg" if is_moved else ""

    def forget(self) -> None:
        """All that is not static."""
        with self._lock:
            for child in self._tracks:
                del self._parents[child]
            self._tracks = {}

    def newest_ns(self, child: str) -> int:
        """The newest stamp of a frame; 0 of one that was not heard."""
        with self._lock:
            return self._tracks[child].stamps[-1] if child in self._tracks else 0

    @property
    def moving(self) -> set[str]:
        """Every frame that was heard on /tf."""
        with self._lock:
            return set(self._tracks)

    def between(self, frame: str, other: str) -> set[str]:
        """The moving frames whose transforms lead from one frame to the other."""
        with self._lock:
            return self._way(frame, other) & self._tracks.keys()

    def leads(self, child: str, frame: str, other: str) -> bool:
        """Whether the transform of a frame, moving or not, is one of those that lead from one frame to the other."""
        with self._lock:
            return plain_frame(child) in self._way(frame, other)

    def gap_ns(self, child: str, stamp: int) -> int:
        """How far apart the two transforms of a frame around a stamp, ns, are; 0 at one of them, and outside of all."""
        with self._lock:
            stamps = self._tracks[child].stamps if child in self._tracks else []
            after = bisect_left(stamps, stamp)
            if after in (0, len(stamps)) or stamps[after] == stamp:
                return 0
            return stamps[after] - stamps[after - 1]

    def jump(self, child: str, stamp: int) -> Jump | None:
        """Whether a frame jumped between the two transforms around a stamp, ns, or may have."""
        with self._lock:
            return self._tracks[child].jump(stamp) if child in self._tracks else None

    def is_lost(self, child: str, stamp: int) -> bool:
        """Whether a frame is at the origin of its parent around a stamp, ns, since it jumped there."""
        with self._lock:
            return child in self._tracks and self._tracks[child].is_lost(stamp)

    def glitch(self, child: str, stamp: int) -> tuple[float, float] | None:
        """How far away a frame was for one transform alone at a stamp, ns, or next to it; metres and radians."""
        with self._lock:
            return self._tracks[child].glitch(stamp) if child in self._tracks else None

    def may_be_glitch(self, child: str, stamp: int) -> bool:
        """Whether the newest transform of a frame, after a stamp, ns, may be one that no other is like."""
        with self._lock:
            return child in self._tracks and self._tracks[child].may_be_glitch(stamp)

    def parents_around(self, child: str, stamp: int) -> tuple[str, str] | None:
        """The parents of a frame before and after a stamp, ns, where they are two."""
        with self._lock:
            return self._tracks[child].parents_around(stamp) if child in self._tracks else None

    def to_and_fro(self, child: str, stamp: int) -> str:
        """How a frame goes to and fro around a stamp, ns, as where two nodes send it; empty where it does not.

        A tracked thing that turns back does so more slowly, or not again within the same second.
        """
        with self._lock:
            if child not in self._tracks:
                return ""
            seconds, places, parents = self._tracks[child].near(stamp)
        changes = sum(a != b for a, b in zip(parents, parents[1:], strict=False))
        if changes >= TO_AND_FRO:
            return f"its parent is {' and '.join(repr(name) for name in sorted(set(parents)))} by turns"
        times, by_m = _spikes(seconds, places)
        return f"it goes to and fro by {1e3 * by_m:.1f} mm" if times >= TO_AND_FRO else ""

    def _way(self, frame: str, other: str) -> set[str]:
        return self._up_from(plain_frame(frame)) ^ self._up_from(plain_frame(other))

    def _up_from(self, frame: str) -> set[str]:
        """It and all above it."""
        found: set[str] = set()
        while frame and frame not in found:
            found.add(frame)
            frame = self._parents.get(frame, "")
        return found


def _place(transform: TransformStamped) -> Place:
    p, q = transform.transform.translation, transform.transform.rotation
    norm = math.sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w)  # a little off 1 would pass for a turn
    return p.x, p.y, p.z, q.x / norm, q.y / norm, q.z / norm, q.w / norm


def _spikes(seconds: Array, places: Array) -> tuple[int, float]:
    """How many of the places (N, 7) are left at once for the one before, and the largest way there, m."""
    if len(places) < 3:
        return 0, 0.0
    took_s = np.maximum(seconds[1:-1] - seconds[:-2], seconds[2:] - seconds[1:-1])
    there, away = _apart(places[:-2], places[1:-1]), _apart(places[1:-1], places[2:])
    back = _apart(places[:-2], places[2:])
    is_spike = np.zeros(len(took_s), dtype=bool)
    for kind, (least, least_per_s) in enumerate(zip(LEAST, LEAST_PER_S, strict=True)):
        way = np.minimum(there[kind], away[kind])
        is_spike |= (way >= least) & (way >= least_per_s * took_s) & (back[kind] <= BACK * way)
    return int(is_spike.sum()), float(there[0][is_spike].max(initial=0.0))


def _apart(first: Array, second: Array) -> tuple[Array, Array]:
    """(N,) metres and radians between places (N, 7)."""
    cos_half = np.abs(np.einsum("ni,ni->n", first[:, 3:], second[:, 3:]))
    return np.linalg.norm(first[:, :3] - second[:, :3], axis=1), 2.0 * np.arccos(np.minimum(cos_half, 1.0))
