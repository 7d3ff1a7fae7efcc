"""The faces of the bone that a sensor can see, for exact distances of points to them, by libigl."""

from __future__ import annotations

import weakref
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

NEIGHBOURS = 12  # surface elements compared with a face
ALIKE = 0.5  # cosine of normals, whatever their signs: a flatter angle is another side of an edge
ONE_WAY = 0.5  # mean of the sides, 1 or -1, above which the faces are wound one way, as those of most meshes
ON_BORDER = 1e-6  # barycentric coordinate: the nearest point lies on an edge or a corner


@dataclass(frozen=True, eq=False)
class BoneMesh:
    """Triangles with outward normals."""

    vertices: Array  # (N, 3) mm
    faces: Faces  # (F, 3) indices into the vertices
    normals: Array  # (F, 3) unit, outward
    at_vertices: Array  # (N, 3) sums of the normals around, by area
    tree: Any  # libigl's tree over the faces

    def distances(self, points: Array) -> tuple[Array, Array]:
        """Measure signed distances (K,) of points (K, 3), mm, positive outside, and their gradients (K, 3)."""
        import igl

        squared, face, nearest = self.tree.squared_distance(self.vertices, self.faces, np.ascontiguousarray(points))
        corners = (np.ascontiguousarray(self.vertices[self.faces[face, i]]) for i in range(3))
        weights = igl.barycentric_coordinates(nearest, *corners)
        smooth = np.einsum("ki,kij->kj", weights, self.at_vertices[self.faces[face]])
        outward = np.where((weights < ON_BORDER).any(axis=1)[:, None], smooth, self.normals[face])
        away, size = points - nearest, np.sqrt(squared)
        side = np.where(np.einsum("ki,ki->k", away, outward) < 0.0, -1.0, 1.0)
        off = size > 1e-9
        gradients = self.normals[face]
        gradients[off] = (side[:, None] * away)[off] / size[off, None]
        return side * size, gradients


def build(vertices: Array, faces: Faces, kept: tuple[Array, Array], dropped: Array) -> BoneMesh:
    """Build the mesh of the faces on which the surface elements lie.

    Args:
        vertices, faces: vertices and faces of the whole mesh.
        kept: (M, 3) points of the surface elements, and their outward normals (M, 3).
        dropped: (D, 6) points and normals of omitted surfaces: inner ones and flat ends.
    """
    import igl

    corners = vertices[faces]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(crosses, axis=1)
    corners, faces, crosses, size = (each[size > 0.0] for each in (corners, faces, crosses, size))
    normals = crosses / size[:, None]
    points, directions = np.vstack([kept[0], dropped[:, :3]]), np.vstack([kept[1], dropped[:, 3:]])
    middles = corners.mean(axis=1)
    around = cKDTree(points).query(middles, k=min(NEIGHBOURS, len(points)))[1].reshape(len(middles), -1)
    heights = np.abs(np.einsum("fki,fki->fk", middles[:, None] - points[around], directions[around]))
    cosines = np.einsum("fi,fki->fk", normals, directions[around])
    heights[np.abs(cosines) < ALIKE] = np.inf
    best = heights.argmin(axis=1)
    own, cosine = around[np.arange(len(best)), best], cosines[np.arange(len(best)), best]
    is_kept = (own < len(kept[0])) | ~np.isfinite(heights.min(axis=1))
    sides = np.where(cosine < 0.0, -1.0, 1.0)
    turned = np.average(sides, weights=size)
    sides = np.full(len(sides), np.sign(turned)) if abs(turned) > ONE_WAY else sides  # else of facets in any order
    outward = (normals * sides[:, None])[is_kept]
    used = np.ascontiguousarray(faces[is_kept])
    at_vertices = np.zeros_like(vertices)
    for corner in used.T:
        np.add.at(at_vertices, corner, outward * size[is_kept, None])
    tree = igl.AABB()
    tree.init(vertices, used)
    mesh = BoneMesh(vertices, used, outward, at_vertices, tree)
    weakref.finalize(mesh, mesh.__dict__.clear)  # a tree that is left when Python ends prints a complaint
    return mesh
