"""Hand-made specimens of known form for the tests of this folder."""

from __future__ import annotations

import numpy as np

from gapr_core.data.specimen import Specimen
from gapr_core.surface import Surface


def ball_specimen(radius: float = 60.0, person: str = "p0", bone: str = "ball", stretch: float = 1.0) -> Specimen:
    """A closed ball of triangles, or an ellipsoid `stretch` times as long along z."""
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh.create_sphere(radius, resolution=40)
    points = np.asarray(mesh.vertices) * [1.0, 1.0, stretch] + [300.0, -200.0, 900.0]
    return Specimen(Surface(points, np.asarray(mesh.triangles).astype(np.int64)), bone, person, "hand-made")


def knob_specimen(person: str = "p0", bone: str = "knob") -> Specimen:
    """A big ball with a small one outside it, so that one hides the other from one side."""
    import open3d as o3d

    big = o3d.geometry.TriangleMesh.create_sphere(50.0, resolution=40)
    small = o3d.geometry.TriangleMesh.create_sphere(20.0, resolution=20)
    points = np.vstack([np.asarray(big.vertices), np.asarray(small.vertices) + [100.0, 0.0, 0.0]])
    faces = np.vstack([np.asarray(big.triangles), np.asarray(small.triangles) + len(big.vertices)]).astype(np.int64)
    return Specimen(Surface(points, faces), bone, person, "hand-made")
