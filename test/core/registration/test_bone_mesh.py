"""Distances to the mesh itself, against Open3D and by construction."""

import numpy as np
import pytest

from gapr_core.config import SensorConfig, TargetConfig
from gapr_core.registration.problem import target as targets
from gapr_core.registration.problem.sensor import offset_surface
from gapr_core.surface import Surface


def block(low, high):
    """(8, 3) corners and (12, 3) faces of a box, wound outward."""
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return corners.astype(float), np.array([[q[0], q[i], q[i + 1]] for q in quads for i in (1, 2)])


def plate():
    """A plate of 2 mm with a foot, in a few large triangles."""
    (a, f), (b, g) = block([0, 0, 0], [120, 80, 2]), block([0, 0, 2], [15, 12, 40])
    return Surface(np.vstack([a, b]), np.vstack([f, g + 8]))


@pytest.mark.parametrize("turned", [False, True])
def test_a_point_is_as_far_as_the_mesh_is_on_the_right_side(turned):
    mesh = plate()
    faces = mesh.triangles[:, ::-1] if turned else mesh.triangles
    target = targets.prepare(Surface(mesh.points, faces), config=TargetConfig(flat_end_mm2=0.0))
    points = np.array([[60, 40, 3.5], [60, 40, 1.8], [60, 40, -1.0], [60, 40, 0.3], [123, 84, 1.0], [-2, 5, 20.0]])
    distances, gradients = target.mesh_distances(points)
    np.testing.assert_allclose(distances, [1.5, -0.2, 1.0, -0.3, 5.0, 2.0], atol=1e-9)
    np.testing.assert_allclose(gradients[[0, 2, 4]], [[0, 0, 1], [0, 0, -1], [0.6, 0.8, 0]], atol=1e-9)


def test_distances_are_those_of_open3d(femur):
    o3d = pytest.importorskip("open3d", reason="reference: pip install open3d")
    target, rng = targets.prepare(femur), np.random.default_rng(0)
    on, normals = femur.sample(2000, rng)
    points = on + normals * rng.normal(0.0, 1.5, (2000, 1))
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(femur.points.astype(np.float32), femur.triangles.astype(np.uint32))
    reference = scene.compute_signed_distance(points.astype(np.float32)).numpy()
    np.testing.assert_allclose(target.mesh_distances(points)[0], reference, atol=0.01)
    np.testing.assert_allclose(target.mesh_distances(on)[0], 0.0, atol=1e-9)


def test_the_stand_off_is_taken_off_and_far_points_have_no_distance(femur):
    target = targets.prepare(femur)
    on = femur.sample(50, np.random.default_rng(0))[0]
    seen = offset_surface(target, SensorConfig(kind="pointer", standoff_mm=0.7))
    np.testing.assert_allclose(seen.mesh_distances(on)[0], -0.7, atol=1e-9)
    assert np.isnan(target.mesh_distances(on + 500.0)[0]).all()


def test_a_cloud_has_no_mesh(femur):
    assert targets.prepare(femur.points).mesh_distances(femur.points) is None


def test_the_inner_cortex_of_a_hollow_bone_is_not_its_surface(femur):
    corners = femur.points[femur.triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(femur.points)
    for corner in femur.triangles.T:
        np.add.at(normals, corner, across)
    inner = femur.points - 4.0 * normals / np.linalg.norm(normals, axis=1, keepdims=True)
    faces = np.vstack([femur.triangles, femur.triangles[:, ::-1] + len(femur.points)])
    target = targets.prepare(Surface(np.vstack([femur.points, inner]), faces))
    assert target.both_cortices is not None
    found = target.mesh_distances(inner)[0]
    assert np.mean(found < -2.0) > 0.95 and np.median(found) == pytest.approx(-4.0, abs=0.1)
