"""Thinning of clouds: one point per voxel, and points far from each other."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def voxel_indices(points: Array, voxel_mm: float) -> NDArray[np.int64]:
    """Indices of one point of (N, 3) per occupied voxel: the one nearest to the mean of its voxel's points; sorted."""
    _, voxel, counts = np.unique(_cells(points, voxel_mm), return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(voxel, weights=axis) for axis in points.T], axis=1) / counts[:, None]
    order = np.lexsort((np.linalg.norm(points - means[voxel], axis=1), voxel))
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    return np.sort(order[first])


def distinct(points: Array) -> Array:
    """(N, 3) points as (K, 3) without doubles, in order of x, then y, then z.

    As `np.unique(points, axis=0)`, which however stops every other thread while it sorts: 25 s for 3 million points.
    """
    ordered = points[np.lexsort(points.T[::-1])]
    is_new = (ordered[1:] != ordered[:-1]).any(axis=1)
    return np.asarray(ordered[np.concatenate([np.ones(min(len(points), 1), dtype=bool), is_new])])


def _cells(points: Array, voxel_mm: float) -> NDArray[np.int64]:
    """(N,) numbers of the voxels that points (N, 3) are in."""
    x, y, z = np.floor((points - points.min(axis=0)) / voxel_mm).astype(np.int64).T
    return np.asarray((x * (y.max() + 1) + y) * (z.max() + 1) + z)


def thin(points: Array, most: int) -> NDArray[np.int64]:
    """Indices of at most `most` of (N, 3) points, evenly spread: the finest voxel grid that keeps that many."""
    if len(points) <= most:
        return np.arange(len(points))
    low, high, kept = 0.0, float(np.ptp(points, axis=0).max()) + 1e-9, 0
    for _ in range(12):  # bisection on the voxel size
        middle = 0.5 * (low + high) if low else high / 16.0
        occupied = len(np.unique(_cells(points, middle)))
        if occupied > most:
            low = middle
        else:
            high, kept = middle, occupied
            if kept > 0.97 * most:
                break
    return voxel_indices(points, high) if kept else np.arange(most)


def farthest_points(points: Array, count: int, start: int = 0) -> NDArray[np.int64]:
    """Indices of `count` of (N, 3) points, each the farthest from those before it (PointNet++, Qi et al. 2017)."""
    return _farthest(np.ascontiguousarray(points, dtype=np.float64), min(count, len(points)), start)


@numba.njit(cache=True, nogil=True)
def _farthest(points, count, start):  # type: ignore[no-untyped-def]
    chosen = np.empty(count, dtype=np.int64)
    square = np.full(len(points), np.inf)
    latest = start
    for i in range(count):
        chosen[i] = latest
        farthest = -1.0
        x, y, z = points[chosen[i]]
        for p in range(len(points)):
            d = (points[p, 0] - x) ** 2 + (points[p, 1] - y) ** 2 + (points[p, 2] - z) ** 2
            square[p] = min(square[p], d)
            if square[p] > farthest:
                farthest = square[p]
                latest = p
    return chosen


def fibonacci_directions(count: int) -> Array:
    """(count, 3) unit vectors, evenly spread on the sphere."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    azimuth = np.pi * (1.0 + np.sqrt(5.0)) * k
    radius = np.sqrt(1.0 - z**2)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)


def random_directions(count: int, rng: np.random.Generator) -> Array:
    """(count, 3) unit vectors, uniform on the sphere."""
    vectors = rng.normal(size=(count, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
