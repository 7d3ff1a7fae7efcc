"""The soft tissue around a bone: the bone grown by a thickness, as a smooth closed skin."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes, distance_transform_edt, gaussian_filter

from gapr_core.data.scenes.wound import Wound
from gapr_core.data.specimen import Specimen
from gapr_core.surface import Surface

VOXEL_MM = 3.0
SMOOTHING_MM = 6.0
WALL_SMOOTHING_MM = 2.5
GROWTH_MM = (12, 35)  # thinnest and thickest tissue
SAMPLES = 200_000  # surface points that mark the bone's voxels


class Nearness(NamedTuple):
    """Distance to a bone's surface, mm, on voxels [z, y, x] from `low` (3,)."""

    values: NDArray[np.float32]
    low: NDArray[np.float64]


@lru_cache(maxsize=64)
def skin(specimen: Specimen, growth_mm: int) -> Surface:
    """Grow the skin `growth_mm` off the bone, in the bone's frame; kept for the next scene of this bone."""
    return _zero_level(_tissue(specimen, growth_mm), _nearness(specimen).low)


def carved(specimen: Specimen, growth_mm: int, wound: Wound, floor_mm: float) -> Surface:
    """Carve a wound into the skin, with walls and a floor of tissue `floor_mm` below the wound's centre."""
    field, low = _tissue(specimen, growth_mm), _nearness(specimen).low
    z, y, x = np.indices(field.shape)
    local = wound.local(low + VOXEL_MM * np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1))
    air = (local[:, 2] > -floor_mm) & wound.opening(local[:, :2])
    with_hole = np.where(air.reshape(field.shape), VOXEL_MM, field.clip(-VOXEL_MM, VOXEL_MM))
    return _zero_level(gaussian_filter(with_hole, WALL_SMOOTHING_MM / VOXEL_MM), low)


@lru_cache(maxsize=32)
def _tissue(specimen: Specimen, growth_mm: int) -> NDArray[np.float32]:
    """Distance to the skin on the voxels of `_nearness`, mm, negative inside, smoothed."""
    near = _nearness(specimen)
    tissue = near.values < growth_mm
    hollow = binary_fill_holes(tissue) & ~tissue  # the middle of a thick bone
    field = np.where(hollow, -growth_mm, near.values - growth_mm).clip(-growth_mm, growth_mm)
    return np.asarray(gaussian_filter(field, SMOOTHING_MM / VOXEL_MM), dtype=np.float32)


@lru_cache(maxsize=32)
def _nearness(specimen: Specimen) -> Nearness:
    points, _ = specimen.sample(SAMPLES, np.random.default_rng(0))
    margin = GROWTH_MM[1] + 4.0 * SMOOTHING_MM
    low = points.min(axis=0) - margin
    shape = np.ceil((points.max(axis=0) + margin - low) / VOXEL_MM).astype(int) + 1
    empty = np.ones(shape[::-1], dtype=bool)
    x, y, z = np.rint((points - low) / VOXEL_MM).astype(int).T
    empty[z, y, x] = False
    return Nearness((distance_transform_edt(empty) * VOXEL_MM).astype(np.float32), low)


def _zero_level(field: NDArray[np.float32], low: NDArray[np.float64]) -> Surface:
    import open3d as o3d

    values = o3d.core.Tensor(np.ascontiguousarray(field, dtype=np.float32))
    skin = Surface.from_open3d(o3d.t.geometry.TriangleMesh.create_isosurfaces(values, [0.0]).to_legacy())
    return Surface(low + skin.points * VOXEL_MM, skin.triangles)
