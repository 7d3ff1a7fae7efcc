"""Polygons and strips as triangles."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

log = logging.getLogger(__name__)
Indices = NDArray[np.int64]


def integers(values: NDArray[np.float64]) -> Indices:
    """Convert to integers.

    Raises:
        ValueError: one of them is none.
    """
    indices = values.astype(np.int64)
    if (indices != values).any():
        raise ValueError("indices that are no integers")
    return indices


def fans(offsets: Indices, corners: Indices) -> Indices:
    """(F, 3) triangles of polygons, each a fan around its first corner.

    Args:
        offsets: (P + 1,) where each polygon starts in `corners`, and where the last one ends.
        corners: (C,) vertex indices.

    Raises:
        ValueError: offsets that do not rise from 0 to C.
    """
    sizes = _sizes(offsets, corners)
    if len(sizes) and (sizes == 3).all():
        return corners.reshape(-1, 3)
    if (sizes < 3).any():
        log.warning("a mesh has %d polygons of fewer than three corners, which are left out", (sizes < 3).sum())
    triangles = np.maximum(sizes - 2, 0)
    start = np.repeat(offsets[:-1], triangles)
    step = np.arange(len(start)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    return np.stack([corners[start], corners[start + step + 1], corners[start + step + 2]], axis=1)


def strips(offsets: Indices, corners: Indices) -> Indices:
    """(F, 3) triangles of triangle strips; every other one is turned, so that all face the same way."""
    sizes = _sizes(offsets, corners)
    triangles = np.maximum(sizes - 2, 0)
    step = np.arange(triangles.sum()) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    start = np.repeat(offsets[:-1], triangles) + step
    odd = step % 2
    return np.stack([corners[start + odd], corners[start + 1 - odd], corners[start + 2]], axis=1)


def offsets_of_counted(cells: Indices, count: int) -> tuple[Indices, Indices]:
    """Offsets and corners of `count` cells that each begin with their number of corners (legacy VTK).

    Raises:
        ValueError: the cells do not fill the list exactly.
    """
    if count and len(cells) == 4 * count and (cells[::4] == 3).all():
        return np.arange(0, 3 * count + 1, 3), cells.reshape(-1, 4)[:, 1:].ravel()
    starts, at = np.empty(count + 1, dtype=np.int64), 0
    for i in range(count):
        starts[i] = at
        if at >= len(cells) or cells[at] < 0:
            raise ValueError("cells whose sizes do not add up")
        at += int(cells[at]) + 1
    starts[count] = at
    if at != len(cells):
        raise ValueError("cells whose sizes do not add up")
    return starts - np.arange(count + 1), np.delete(cells, starts[:-1])


def _sizes(offsets: Indices, corners: Indices) -> Indices:
    if len(offsets) == 0 or offsets[0] != 0 or offsets[-1] != len(corners) or (np.diff(offsets) < 0).any():
        raise ValueError("polygons whose offsets do not fit their corners")
    return np.diff(offsets)
