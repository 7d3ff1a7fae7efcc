"""A depth camera: a pinhole that casts rays at surfaces, and the errors of its depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.degradation import bias_along_normals
from gapr_core.surface import Surface

Array = NDArray[np.float64]
PIXELS = 480
FIELD_OF_VIEW_DEG = 60.0
FLATTEST_COSINE = 0.2  # between a ray and the surface's normal; flatter hits give no depth
NOISE_MM = 0.4
NOISE_PER_MM = 1.2e-6  # times the squared distance
SMOOTH_ERROR_MM = 0.4
NOTHING = -1  # part of a point that is on no surface


@dataclass(frozen=True)
class Camera:
    """A pinhole at `position` (3,) mm; rows of `axes` (3, 3) are its right, down and forward directions."""

    position: Array
    axes: Array

    def rays(self) -> Array:
        """(PIXELS^2, 3) unit directions, row by row."""
        edge = np.tan(np.radians(FIELD_OF_VIEW_DEG) / 2.0)
        at = edge * ((np.arange(PIXELS) + 0.5) / PIXELS * 2.0 - 1.0)
        right, down = np.meshgrid(at, at)
        directions = np.stack([right.ravel(), down.ravel(), np.ones(PIXELS**2)], axis=1) @ self.axes
        return directions / np.linalg.norm(directions, axis=1, keepdims=True)


@dataclass(frozen=True)
class View:
    """View of a camera.

    Attributes:
        points: (N, 3) mm, without error where `see` made it.
        part: (N,) which of the surfaces each point is on; `NOTHING` where it is on none.
        camera: (3,) mm.
    """

    points: Array
    part: NDArray[np.int64]
    camera: Array

    def of(self, rows: NDArray[np.integer] | NDArray[np.bool_]) -> View:
        """Only these points."""
        return View(self.points[rows], self.part[rows], self.camera)


def looking_at(point: Array, position: Array, roll: float) -> Camera:
    """Place a camera at `position` that looks at `point`, turned by `roll` radians about its line of sight."""
    forward = (point - position) / np.linalg.norm(point - position)
    start = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    start /= np.linalg.norm(start)
    right = np.cos(roll) * start + np.sin(roll) * np.cross(forward, start)
    return Camera(position, np.stack([right, np.cross(forward, right), forward]))


def upright(point: Array, position: Array, up: Array) -> Camera:
    """Place a camera at `position`, the middle of its image at `point`, with `up` (3,) upward in its image."""
    forward = (point - position) / np.linalg.norm(point - position)
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    return Camera(position, np.stack([right, np.cross(forward, right), forward]))


def see(parts: Sequence[Surface], camera: Camera) -> View:
    """Find the first hit of every pixel's ray on the surfaces; no hit and flat hits give no point."""
    rays = camera.rays()
    hits = _cast(parts, camera.position, rays)
    steep = np.abs((hits["primitive_normals"].numpy() * rays).sum(axis=1)) > FLATTEST_COSINE
    depth = hits["t_hit"].numpy().astype(np.float64)
    seen = np.flatnonzero(np.isfinite(depth) & steep)
    part = hits["geometry_ids"].numpy()[seen].astype(np.int64)
    return View(camera.position + depth[seen, None] * rays[seen], part, camera.position)


def measured(view: View, rng: np.random.Generator) -> Array:
    """Add the depth's errors to points (N, 3), each on its own ray.

    Random: sigma = 0.4 mm + 1.2e-6 / mm d^2; smooth over the image: up to 0.4 mm, waves of 60-120 mm.
    """
    sight = view.points - view.camera
    distance = np.linalg.norm(sight, axis=1, keepdims=True)
    sight /= distance
    random = rng.normal(size=distance.shape) * noise_mm(distance)
    return view.points + random * sight + bias_along_normals(view.points, sight, SMOOTH_ERROR_MM, rng)


def seen_in_depth(view: View, rng: np.random.Generator) -> View:
    """Add the errors of `measured` to a view."""
    return replace(view, points=measured(view, rng))


def noise_mm(distance: Array) -> Array:
    """Standard deviation of the depth, mm, at a distance, mm."""
    return np.asarray(NOISE_MM + NOISE_PER_MM * distance**2)


def _cast(parts: Sequence[Surface], position: Array, rays: Array) -> dict[str, Any]:
    """Open3D's hits; coordinates are relative to the camera, so that float32 is fine enough."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    for part in parts:
        vertices = np.ascontiguousarray(part.points - position, dtype=np.float32)
        scene.add_triangles(vertices, np.ascontiguousarray(part.triangles, dtype=np.uint32))
    from_camera = np.hstack([np.zeros_like(rays), rays]).astype(np.float32)
    return dict(scene.cast_rays(from_camera))
