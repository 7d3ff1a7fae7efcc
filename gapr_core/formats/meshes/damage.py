"""What a few damaged bytes leave in a mesh without a checksum: faces that do not fit, vertices that stick out."""

from __future__ import annotations

import numpy as np

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
    edges = np.sort(np.stack([mesh.triangles, np.roll(mesh.triangles, -1, axis=1)], axis=-1), axis=-1)
    keys = edges[..., 0] * len(mesh.points) + edges[..., 1]
    _, number, count = np.unique(keys, return_inverse=True, return_counts=True)
    faces = int(((count != 2)[number].reshape(-1, 3).sum(axis=1) >= 2).sum())
    return faces if (count != 2).sum() <= EDGES * (faces + 1) else 0


def _spikes(mesh: Surface) -> int:
    """Count vertices that are many edges, of the mesh and of those around it, from the middle of their neighbours."""
    total, corners = len(mesh.points), mesh.points[mesh.triangles]
    opposite = np.linalg.norm(np.roll(corners, -1, axis=1) - np.roll(corners, -2, axis=1), axis=2).ravel()
    middles = 0.5 * (np.roll(corners, -1, axis=1) + np.roll(corners, -2, axis=1)).reshape(-1, 3)
    vertex = mesh.triangles.ravel()
    faces = np.maximum(np.bincount(vertex, minlength=total), 1)
    middle = np.stack([np.bincount(vertex, weights, total) / faces for weights in middles.T], axis=1)
    off = np.linalg.norm(mesh.points - middle, axis=1)
    around = np.bincount(vertex, opposite, total) / faces
    return int(((faces > 2) & (off > SPIKE * around) & (off > SPIKE * np.median(opposite))).sum())
