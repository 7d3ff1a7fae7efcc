"""The target as a grid: for every cell its nearest target point and the distance to the surface there."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from gapr_core.geometry.sampling import bounds
from gapr_core.runtime.parallel import in_pieces

Array = NDArray[np.float64]

SMALLEST_CELL_MM, MOST_CELLS = 1.5, 2_500_000  # cells are larger where there would be more of them
FAR = -1  # index of cells farther than the reach
FARTHEST = 255  # distance of these cells, in steps of the field: distances are bytes


@dataclass(frozen=True)
class DistanceField:
    """Nearest points and truncated distances on a regular grid around the target.

    Attributes:
        origin: (3,) centre of cell (0, 0, 0), mm.
        cell_mm: edge of a cell.
        nearest: (X, Y, Z) int32 index of the target point nearest to the cell's centre; `FAR` beyond the reach.
        distance: (X, Y, Z) uint8 distance of the centre to the surface in steps of `reach_mm` / `FARTHEST`; beyond the
            reach `FARTHEST`.
        reach_mm: distances are truncated here.
    """

    origin: Array
    cell_mm: float
    nearest: NDArray[np.int32]
    distance: NDArray[np.uint8]
    reach_mm: float


def build(
    points: Array,
    normals: Array,
    spacing_mm: float,
    reach_mm: float = 12.0,
    num_threads: int = 1,
) -> DistanceField:
    """Build the field of a target (N, 3), mm, with unit normals; cells as fine as the limits allow."""
    low, high = bounds(points)
    low, high = low - reach_mm, high + reach_mm
    cell_mm = max(SMALLEST_CELL_MM, float(np.prod(high - low) / MOST_CELLS) ** (1.0 / 3.0))
    shape = np.ceil((high - low) / cell_mm).astype(int) + 1
    nearest = np.full(shape, FAR, dtype=np.int32)
    distance = np.full(shape, FARTHEST, dtype=np.uint8)

    def work(slab: NDArray[np.int64]) -> None:
        part = slice(slab[0], slab[-1] + 1)
        _nearest_points(points, low, cell_mm, slab[0], nearest[part], reach_mm)
        _distances(
            points, normals, low, cell_mm, slab[0], nearest[part], spacing_mm, FARTHEST / reach_mm, distance[part]
        )

    in_pieces(work, np.arange(shape[0]), num_threads)
    return DistanceField(low, cell_mm, nearest, distance, reach_mm)


@numba.njit(cache=True, nogil=True, fastmath=True)
def _nearest_points(points, low, cell, first, nearest, reach):  # type: ignore[no-untyped-def]
    """Fill `nearest`, the cells from `first` on, with the nearest point within reach of their centres.

    Each point fills its ball.
    """
    nx, ny, nz = nearest.shape
    squares = np.full(nearest.size, np.float32(reach * reach), dtype=np.float32)
    flat, aside, r = nearest.reshape(-1), np.empty(nz), reach / cell
    for q in range(len(points)):
        x, y, z = (points[q, 0] - low[0]) / cell, (points[q, 1] - low[1]) / cell, (points[q, 2] - low[2]) / cell
        start, stop = max(0, int(np.ceil(z - r))), min(nz, int(z + r) + 1)
        for k in range(start, stop):
            aside[k - start] = (k - z) ** 2
        for i in range(max(first, int(np.ceil(x - r))), min(first + nx, int(x + r) + 1)):
            for j in range(max(0, int(np.ceil(y - r))), min(ny, int(y + r) + 1)):
                across = (i - x) ** 2 + (j - y) ** 2
                if across > r * r:
                    continue
                row = np.uint64(((i - first) * ny + j) * nz + start)  # unsigned, or the loop is not vectorised
                for k in range(np.uint64(stop - start)):
                    square = np.float32((across + aside[k]) * cell * cell)
                    if square < squares[row + k]:
                        squares[row + k] = square
                        flat[row + k] = q


@numba.njit(cache=True, nogil=True)
def _distances(points, normals, low, cell, first, nearest, spacing, per_mm, distance):  # type: ignore[no-untyped-def]
    """Fill `distance` with the distances of the cells from `first` on to the surface around their nearest points.

    A disc of radius `spacing` stands for it.
    """
    nx, ny, nz = nearest.shape
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                q = nearest[i, j, k]
                if q < 0:
                    continue
                x = (i + first) * cell + low[0] - points[q, 0]
                y = j * cell + low[1] - points[q, 1]
                z = k * cell + low[2] - points[q, 2]
                height = (x * normals[q, 0] + z * normals[q, 2]) + y * normals[q, 1]  # in the order of NumPy's einsum
                aside = np.sqrt(max((x * x + z * z) + y * y - height**2, 0.0))
                gap = np.hypot(height, max(aside - spacing, 0.0))
                distance[i, j, k] = min(np.rint(gap * per_mm), FARTHEST - 1.0)
