"""Which moving frames lie between two, and when each was heard: what tf2 does not say of what it interpolates."""

from __future__ import annotations

import threading
from bisect import bisect_left, insort

from gapr_ros.node.intake import plain_frame

KEPT_NS = 10_000_000_000  # behind the newest stamp of a frame, as a tf2 buffer keeps transforms


class Links:
    """The parent of every frame, and the stamps of its transforms. May be asked from another thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._parents: dict[str, str] = {}
        self._stamps: dict[str, list[int]] = {}  # ns, ascending; none of a static frame

    def note(self, child: str, parent: str, stamp: int) -> None:
        """A transform of /tf with this stamp, ns."""
        with self._lock:
            self._parents[plain_frame(child)] = plain_frame(parent)
            stamps = self._stamps.setdefault(plain_frame(child), [])
            insort(stamps, stamp)
            if stamps[0] < stamps[-1] - 2 * KEPT_NS:
                del stamps[: bisect_left(stamps, stamps[-1] - KEPT_NS)]

    def note_static(self, child: str, parent: str) -> None:
        """A transform of /tf_static."""
        with self._lock:
            self._parents[plain_frame(child)] = plain_frame(parent)
            self._stamps.pop(plain_frame(child), None)

    def forget(self) -> None:
        """All that is not static."""
        with self._lock:
            for child in self._stamps:
                del self._parents[child]
            self._stamps = {}

    def newest_ns(self, child: str) -> int:
        """The newest stamp of a frame; 0 of one that was not heard."""
        with self._lock:
            return self._stamps.get(child, [0])[-1]

    @property
    def moving(self) -> set[str]:
        """Every frame that was heard on /tf."""
        with self._lock:
            return set(self._stamps)

    def between(self, frame: str, other: str) -> set[str]:
        """The moving frames whose transforms lead from one frame to the other."""
        with self._lock:
            return (self._up_from(plain_frame(frame)) ^ self._up_from(plain_frame(other))) & self._stamps.keys()

    def gap_ns(self, child: str, stamp: int) -> int:
        """How far apart the two transforms of a frame around a stamp, ns, are; 0 at one of them, and outside of all."""
        with self._lock:
            stamps = self._stamps.get(child, [])
            after = bisect_left(stamps, stamp)
            if after in (0, len(stamps)) or stamps[after] == stamp:
                return 0
            return stamps[after] - stamps[after - 1]

    def _up_from(self, frame: str) -> set[str]:
        """It and all above it."""
        found: set[str] = set()
        while frame and frame not in found:
            found.add(frame)
            frame = self._parents.get(frame, "")
        return found
