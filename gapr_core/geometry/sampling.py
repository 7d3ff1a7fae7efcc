"""Thinning of clouds: one point per voxel, and points far from each other."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ROUNDING = 1e-9  # of distances and coordinates, mm: in another frame, or order, the same ones differ by less


def voxel_indices(points: Array, voxel_mm: float) -> NDArray[np.int64]:
    """Indices of one point of (N, 3) per occupied voxel: the one nearest to the mean of its voxel's points; sorted."""
    return np.sort(_central(points, *bounds(points), voxel_mm))  # type: ignore[no-any-return]


def distinct(points: Array) -> Array:
    """(N, 3) points as (K, 3) without doubles, in order of x, then y, then z.

    As `np.unique(points, axis=0)`, which however stops every other thread while it sorts: 25 s for 3 million points.
    """
    ordered = points[np.lexsort(points.T[::-1])]
    is_new = (ordered[1:] != ordered[:-1]).any(axis=1)
    return np.asarray(ordered[np.concatenate([np.ones(min(len(points), 1), dtype=bool), is_new])])


def without_crowds(points: Array, voxel_mm: float, fewest: int, times: float) -> Array:
    """Points (N, 3) of which no voxel holds more than `fewest`, nor than so many times the typical voxel.

    Which of a voxel's points stay is drawn from a fixed seed, so that their mean is theirs whatever order they came in.
    """
    voxel = _voxels(points, *bounds(points), voxel_mm)
    counts = np.bincount(voxel)
    most = max(fewest, int(times * np.median(counts)))
    if counts.max() <= most:
        return points
    shuffled = np.random.default_rng(0).permutation(len(points))
    order = shuffled[np.argsort(voxel[shuffled], kind="stable")]
    place = np.arange(len(points)) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.asarray(points[np.sort(order[place < most])])


def bounds(points: Array) -> tuple[Array, Array]:
    """Lowest and highest coordinates (3,) of (N, 3) points; along the first axis NumPy takes forty times as long."""
    columns = np.ascontiguousarray(points.T)
    return columns.min(axis=1), columns.max(axis=1)


def thin(points: Array, most: int) -> NDArray[np.int64]:
    """Indices of at most `most` of (N, 3) points, evenly spread: the finest voxel grid that keeps that many."""
    if len(points) <= most:
        return np.arange(len(points))
    corners = bounds(points)
    low, high, kept = 0.0, float((corners[1] - corners[0]).max()) + 1e-9, 0
    for _ in range(12):  # bisection on the voxel size
        middle = 0.5 * (low + high) if low else high / 16.0
        occupied = _occupied(points, *corners, middle, most)
        if occupied > most:
            low = middle
        else:
            high, kept = middle, occupied
            if kept > 0.97 * most:
                break
    return voxel_indices(points, high) if kept else np.arange(most)


@numba.njit(cache=True, nogil=True)
def _occupied(points, low, high, voxel, most):  # type: ignore[no-untyped-def]
    """Count the voxels that hold points, up to one more than `most`."""
    table, found = _table(most + 1), 0
    for p in range(len(points)):
        key = _voxel(points, p, low, high, voxel)
        slot = _slot(table, key)
        if table[slot, 1] == 0:
            table[slot, 0], table[slot, 1] = key, 1
            found += 1
            if found > most:
                break
    return found


@numba.njit(cache=True, nogil=True)
def _voxels(points, low, high, voxel):  # type: ignore[no-untyped-def]
    """(N,) which voxel each point is in, numbered from 0 as they come."""
    table, voxel_of, found = _table(len(points)), np.empty(len(points), dtype=np.int64), 0
    for p in range(len(points)):
        key = _voxel(points, p, low, high, voxel)
        slot = _slot(table, key)
        if table[slot, 1] == 0:
            found += 1
            table[slot, 0], table[slot, 1] = key, found
        voxel_of[p] = table[slot, 1] - 1
    return voxel_of


@numba.njit(cache=True, nogil=True)
def _central(points, low, high, voxel):  # type: ignore[no-untyped-def]
    """Find the point of each voxel that is nearest to the mean.

    Of equally near ones, as two in a voxel are but for rounding, the one that comes first by x, y, z.
    """
    voxel_of = _voxels(points, low, high, voxel)
    found = voxel_of.max() + 1
    means, counts = np.zeros((found, 3)), np.zeros(found)
    for p in range(len(points)):
        counts[voxel_of[p]] += 1.0
        for axis in range(3):
            means[voxel_of[p], axis] += points[p, axis]
    distances, least = np.empty(len(points)), np.full(found, np.inf)
    for p in range(len(points)):
        c = voxel_of[p]
        x = points[p, 0] - means[c, 0] / counts[c]
        y = points[p, 1] - means[c, 1] / counts[c]
        z = points[p, 2] - means[c, 2] / counts[c]
        distances[p] = np.sqrt(x * x + y * y + z * z)
        least[c] = min(least[c], distances[p])
    nearest = np.full(found, -1)
    for p in range(len(points)):
        c = voxel_of[p]
        if distances[p] <= least[c] + ROUNDING and (nearest[c] < 0 or _comes_before(points, p, nearest[c])):
            nearest[c] = p
    return nearest


@numba.njit(cache=True, nogil=True)
def _comes_before(points, p, q):  # type: ignore[no-untyped-def]
    """True where point p comes before point q by x, y, z."""
    for axis in range(3):
        if abs(points[p, axis] - points[q, axis]) > ROUNDING:
            return points[p, axis] < points[q, axis]
    return False


@numba.njit(cache=True, nogil=True)
def _voxel(points, p, low, high, voxel):  # type: ignore[no-untyped-def]
    """Number the voxel of point p."""
    key = np.int64(0)
    for axis in range(3):
        along = np.int64(np.floor((high[axis] - low[axis]) / voxel)) + 1
        key = key * along + np.int64(np.floor((points[p, axis] - low[axis]) / voxel))
    return key


@numba.njit(cache=True, nogil=True)
def _table(entries):  # type: ignore[no-untyped-def]
    """Make an empty hash table with room for some entries: rows of a key and a value, 0 if empty."""
    slots = 2
    while slots < 2 * entries:
        slots *= 2
    return np.zeros((slots, 2), dtype=np.int64)


@numba.njit(cache=True, nogil=True)
def _slot(table, key):  # type: ignore[no-untyped-def]
    """Find the row of the key, or the one where it belongs."""
    last = np.uint64(len(table) - 1)
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    slot = (mixed ^ (mixed >> np.uint64(32))) & last
    while table[slot, 1] != 0 and table[slot, 0] != key:
        slot = (slot + np.uint64(1)) & last
    return slot


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


def log_uniform(limits: tuple[float, float], rng: np.random.Generator) -> float:
    """Draw a number between two positive limits, uniform in its logarithm."""
    return float(np.exp(rng.uniform(*np.log(limits))))
