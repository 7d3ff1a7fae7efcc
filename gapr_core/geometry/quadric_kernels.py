"""Compiled loops of the quadrics: the fit to a point's neighbours, and how far these lie from it.

Sums of three run in the order of NumPy's `einsum` (first, third, second), so that results keep the bits that the
confidence was calibrated on.
"""

# mypy: ignore-errors
from __future__ import annotations

import numba
import numpy as np

EXACT = {"cache": True, "nogil": True, "error_model": "numpy"}  # no fast mathematics: it reorders sums
RIDGE = 1e-6  # added to the diagonal of the normal equations


@numba.njit(**EXACT)
def dot(ax, ay, az, bx, by, bz):
    """Scalar product of a and b."""
    return (ax * bx + az * bz) + ay * by


@numba.njit(**EXACT)
def length(x, y, z):
    """|(x, y, z)|."""
    return np.sqrt(x * x + y * y + z * z)


@numba.njit(**EXACT)
def tangents(nx, ny, nz, lx, ly, lz):
    """Two orthonormal tangents of the unit normal n, the first one close to l."""
    along = dot(lx, ly, lz, nx, ny, nz)
    x, y, z = lx - along * nx, ly - along * ny, lz - along * nz
    size = length(x, y, z)
    x, y, z = x / size, y / size, z / size
    return (x, y, z), (ny * z - nz * y, nz * x - nx * z, nx * y - ny * x)


@numba.njit(**EXACT)
def equations(points, normals, neighbours, rows):
    """Set up the normal equations of some rows, tangents (R, 2, 3) and reach (R,)."""
    gram, right = np.zeros((len(rows), 6, 6)), np.zeros((len(rows), 6, 1))
    basis, reach = np.empty((len(rows), 2, 3)), np.empty(len(rows))
    far, design = np.empty(neighbours.shape[1]), np.ones(6)
    for r in range(len(rows)):
        p = rows[r]
        px, py, pz = points[p, 0], points[p, 1], points[p, 2]
        nx, ny, nz = normals[p, 0], normals[p, 1], normals[p, 2]
        lx = 1.0 if abs(nx) < 0.7 else 0.0
        (fx, fy, fz), (sx, sy, sz) = tangents(nx, ny, nz, lx, 1.0 - lx, 0.0)
        basis[r, 0, 0], basis[r, 0, 1], basis[r, 0, 2] = fx, fy, fz
        basis[r, 1, 0], basis[r, 1, 1], basis[r, 1, 2] = sx, sy, sz
        farthest = 0.0
        for j in range(len(far)):
            q = neighbours[p, j]
            far[j] = length(points[q, 0] - px, points[q, 1] - py, points[q, 2] - pz)
            farthest = max(farthest, far[j])
        reach[r] = farthest * 1.05
        for j in range(len(far)):
            q = neighbours[p, j]
            x, y, z = points[q, 0] - px, points[q, 1] - py, points[q, 2] - pz
            agreement = dot(normals[q, 0], normals[q, 1], normals[q, 2], nx, ny, nz)
            weight = min(max(1.0 - (far[j] / reach[r]) ** 2, 0.0), 1.0) ** 2 * min(max(agreement, 0.0), 1.0) ** 2
            u, v = dot(x, y, z, fx, fy, fz) / reach[r], dot(x, y, z, sx, sy, sz) / reach[r]
            height = dot(x, y, z, nx, ny, nz)
            design[1], design[2], design[3], design[4], design[5] = u, v, 0.5 * u * u, u * v, 0.5 * v * v
            for a in range(6):
                right[r, a, 0] += design[a] * weight * height
                for b in range(6):
                    gram[r, a, b] += design[a] * weight * design[b]
        for a in range(6):
            gram[r, a, a] += RIDGE
    return gram, right, basis, reach


@numba.njit(**EXACT)
def elements(normals, coefficients, basis, reach):
    """Corrected normals (R, 3) and shapes (R, 3, 3) from solutions (R, 6, 1) of the normal equations."""
    corrected, shapes = np.empty((len(normals), 3)), np.empty((len(normals), 3, 3))
    for r in range(len(normals)):
        fx, fy, fz = basis[r, 0, 0], basis[r, 0, 1], basis[r, 0, 2]
        sx, sy, sz = basis[r, 1, 0], basis[r, 1, 1], basis[r, 1, 2]
        g, h = coefficients[r, 1, 0] / reach[r], coefficients[r, 2, 0] / reach[r]
        square = reach[r] ** 2
        d, e, f = coefficients[r, 3, 0] / square, coefficients[r, 4, 0] / square, coefficients[r, 5, 0] / square
        nx = normals[r, 0] - (g * fx + h * sx)
        ny = normals[r, 1] - (g * fy + h * sy)
        nz = normals[r, 2] - (g * fz + h * sz)
        size = length(nx, ny, nz)
        nx, ny, nz = nx / size, ny / size, nz / size
        corrected[r, 0], corrected[r, 1], corrected[r, 2] = nx, ny, nz
        s, t = tangents(nx, ny, nz, fx, fy, fz)
        for a in range(3):
            for b in range(3):
                shapes[r, a, b] = s[a] * d * s[b] + s[a] * e * t[b] + t[a] * e * s[b] + t[a] * f * t[b]
    return corrected, shapes


@numba.njit(**EXACT)
def heights(points, normals, shapes, neighbours, rows):
    """(R, k) signed distances of the neighbours of some rows to these rows' quadrics, as `quadrics.heights`."""
    found = np.empty((len(rows), neighbours.shape[1]))
    for r in range(len(rows)):
        p = rows[r]
        nx, ny, nz = normals[p, 0], normals[p, 1], normals[p, 2]
        s = shapes[p]
        for j in range(neighbours.shape[1]):
            q = neighbours[p, j]
            x, y, z = points[q, 0] - points[p, 0], points[q, 1] - points[p, 1], points[q, 2] - points[p, 2]
            height = x * nx + y * ny + z * nz
            x, y, z = x - height * nx, y - height * ny, z - height * nz
            bx = dot(s[0, 0], s[0, 1], s[0, 2], x, y, z)
            by = dot(s[1, 0], s[1, 1], s[1, 2], x, y, z)
            bz = dot(s[2, 0], s[2, 1], s[2, 2], x, y, z)
            found[r, j] = (height - 0.5 * (bx * x + by * y + bz * z)) / length(nx - bx, ny - by, nz - bz)
    return found
