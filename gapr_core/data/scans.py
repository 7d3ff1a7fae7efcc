"""A bone's surface as other scanners, other segmentations or other subjects would give it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from gapr_core.surface import Surface

Scan = Callable[[Surface], Surface]

VOXELS_AT_ONCE = 1 << 20


def of_size(factor: float) -> Scan:
    """Scale the surface to a smaller or a larger subject."""
    return lambda surface: Surface(surface.points * factor, surface.faces)


def of_voxels(*size_mm: float) -> Scan:
    """Mesh the voxels (x, y, z) whose centres are inside, terraces and all (marching cubes of the mask)."""
    import open3d as o3d

    size = np.array(size_mm)

    def scan(mesh: Any) -> Any:
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
        low, high = mesh.get_min_bound() - 1.5 * size, mesh.get_max_bound() + 1.5 * size
        shape = np.ceil((high - low) / size).astype(int)[::-1]
        centres = low + np.indices(shape).reshape(3, -1).T[:, ::-1] * size
        parts = np.array_split(centres.astype(np.float32), len(centres) // VOXELS_AT_ONCE + 1)
        mask = np.concatenate([scene.compute_occupancy(part).numpy() for part in parts]).reshape(shape)
        made = o3d.t.geometry.TriangleMesh.create_isosurfaces(o3d.core.Tensor(mask.astype(np.float32)), [0.5])
        terraces = made.to_legacy()
        terraces.vertices = o3d.utility.Vector3dVector(low + np.asarray(terraces.vertices) * size)
        return terraces

    return _of_mesh(scan)


def of_triangles(count: int) -> Scan:
    """Reduce the surface to so many triangles (quadric decimation)."""
    return _of_mesh(lambda mesh: mesh.simplify_quadric_decimation(count))


def smoothed(rounds: int) -> Scan:
    """Smooth the surface by rounds of Laplace, which shrinks thin parts."""
    return _of_mesh(lambda mesh: mesh.filter_smooth_laplacian(rounds))


def drawn(rng: np.random.Generator) -> Scan:
    """Draw one of the others at random: voxels of 1 to 3 mm within and between slices, or few triangles."""
    if rng.random() < 0.3:
        return of_triangles(int(rng.integers(800, 4000)))
    within, slices = rng.uniform(1.0, 3.0, 2)
    return of_voxels(within, within, slices)


def _of_mesh(change: Callable[[Any], Any]) -> Scan:
    """Apply a change of an `open3d.geometry.TriangleMesh` to a surface."""
    return lambda surface: Surface.from_open3d(change(surface.to_open3d()))
