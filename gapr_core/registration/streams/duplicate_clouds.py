"""Detection of repeated clouds: a driver that sends the last one again measures nothing new."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SAME_MM = 1e-4  # rounding to single precision; the noise of a new measurement moves the mean farther


class Fingerprint(NamedTuple):
    """Properties of a cloud that survive another order of its points and rounding.

    Attributes:
        number: number of points.
        mean: (3,) mm.
        spread: (3,) standard deviation along x, y and z, mm.
    """

    number: int
    mean: Array
    spread: Array

    def is_of_same(self, other: Fingerprint) -> bool:
        """Return True where both are of the same points."""
        if self.number != other.number:
            return False
        apart_mm = np.abs([self.mean - other.mean, self.spread - other.spread])
        return bool(apart_mm.max() <= SAME_MM)


def fingerprint(points: Array) -> Fingerprint:
    """Compute the fingerprint of points (N, 3), mm."""
    if not len(points):
        return Fingerprint(0, np.zeros(3), np.zeros(3))
    return Fingerprint(len(points), points.mean(axis=0), points.std(axis=0))
