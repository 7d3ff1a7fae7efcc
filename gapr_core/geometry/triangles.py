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
