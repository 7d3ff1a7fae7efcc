"""Compiled loop of `solid`: the two nearest samples of a medial sheet for every cell of a grid near it."""

# mypy: ignore-errors
from __future__ import annotations

import numba
import numpy as np

FAST = {"cache": True, "nogil": True, "error_model": "numpy"}


@numba.njit(**FAST)
def nearest_samples(x, y, z, centres, radii, limit):
    """Find the least distance minus radius of the two nearest samples at x, y, z, mm ascending, (Z, Y, X).

    Args:
        centres, radii: (K, 3), (K,) mm.
        limit: samples farther than this do not count; the value where there is none.
    """
    shape = len(z), len(y), len(x)
    first, second = np.full(shape, limit * limit), np.full(shape, limit * limit)
    of_first, of_second = np.full(shape, limit), np.full(shape, limit)
    for s in range(len(centres)):
        a, b, c, radius = centres[s, 0], centres[s, 1], centres[s, 2], radii[s]
        for i in range(np.searchsorted(z, c - limit), np.searchsorted(z, c + limit)):
            of_z = (z[i] - c) * (z[i] - c)
            for j in range(np.searchsorted(y, b - limit), np.searchsorted(y, b + limit)):
                of_yz = of_z + (y[j] - b) * (y[j] - b)
                left = limit * limit - of_yz
                if left <= 0.0:
                    continue
                half = np.sqrt(left)
                for k in range(np.searchsorted(x, a - half), np.searchsorted(x, a + half)):
                    apart = of_yz + (x[k] - a) * (x[k] - a)
                    if apart < first[i, j, k]:
                        second[i, j, k], of_second[i, j, k] = first[i, j, k], of_first[i, j, k]
                        first[i, j, k], of_first[i, j, k] = apart, radius
                    elif apart < second[i, j, k]:
                        second[i, j, k], of_second[i, j, k] = apart, radius
    return least(first, second, of_first, of_second, limit)


@numba.njit(**FAST)
def least(first, second, of_first, of_second, limit):
    """Squared distances and radii of the two nearest samples to the lesser of both distances from their surfaces."""
    found = np.empty(first.shape, np.float32)
    most = limit * limit
    for i in range(first.shape[0]):
        for j in range(first.shape[1]):
            for k in range(first.shape[2]):
                near = np.sqrt(first[i, j, k]) - of_first[i, j, k] if first[i, j, k] < most else limit
                next_one = np.sqrt(second[i, j, k]) - of_second[i, j, k] if second[i, j, k] < most else limit
                found[i, j, k] = min(near, next_one)
    return found
