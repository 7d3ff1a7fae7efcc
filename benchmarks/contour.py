"""How far the surface of a label lies from the true one: `python benchmarks/contour.py`, half a minute."""

import sys

import numpy as np
import open3d as o3d

from gapr_core.data.parametric import make_bone
from gapr_core.data.solid import volume_mm3
from gapr_core.formats.volumes.contour import surface_of


def main():
    """Print the errors at three voxel sizes."""
    bone = make_bone("femur", 3)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(bone.to_open3d()))
    for spacing_mm in (1.0, 2.0, 3.0):
        mask, affine = _voxels(bone, scene, spacing_mm)
        surface = surface_of(mask, affine)
        points = o3d.core.Tensor(surface.points.astype(np.float32))
        off = scene.compute_signed_distance(points).numpy()
        volume = volume_mm3(surface) / volume_mm3(bone)
        rms, tail = np.sqrt((off**2).mean()), np.percentile(np.abs(off), 95)
        sys.stdout.write(f"{spacing_mm} mm: mean {off.mean():.3f} rms {rms:.3f} 95 % {tail:.3f} volume {volume:.4f}\n")


def _voxels(bone, scene, spacing_mm):
    """The mask [k, j, i] of the bone, and the affine of its indices, which start at a random fraction of a voxel."""
    low = bone.points.min(axis=0) - spacing_mm * (5.0 + np.random.default_rng(0).random(3))
    size = np.ceil((bone.points.max(axis=0) + 5.0 * spacing_mm - low) / spacing_mm).astype(int)
    index = np.stack(np.meshgrid(*map(np.arange, size), indexing="ij"), axis=-1)
    points = np.ascontiguousarray((low + spacing_mm * index).astype(np.float32))
    inside = scene.compute_signed_distance(o3d.core.Tensor(points)).numpy() < 0.0
    affine = np.diag([spacing_mm, spacing_mm, spacing_mm, 1.0])
    affine[:3, 3] = low
    return inside.transpose(2, 1, 0).astype(np.uint8), affine


if __name__ == "__main__":
    main()
