"""Shaded pictures of surfaces by ray casting: no display, no graphics driver."""

from __future__ import annotations

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


def shade(surface: Surface, view: str, mm_per_pixel: float = 0.7, margin_mm: float = 8.0) -> NDArray[np.uint8]:
    """An orthographic picture (H, W, 3) of a mesh: light from the eye and from above, white background."""
    import open3d as o3d

    eye, up = (np.asarray(v, dtype=np.float64) for v in VIEWS[view])
    right = np.cross(up, eye)
    scene = o3d.t.geometry.RaycastingScene()
    centre = surface.points.mean(axis=0)
    vertices = (surface.points - centre).astype(np.float32)
    scene.add_triangles(vertices, surface.triangles.astype(np.uint32))
    hit = scene.cast_rays(_rays(vertices, eye, up, right, mm_per_pixel, margin_mm))
    normals = hit["primitive_normals"].numpy()
    normals *= np.sign(np.sum(normals * eye, axis=-1, keepdims=True))
    light = 0.65 * normals @ eye + 0.35 * np.clip(normals @ ((eye + 2.0 * up + right) / np.sqrt(6.0)), 0.0, 1.0)
    depth = hit["t_hit"].numpy()
    shown = np.isfinite(depth)
    depth = np.where(shown, depth, depth[shown].max())
    light *= 1.0 - 0.25 * (depth - depth.min()) / max(float(np.ptp(depth)), 1.0)  # farther is darker
    bone_colour = np.array([245.0, 232.0, 205.0])
    return np.where(shown[..., None], light[..., None] * bone_colour, 255.0).clip(0, 255).astype(np.uint8)


def strip(surface: Surface, views: tuple[str, ...], mm_per_pixel: float = 0.7) -> NDArray[np.uint8]:
    """Several views side by side."""
    pictures = [shade(surface, view, mm_per_pixel) for view in views]
    height = max(len(p) for p in pictures)
    padded = [np.pad(p, ((0, height - len(p)), (0, 0), (0, 0)), constant_values=255) for p in pictures]
    return np.hstack(padded)


def _rays(vertices: Array, eye: Array, up: Array, right: Array, pixel: float, margin: float) -> Array:
    across, upward = vertices @ right, vertices @ up
    columns = np.arange(across.min() - margin, across.max() + margin, pixel)
    rows = np.arange(upward.max() + margin, upward.min() - margin, -pixel)
    distance = float((vertices @ eye).max()) + 10.0
    starts = rows[:, None, None] * up + columns[None, :, None] * right + distance * eye
    return np.concatenate([starts, np.broadcast_to(-eye, starts.shape)], axis=-1).astype(np.float32)
