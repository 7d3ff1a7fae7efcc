"""The label map that a scanner and a perfect segmentation would give of a bone: voxels whose centre is inside."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.surface import Surface

Array = NDArray[np.float64]
MARGIN = 5  # voxels around the bone
IDENTITY = np.eye(3)


def mask_of(
    surface: Surface, spacing_mm: ArrayLike, axes: ArrayLike = IDENTITY, seed: int = 0
) -> tuple[NDArray[np.uint8], Array]:
    """Voxelise a closed mesh on a grid that starts at a random fraction of a voxel.

    Args:
        surface: closed mesh, mm.
        spacing_mm: of a voxel, one number or (3,) along the axes.
        axes: (3, 3), the directions of i, j, k as columns; orthonormal, a reflection or not.
        seed: of the fraction.

    Returns:
        The mask [k, j, i] of 0 and 1, and the affine (4, 4) from (i, j, k) to mm.

    Raises:
        ValueError: a mesh without faces.
    """
    if surface.faces is None:
        raise ValueError("a mask needs a mesh, not a cloud")
    spacing, directions = np.broadcast_to(np.asarray(spacing_mm, dtype=np.float64), 3), np.asarray(axes)
    index = surface.points @ directions / spacing
    low = np.floor(index.min(axis=0)) - MARGIN - np.random.default_rng(seed).random(3)
    size = np.ceil(index.max(axis=0) - low).astype(int) + MARGIN
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = directions * spacing, directions @ (low * spacing)
    return _inside(Surface(index - low, surface.faces), size), affine


def _inside(surface: Surface, size: NDArray[np.int64]) -> NDArray[np.uint8]:
    """[k, j, i]: is (i, j, k) inside? A ray along k through every (i, j) is inside between its odd and even hits."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(surface.to_open3d()))
    j, i = np.indices((size[1], size[0])).reshape(2, -1)
    rays = np.zeros((len(i), 6), dtype=np.float32)
    rays[:, 0], rays[:, 1], rays[:, 2], rays[:, 5] = i, j, -1.0, 1.0
    hits = scene.list_intersections(o3d.core.Tensor(rays))
    ray, height = hits["ray_ids"].numpy().astype(np.int64), hits["t_hit"].numpy() - 1.0
    flips = np.zeros((size[2] + 1, len(i)), dtype=np.int32)
    np.add.at(flips, (np.clip(np.ceil(height), 0, size[2]).astype(int), ray), 1)
    mask = (np.cumsum(flips, axis=0)[:-1] % 2).astype(np.uint8)
    unsure = np.flatnonzero(flips.sum(axis=0) % 2)  # a hit on an edge counts twice
    mask[:, unsure] = _column_by_column(scene, i[unsure], j[unsure], size[2])
    return np.ascontiguousarray(mask.reshape(size[2], size[1], size[0]))


def _column_by_column(scene: Any, i: NDArray[np.int64], j: NDArray[np.int64], height: int) -> NDArray[np.uint8]:
    if len(i) == 0:
        return np.zeros((height, 0), dtype=np.uint8)
    k = np.repeat(np.arange(height)[:, None], len(i), axis=1)
    points = np.stack([np.broadcast_to(i, k.shape), np.broadcast_to(j, k.shape), k], axis=-1).astype(np.float32)
    return np.asarray(scene.compute_occupancy(points).numpy()).astype(np.uint8)
