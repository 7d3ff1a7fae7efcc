"""How far the surface of a label lies from the true one: `python benchmarks/contour.py`, half a minute."""

import sys

import numpy as np
import open3d as o3d

from gapr_core.data.masks import mask_of
from gapr_core.data.parametric import make_bone
from gapr_core.data.solid import volume_mm3
from gapr_core.formats.volumes.contour import surface_of


def main():
    """Print the errors at four voxel sizes."""
    bone = make_bone("femur", 3)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(bone.to_open3d()))
    for spacing_mm in (0.5, 1.0, 2.0, 3.0):
        surface = surface_of(*mask_of(bone, spacing_mm))
        points = o3d.core.Tensor(surface.points.astype(np.float32))
        off = scene.compute_signed_distance(points).numpy()
        volume = volume_mm3(surface) / volume_mm3(bone)
        rms, tail = np.sqrt((off**2).mean()), np.percentile(np.abs(off), 95)
        sys.stdout.write(f"{spacing_mm} mm: mean {off.mean():.3f} rms {rms:.3f} 95 % {tail:.3f} volume {volume:.4f}\n")


if __name__ == "__main__":
    main()
