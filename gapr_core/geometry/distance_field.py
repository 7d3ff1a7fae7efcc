"""The target as a grid: for every cell its nearest target point and the distance to the surface there."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FAR = -1  # index of cells farther than the reach


@dataclass(frozen=True)
class DistanceField:
    """Nearest points and truncated distances on a regular grid around the target.

    Attributes:
        origin: (3,) centre of cell (0, 0, 0), mm.
        cell_mm: edge of a cell.
        nearest: (X, Y, Z) int32 index of the target point nearest to the cell's centre; `FAR` beyond the reach.
        distance: (X, Y, Z) uint8 distance of the centre to the surface in steps of `reach_mm` / 255, 255 beyond.
        reach_mm: distances are truncated here.
    """

    origin: Array
    cell_mm: float
    nearest: NDArray[np.int32]
    distance: NDArray[np.uint8]
    reach_mm: float

    def lookup(self, points: Array) -> NDArray[np.int32]:
        """Index of the target point near each of (N, 3) points, `FAR` where there is none within the reach."""
        cell = np.rint((points - self.origin) / self.cell_mm).astype(np.int64)
        inside = ((cell >= 0) & (cell < self.nearest.shape)).all(axis=1)
        cell[~inside] = 0
        return np.where(inside, self.nearest[tuple(cell.T)], FAR).astype(np.int32)


def build(
    points: Array, normals: Array, spacing_mm: float, reach_mm: float = 12.0, most_cells: int = 2_500_000
) -> DistanceField:
    """The field of a target (N, 3), mm, with unit normals (N, 3); cells as fine as `most_cells` allows, >= 1.5 mm."""
    low, high = points.min(axis=0) - reach_mm, points.max(axis=0) + reach_mm
    cell_mm = max(1.5, float(np.prod(high - low) / most_cells) ** (1.0 / 3.0))
    shape = np.ceil((high - low) / cell_mm).astype(int) + 1
    nearest = _nearest_points(points, low, cell_mm, shape[0], shape[1], shape[2], reach_mm)
    near = np.nonzero(nearest >= 0)
    index = nearest[near]
    centres = np.stack(near, axis=1) * cell_mm + low
    gap = surface_distance(centres, points[index], normals[index], spacing_mm)
    distance = np.full(shape, 255, dtype=np.uint8)
    distance[near] = np.minimum(np.rint(gap * (255.0 / reach_mm)), 254.0)
    return DistanceField(low, cell_mm, nearest, distance, reach_mm)


def surface_distance(points: Array, nearest: Array, normals: Array, spacing_mm: float) -> Array:
    """Distance (N,) to the discs of radius `spacing_mm` that stand for the surface around each nearest point."""
    offset = points - nearest
    height = np.einsum("ni,ni->n", offset, normals)
    aside = np.sqrt(np.maximum(np.einsum("ni,ni->n", offset, offset) - height**2, 0.0))
    return np.hypot(height, np.maximum(aside - spacing_mm, 0.0))


@numba.njit(cache=True, nogil=True, fastmath=True)
def _nearest_points(points, low, cell, nx, ny, nz, reach):  # type: ignore[no-untyped-def]
    """Index of the nearest point for every cell whose centre is within the reach of one: each point fills its ball."""
    nearest = np.full((nx, ny, nz), -1, dtype=np.int32)
    squares = np.full((nx, ny, nz), np.float32(reach * reach), dtype=np.float32)
    for q in range(len(points)):
        x, y, z = (points[q, 0] - low[0]) / cell, (points[q, 1] - low[1]) / cell, (points[q, 2] - low[2]) / cell
        r = reach / cell
        for i in range(max(0, int(np.ceil(x - r))), min(nx, int(x + r) + 1)):
            ry = np.sqrt(max(r * r - (i - x) ** 2, 0.0))
            for j in range(max(0, int(np.ceil(y - ry))), min(ny, int(y + ry) + 1)):
                flat = (i - x) ** 2 + (j - y) ** 2
                rz = np.sqrt(max(r * r - flat, 0.0))
                for k in range(max(0, int(np.ceil(z - rz))), min(nz, int(z + rz) + 1)):
                    square = np.float32((flat + (k - z) ** 2) * cell * cell)
                    if square < squares[i, j, k]:
                        squares[i, j, k] = square
                        nearest[i, j, k] = q
    return nearest
