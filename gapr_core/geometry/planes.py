"""Planes through the neighbourhoods of points: normals alone, where no tangents are asked for."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SWEEPS = 12  # most of Jacobi's method, which converges after four or five


def fit_planes(points: Array, neighbours: NDArray[np.int64]) -> tuple[Array, Array, Array]:
    """Fit a plane to each point's neighbours by least squares.

    Args:
        points: (N, 3), mm.
        neighbours: (M, k) indices into points, one row for each plane.

    Returns:
        (M, 3) unit normals of arbitrary sign; (M,) root-mean-square distance of the neighbours to their plane, mm; and
        (M, 3) the means of the neighbours, mm.
    """
    return _fit_planes(np.ascontiguousarray(points, dtype=np.float64), neighbours)  # type: ignore[no-any-return]


@numba.njit(cache=True, nogil=True)
def _fit_planes(points, neighbours):  # type: ignore[no-untyped-def]
    count, k = neighbours.shape
    normals, flatness, means = np.empty((count, 3)), np.empty(count), np.zeros((count, 3))
    A, V = np.empty((3, 3)), np.empty((3, 3))
    for r in range(count):
        x = y = z = 0.0
        for q in neighbours[r]:
            x, y, z = x + points[q, 0], y + points[q, 1], z + points[q, 2]
        x, y, z = x / k, y / k, z / k
        xx = xy = xz = yy = yz = zz = 0.0
        for q in neighbours[r]:
            dx, dy, dz = points[q, 0] - x, points[q, 1] - y, points[q, 2] - z
            xx, xy, xz = xx + dx * dx, xy + dx * dy, xz + dx * dz
            yy, yz, zz = yy + dy * dy, yz + dy * dz, zz + dz * dz
        A[0, 0], A[0, 1], A[0, 2] = xx / k, xy / k, xz / k
        A[1, 0], A[1, 1], A[1, 2] = xy / k, yy / k, yz / k
        A[2, 0], A[2, 1], A[2, 2] = xz / k, yz / k, zz / k
        _diagonalise(A, V)
        least = 0
        for a in range(1, 3):
            if A[a, a] < A[least, least]:
                least = a
        flatness[r] = np.sqrt(max(A[least, least], 0.0))
        for a in range(3):
            normals[r, a] = V[a, least]
        means[r, 0], means[r, 1], means[r, 2] = x, y, z
    return normals, flatness, means


@numba.njit(cache=True, nogil=True)
def _diagonalise(A, V):  # type: ignore[no-untyped-def]
    """Eigenvalues of symmetric A (3, 3) onto its diagonal, eigenvectors into the columns of V (Jacobi 1846)."""
    for a in range(3):
        for b in range(3):
            V[a, b] = 1.0 if a == b else 0.0
    for _ in range(SWEEPS):
        if A[0, 1] == 0.0 and A[0, 2] == 0.0 and A[1, 2] == 0.0:
            break
        for a in range(2):
            for b in range(a + 1, 3):
                if abs(A[a, b]) <= 1e-18 * (abs(A[a, a]) + abs(A[b, b])):
                    A[a, b] = A[b, a] = 0.0
                    continue
                half = 0.5 * (A[b, b] - A[a, a]) / A[a, b]
                t = 1.0 / (abs(half) + np.sqrt(half * half + 1.0))
                t = -t if half < 0.0 else t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                A[a, a], A[b, b] = A[a, a] - t * A[a, b], A[b, b] + t * A[a, b]
                A[a, b] = A[b, a] = 0.0
                other = 3 - a - b
                first, second = A[a, other], A[b, other]
                A[a, other] = A[other, a] = c * first - s * second
                A[b, other] = A[other, b] = s * first + c * second
                for row in range(3):
                    first, second = V[row, a], V[row, b]
                    V[row, a], V[row, b] = c * first - s * second, s * first + c * second
