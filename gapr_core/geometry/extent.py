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


def is_point(points: Array) -> NDArray[np.bool_]:
    """Mark which of (..., 3) rows can be points, (...): finite, and no coordinate beyond 1e12."""
    x, y, z = np.moveaxis(points, -1, 0)  # NumPy takes far longer along an axis of three
    return np.asarray((np.abs(x) < BEYOND) & (np.abs(y) < BEYOND) & (np.abs(z) < BEYOND))


def half_extent_mm(points: Array) -> float:
    """Largest distance of (N, 3) points to their mean: the one scale of a pair."""
    return float(np.linalg.norm(points - points.mean(axis=0), axis=1).max())


def half_edge_mm(points: Array) -> float:
    """Half of the longest edge of the axis-aligned box around (N, 3) points."""
    return 0.5 * float(np.ptp(points, axis=0).max())


def radius_mm(points: Array) -> float:
    """Root mean square distance of (N, 3) points to their mean; 1 at least, as it divides."""
    return max(float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean())), 1.0)


def principal(points: Array) -> Principal:
    """Directions of largest, middle and least spread of (N, 3) points."""
    centred = points - points.mean(axis=0)
    scatter, columns = np.linalg.eigh(centred.T @ centred)
    return Principal(columns[:, ::-1].T, scatter[::-1] / len(points))


LONG = 4.0  # variance along the longest axis over the next, above which a cloud has a long axis
NEAR_COS = 0.9  # of the angle to an axis that gives its name
OF_THE_BODY = ("the left-right axis", "the front-back axis", "the head-foot axis")  # x, y, z of LPS


def axis_in_words(axis: Array, points: Array) -> str:
    """Name a unit axis (3,): the long axis of points (N, 3), or one of the body (LPS)."""
    axes, variances = principal(points)
    if variances[0] > LONG * variances[1] and abs(axis @ axes[0]) > NEAR_COS:
        return "its long axis"
    nearest = int(np.abs(axis).argmax())
    return OF_THE_BODY[nearest] if abs(axis[nearest]) > NEAR_COS else "an axis ({:.1f}, {:.1f}, {:.1f})".format(*axis)
