"""Exact distances of a few points to a triangle mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def signed_distance_mm(points: Array, vertices: Array, faces: NDArray[np.int64]) -> Array:
    """Measure the distance (K,) of points (K, 3) to a mesh, negative inside.

    Inside, the winding number (Jacobson et al. 2013) is above a half. It needs no watertight mesh, and the faces may
    all be turned inside out.

    Args:
        points: (K, 3) mm.
        vertices: (N, 3) mm.
        faces: (F, 3) indices into the vertices.
    """
    corners = vertices[faces]
    middles = corners.mean(axis=1)
    reach = np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1)
    return np.array([_signed(corners - point, middles - point, reach) for point in points])


def _signed(corners: Array, middles: Array, reach: Array) -> float:
    """Measure the signed distance of the origin to faces (F, 3, 3)."""
    to_middles = np.linalg.norm(middles, axis=1)
    near = to_middles - reach <= (to_middles + reach).min()  # no other face can be the nearest
    distance = _distance(corners[near])
    return -distance if abs(_winding_number(corners)) > 0.5 else distance


def _distance(corners: Array) -> float:
    """Measure the distance of the origin to the nearest of triangles (F, 3, 3): its edges, or its plane."""
    edges = np.roll(corners, -1, axis=1) - corners
    along = -(corners * edges).sum(axis=2) / np.maximum((edges**2).sum(axis=2), 1e-300)
    nearest = np.linalg.norm(corners + np.clip(along, 0.0, 1.0)[..., None] * edges, axis=2).min()
    normals = np.cross(edges[:, 0], edges[:, 1])
    sides = (np.cross(edges, -corners) * normals[:, None]).sum(axis=2)
    inside = (sides > 0.0).all(axis=1)
    heights = np.abs((corners[:, 0] * normals).sum(axis=1))[inside] / np.linalg.norm(normals[inside], axis=1)
    return float(min(nearest, heights.min(initial=np.inf)))


def _winding_number(corners: Array) -> float:
    """Count how often faces (F, 3, 3) go around the origin: their solid angles (van Oosterom 1983) over 4 pi."""
    a, b, c = corners.transpose(1, 0, 2)
    la, lb, lc = np.linalg.norm(corners, axis=2).T
    volume = (a * np.cross(b, c)).sum(axis=1)
    below = la * lb * lc + (a * b).sum(axis=1) * lc + (b * c).sum(axis=1) * la + (c * a).sum(axis=1) * lb
    return float(np.arctan2(volume, below).sum() / (2.0 * np.pi))
