"""How large a cloud is and which way it lies: half extent and principal axes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BEYOND = 1e12  # no coordinate, whatever its unit, but bytes that were read as one; its square may be infinite


class Principal(NamedTuple):
    """Principal axes of a cloud, longest first.

    Attributes:
        axes: (3, 3) orthonormal; the rows are the axes, each of arbitrary sign.
        variances: (3,) mm^2 along them.
    """

    axes: Array
    variances: Array


def half_extent_mm(points: Array) -> float:
    """Largest distance of (N, 3) points to their mean: the one scale of a pair."""
    return float(np.linalg.norm(points - points.mean(axis=0), axis=1).max())


def radius_mm(points: Array) -> float:
    """Root mean square distance of (N, 3) points to their mean; 1 at least, as it divides."""
    return max(float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean())), 1.0)


def principal(points: Array) -> Principal:
    """Directions of largest, middle and least spread of (N, 3) points."""
    centred = points - points.mean(axis=0)
    scatter, columns = np.linalg.eigh(centred.T @ centred)
    return Principal(columns[:, ::-1].T, scatter[::-1] / len(points))
