"""Compiled loops over triangles."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, boundscheck=True)  # of faces that nobody has checked
def crosses(points, faces):  # type: ignore[no-untyped-def]
    """(F, 3) cross products of two edges of each triangle, outward by its winding, and their lengths (F,).

    Args:
        points: (N, 3) vertices.
        faces: (F, 3) integers, indices into points.

    Raises:
        IndexError: a face without a vertex.
    """
    across, lengths = np.empty((len(faces), 3)), np.empty(len(faces))
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, uy, uz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
        vx, vy, vz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        across[f, 0], across[f, 1], across[f, 2] = x, y, z
        lengths[f] = np.sqrt(x * x + y * y + z * z)
    return across, lengths


@numba.njit(cache=True, nogil=True, error_model="numpy")
def sampled(points, faces, across, lengths, upto, chosen, u, v):  # type: ignore[no-untyped-def]
    """Points on faces and the unit normals there, (C, 3) each.

    Args:
        points, faces, across, lengths: as `crosses` takes and gives them.
        upto: (F,) share of the area of all faces up to each, 1 at the last.
        chosen, u, v: (C,) uniform in [0, 1): which face, by its share of the area, and where on it.
    """
    count = len(upto)
    first = np.searchsorted(upto, np.arange(count) / count, side="right")  # where to look from, of as many strips
    found, normals = np.empty((len(chosen), 3)), np.empty((len(chosen), 3))
    for i in range(len(chosen)):
        f = first[min(int(chosen[i] * count), count - 1)]
        while f > 0 and upto[f - 1] > chosen[i]:  # a strip's edge may be rounded
            f -= 1
        while upto[f] <= chosen[i]:
            f += 1
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        over = u[i] + v[i] > 1.0
        x, y = (1.0 - u[i], 1.0 - v[i]) if over else (u[i], v[i])
        for k in range(3):
            found[i, k] = points[a, k] + x * (points[b, k] - points[a, k]) + y * (points[c, k] - points[a, k])
            normals[i, k] = across[f, k] / lengths[f]
    return found, normals
