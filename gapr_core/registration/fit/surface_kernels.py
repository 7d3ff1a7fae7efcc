"""Compiled parts of every loop over source points: the surface element near a point, its distance, its weight."""

# mypy: ignore-errors
from __future__ import annotations

import numba
import numpy as np

ELEMENT_RADIUS = 2.0  # of a surface element, in point spacings; beyond it the quadric is not extrapolated
WIDE = 16  # columns that a compiler may take at a time: sums go over a multiple of it
FAST = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}  # a check of divisors is a branch


@numba.njit(inline="always", **FAST)
def moved(T, p):
    """Move point p (3,) by T (4, 4)."""
    return (
        T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3],
        T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3],
        T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3],
    )


@numba.njit(inline="always", **FAST)
def element_near(x, y, z, nearest, origin, per_cell):
    """Look up the index of the target point near (x, y, z); -1 without one."""
    i = int(np.floor((x - origin[0]) * per_cell + 0.5))
    j = int(np.floor((y - origin[1]) * per_cell + 0.5))
    k = int(np.floor((z - origin[2]) * per_cell + 0.5))
    if i < 0 or j < 0 or k < 0 or i >= nearest.shape[0] or j >= nearest.shape[1] or k >= nearest.shape[2]:
        return -1
    return nearest[i, j, k]


@numba.njit(inline="always", **FAST)
def residual(x, y, z, q, elements, spacing, variance):
    """Compute the signed distance to element q, its gradient, and the distance aside of the element's disc.

    A row of `elements` is point (3), normal (3), shape xx xy xz yy yz zz, variance.
    """
    e = elements[q]
    reach = ELEMENT_RADIUS * spacing
    return distance(
        x - e[0], y - e[1], z - e[2], e[3], e[4], e[5], e[6], e[7], e[8], e[9], e[10], e[11], reach, variance
    )


@numba.njit(inline="always", **FAST)
def distance(dx, dy, dz, nx, ny, nz, xx, xy, xz, yy, yz, zz, reach, variance):
    """Compute `residual` of a point (dx, dy, dz) off the element, whose disc ends at `reach`, without a branch."""
    height = nx * dx + ny * dy + nz * dz
    tx, ty, tz = dx - height * nx, dy - height * ny, dz - height * nz
    aside = np.sqrt(tx * tx + ty * ty + tz * tz)
    inside = reach / max(aside, reach)
    tx, ty, tz = tx * inside, ty * inside, tz * inside
    sx = xx * tx + xy * ty + xz * tz
    sy = xy * tx + yy * ty + yz * tz
    sz = xz * tx + yz * ty + zz * tz
    nx, ny, nz = nx - sx, ny - sy, nz - sz
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    lift = 0.5 * variance * (xx + yy + zz)
    most = 0.5 * np.sqrt(variance)  # the expansion ends at sharp edges
    signed = (height - 0.5 * (sx * tx + sy * ty + sz * tz)) / length + min(max(lift, -most), most)
    return signed, nx / length, ny / length, nz / length, max(aside - reach, 0.0)


@numba.njit(inline="always", **FAST)
def padded(count):
    """Round up to the next multiple of `WIDE`."""
    return (count + WIDE - 1) // WIDE * WIDE


@numba.njit(inline="always", **FAST)
def tukey(square, limit):
    """Compute Tukey's biweight of a squared residual, without a branch that a processor would often mispredict."""
    inside = max(1.0 - square / (limit * limit), 0.0)
    return inside * inside
