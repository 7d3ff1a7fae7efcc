"""Detection of sources metres away from all before: a wrong transform, or a bone that is elsewhere now."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from gapr_core.clouds import EXTENT_LIMITS_MM, check_extent
from gapr_core.errors import InvalidPointCloudError
from gapr_core.surface import Surface

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

MOST_OFF = 3  # sources in a row off the bone after which it has moved


class FarInARow:
    """Counts sources that are metres away from those collected: a few are left out, then the collection restarts.

    Args:
        most: number in a row that restarts the collection.
        called: name of a source in messages.
    """

    def __init__(self, most: int, called: str) -> None:
        self.most, self.called = most, called
        self.reset()

    def reset(self) -> None:
        """Forget the row."""
        self._count = 0

    def restarts_with(self, points: Array, collected: Array) -> bool:
        """Return True where the collection restarts with a source: it is the last one of a row.

        Args:
            points: (N, 3), mm, of the source; at least one.
            collected: (M, 3), mm, in the same frame.

        Raises:
            InvalidPointCloudError: points that are metres apart by themselves, or metres away from those collected.
        """
        if (extent_mm := Surface(points).extent_mm) > EXTENT_LIMITS_MM[1]:
            check_extent(extent_mm, "mm", f"the {self.called}")
        apart_mm = Surface(np.concatenate([collected, points])).extent_mm
        if apart_mm <= EXTENT_LIMITS_MM[1]:
            self._count = 0
            return False
        self._count += 1
        if self._count < self.most:
            given = f"one that makes them {apart_mm:.0f} mm across"
            how = f"look at the transforms; {self.most} in a row restart the collection"
            raise InvalidPointCloudError(f"a {self.called} near the others, in one frame", given, how)
        log.warning("%d in a row are metres away from what was collected: the collection restarts", self._count)
        self._count = 0
        return True
