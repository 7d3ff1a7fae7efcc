"""What a few damaged bytes leave in a mesh without a checksum: faces that do not fit, vertices that stick out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapr_core.surface import Surface

MOST_ODD = 16  # more is the mesh as it was made, such as faces that share no vertices
EDGES = 6  # odd ones that a damaged face explains: its own, and those that it leaves open
SPIKE = 5.0  # edges between a vertex and the middle of its neighbours: 4.2 at most in 129 bones


def doubt_of(mesh: Surface) -> str:
    """Say in words what looks damaged; empty for most sound meshes, also with holes."""
    said = []
    if 0 < (count := _odd_faces(mesh)) <= MOST_ODD:
        said.append(f"{count} of {len(mesh.triangles)} faces do not fit those around them")
    if count := _spikes(mesh):
        said.append(f"{count} of {len(mesh.points)} vertices stick out far from their neighbours")
    return " and ".join(said)


def _odd_faces(mesh: Surface) -> int:
    """Count faces of which two edges do not have exactly one neighbour; 0 where other faces are odd, too."""
    from scipy.sparse import coo_array

    first, second = mesh.triangles.ravel(), mesh.triangles[:, [1, 2, 0]].ravel()
    ends = np.minimum(first, second), np.maximum(first, second)
    shares = coo_array((np.ones(len(first), dtype=np.int32), ends), shape=2 * (len(mesh.points),)).tocsr()
    odd = int((shares.data != 2).sum())
    if not 0 < odd <= EDGES * (MOST_ODD + 1):
        return 0
    faces = int(((shares[ends] != 2).reshape(-1, 3).sum(axis=1) >= 2).sum())
    return faces if odd <= EDGES * (faces + 1) else 0


def _spikes(mesh: Surface) -> int:
    """Count vertices that are many edges, of the mesh and of those around it, from the middle of their neighbours."""
    total, vertex = len(mesh.points), mesh.triangles.ravel()
    corners = [mesh.points.take(corner, axis=0) for corner in mesh.triangles.T]
    opposite = np.stack([_length(corners[i - 1] - corners[i - 2]) for i in range(3)], axis=1).ravel()
    faces = np.maximum(np.bincount(vertex, minlength=total), 1)
    sums = [sum(np.bincount(corner, along, total) for corner in mesh.triangles.T) for along in sum(corners).T]
    off = _length(1.5 * mesh.points - 0.5 * np.stack(sums, axis=1) / faces[:, None])  # a vertex counts in its faces
    around = np.bincount(vertex, opposite, total) / faces
    return int(((faces > 2) & (off > SPIKE * around) & (off > SPIKE * np.median(opposite))).sum())


def _length(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.sqrt(np.einsum("ni,ni->n", vectors, vectors)))
