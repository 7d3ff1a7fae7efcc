"""Is a source one that was there before? A driver that sends the last cloud again measures nothing new."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

SAME_MM = 1e-3  # what rounding to single precision, or another order of points, leaves; far below any sensor's noise
MOST_COMPARED = 500


def is_sent_again(points: Array, before: Array) -> bool:
    """True where most of the points (N, 3) are among those before (M, 3), mm, to `SAME_MM`, in any order."""
    if np.array_equal(points, before):
        return True
    if not len(points) or not len(before):
        return False
    some = points[:: 1 + len(points) // MOST_COMPARED]
    apart_mm = cKDTree(before).query(some, distance_upper_bound=SAME_MM)[0]
    return bool(np.mean(apart_mm <= SAME_MM) > 0.5)
