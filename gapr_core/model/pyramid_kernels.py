"""Compiled loops of the pyramid: centroids and spreads of neighbourhoods, without a tensor of all neighbours."""

# mypy: ignore-errors
from __future__ import annotations

import numba
import numpy as np

FAST = {"cache": True, "nogil": True, "error_model": "numpy"}


@numba.njit(**FAST)
def balls(centres, support, distance, index, radius, small, valid, c_h, c_k):
    """Fill valid (N, K) and the centroids of both balls (N, 3); `index` of points outside becomes 0.

    The nearest support point (M, 3) of a centre (N, 3) always counts, `small` is the radius of the smaller ball.
    """
    for n in range(len(centres)):
        all_of, near_of = 0, 0
        c_h[n, :], c_k[n, :] = 0.0, 0.0
        for j in range(index.shape[1]):
            valid[n, j] = j == 0 or distance[n, j] <= radius
            if not valid[n, j]:
                index[n, j] = 0
                continue
            m = index[n, j]
            all_of += 1
            for axis in range(3):
                c_h[n, axis] += support[m, axis]
            if distance[n, j] <= small:
                near_of += 1
                for axis in range(3):
                    c_k[n, axis] += support[m, axis]
        for axis in range(3):
            c_h[n, axis] /= all_of
            c_k[n, axis] = c_k[n, axis] / near_of if near_of > 0 else centres[n, axis]


@numba.njit(**FAST)
def spreads(points, index, valid, c_h):
    """Sum outer products (N, 3, 3) of neighbours, rows `index` (N, K) of the points, about c_h (N, 3)."""
    found = np.zeros((len(index), 3, 3))
    for n in range(len(index)):
        for j in range(index.shape[1]):
            if valid[n, j]:
                m = index[n, j]
                for a in range(3):
                    for b in range(3):
                        found[n, a, b] += (points[m, a] - c_h[n, a]) * (points[m, b] - c_h[n, b])
    return found
