"""Shaded pictures of surfaces by ray casting: no display, no graphics driver."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gapr_core.surface import Surface

Array = NDArray[np.float64]
VIEWS = {  # (direction towards the eye, up); x to the subject's left, y backwards, z up
    "anterior": ((0, -1, 0), (0, 0, 1)),
    "posterior": ((0, 1, 0), (0, 0, 1)),
    "left": ((1, 0, 0), (0, 0, 1)),
    "right": ((-1, 0, 0), (0, 0, 1)),
    "superior": ((0, 0, 1), (0, -1, 0)),
    "inferior": ((0, 0, -1), (0, -1, 0)),
}
BONE = np.array([245.0, 232.0, 205.0])


def shade(
    surface: Surface,
    view: str,
    mm_per_pixel: float = 0.7,
    margin_mm: float = 8.0,
    colours: Callable[[Array], Array] | None = None,
) -> NDArray[np.uint8]:
    """Draw an orthographic picture (H, W, 3) of a mesh: light from the eye and from above, white background.

    Args:
        surface: mesh, mm.
        view: a name of `VIEWS`.
        mm_per_pixel: size of a pixel.
        margin_mm: white space around the mesh.
        colours: gives the colours (N, 3), 0 to 255, of points (N, 3) of the surface; beige where it is None.
    """
    import open3d as o3d

    eye, up, right = _frame(view)
    scene = o3d.t.geometry.RaycastingScene()
    vertices = surface.points.astype(np.float32)
    scene.add_triangles(vertices, surface.triangles.astype(np.uint32))
    rays = _rays(surface.points, eye, up, right, mm_per_pixel, margin_mm)
    hit = scene.cast_rays(rays)
    normals = hit["primitive_normals"].numpy()
    normals *= np.sign(np.sum(normals * eye, axis=-1, keepdims=True))
    light = 0.65 * normals @ eye + 0.35 * np.clip(normals @ ((eye + 2.0 * up + right) / np.sqrt(6.0)), 0.0, 1.0)
    depth = hit["t_hit"].numpy()
    shown = np.isfinite(depth)
    base = np.broadcast_to(BONE, rays.shape[:2] + (3,)).copy()
    if colours is not None:
        base[shown] = colours((rays[shown, :3] + depth[shown, None] * rays[shown, 3:]).astype(np.float64))
    depth = np.where(shown, depth, depth[shown].max())
    light *= 1.0 - 0.25 * (depth - depth.min()) / max(float(np.ptp(depth)), 1.0)  # farther is darker
    return np.where(shown[..., None], light[..., None] * base, 255.0).clip(0, 255).astype(np.uint8)


def pixels(
    points: Array, surface: Surface, view: str, mm_per_pixel: float = 0.7, margin_mm: float = 8.0
) -> tuple[Array, NDArray[np.bool_]]:
    """Give the places (N, 2) of points in the picture that `shade` draws, column and row, and whether they are seen."""
    import open3d as o3d

    eye, up, right = _frame(view)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(surface.points.astype(np.float32), surface.triangles.astype(np.uint32))
    places = np.column_stack(
        [points @ right - (surface.points @ right).min(), (surface.points @ up).max() - points @ up]
    )
    starts = points + 2.0 * eye  # above what lies a little inside
    rays = np.concatenate([starts, np.broadcast_to(eye, starts.shape)], axis=1).astype(np.float32)
    return (places + margin_mm) / mm_per_pixel, ~scene.test_occlusions(rays).numpy()


def strip(surface: Surface, views: tuple[str, ...], mm_per_pixel: float = 0.7) -> NDArray[np.uint8]:
    """Draw several views next to each other."""
    pictures = [shade(surface, view, mm_per_pixel) for view in views]
    height = max(len(p) for p in pictures)
    padded = [np.pad(p, ((0, height - len(p)), (0, 0), (0, 0)), constant_values=255) for p in pictures]
    return np.hstack(padded)


def _frame(view: str) -> tuple[Array, Array, Array]:
    eye, up = (np.asarray(v, dtype=np.float64) for v in VIEWS[view])
    return eye, up, np.cross(up, eye)


def _rays(vertices: Array, eye: Array, up: Array, right: Array, pixel: float, margin: float) -> Array:
    across, upward = vertices @ right, vertices @ up
    columns = np.arange(across.min() - margin, across.max() + margin, pixel)
    rows = np.arange(upward.max() + margin, upward.min() - margin, -pixel)
    distance = float((vertices @ eye).max()) + 10.0
    starts = rows[:, None, None] * up + columns[None, :, None] * right + distance * eye
    return np.concatenate([starts, np.broadcast_to(-eye, starts.shape)], axis=-1).astype(np.float32)
