"""Collections of sources in one frame: the part that both accumulators share."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.clouds import EXTENT_LIMITS_MM, check_extent
from gapr_core.errors import InvalidPointCloudError
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.registrar import Registrar
from gapr_core.registration.streams.tracker import Tracker
from gapr_core.surface import Surface

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

MOST_OFF = 3  # sources in a row off the bone, or metres away, after which the collection restarts


class Collection:
    """Keeps sources of one frame, which `method` registers together.

    Args:
        method: a `Tracker` begins a stream of its own.
        most: number of sources to keep, the newest included.
    """

    called = "source"  # in messages

    def __init__(self, method: Registrar | Tracker, most: int) -> None:
        self.method, self.most, self.config = method, most, method.config
        self._target: PreparedTarget | None = None
        self.reset()

    @property
    def collected(self) -> Array:
        """(N, 3) all kept points, mm."""
        raise NotImplementedError

    def reset(self) -> None:
        """Forget all sources, and the track of a `Tracker`."""
        self._far_in_a_row = 0
        if isinstance(self.method, Tracker):
            self.method.reset()

    def prepare(self, target: str | Path | ArrayLike | Surface, units: str = "mm") -> PreparedTarget:
        """Compute everything static about a target; see `Registrar.prepare`."""
        return self.method.prepare(target, units)

    def _begin_with(self, target: PreparedTarget) -> None:
        """Restart the collection where the target is another one than before."""
        if self._target is not None and self._target is not target:
            self.reset()
        self._target = target

    def _unless_far(self, points: Array) -> None:
        """Restart the collection with points (N, 3), mm, of the last source of a row metres away from the others.

        Raises:
            InvalidPointCloudError: points that are metres apart, or metres away from those collected.
        """
        if (extent_mm := Surface(points).extent_mm) > EXTENT_LIMITS_MM[1]:
            check_extent(extent_mm, "mm", f"the {self.called}")
        apart_mm = Surface(np.concatenate([self.collected, points])).extent_mm
        if apart_mm <= EXTENT_LIMITS_MM[1]:
            self._far_in_a_row = 0
            return
        self._far_in_a_row += 1
        if self._far_in_a_row < MOST_OFF:
            given = f"one that makes them {apart_mm:.0f} mm across"
            how = f"look at the transforms; {MOST_OFF} in a row restart the collection"
            raise InvalidPointCloudError(f"a {self.called} near the others, in one frame", given, how)
        log.warning("%d in a row are metres away from what was collected: the collection restarts", MOST_OFF)
        self.reset()


def together(sources: Sequence[Array]) -> Array:
    """Join sources (n, 3) to one cloud (N, 3), mm."""
    return np.concatenate([np.empty((0, 3)), *sources])
