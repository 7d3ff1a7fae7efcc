"""Shaded pictures of bones from the sides of the body: no display, no graphics driver."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gapr_core.geometry.raster import rasterised
from gapr_core.surface import Surface

Array = NDArray[np.float64]
BONE = np.array([245.0, 232.0, 205.0])
AMBIENT = 0.25  # light in the shade
DISC_MM = 1.6  # radius of a point of a cloud without faces


class View(NamedTuple):
    """A side from which a bone is seen: the direction towards the eye, and the one that is up; LPS."""

    eye: tuple[int, int, int]
    up: tuple[int, int, int]

    @property
    def lying(self) -> View:
        """The same, turned by a right angle: up is on the left."""
        x, y, z = np.cross(self.up, self.eye).tolist()
        return View(self.eye, (x, y, z))

    @property
    def axes(self) -> Array:
        """(3, 3) directions to the right, up and towards the eye, as rows."""
        return np.array([np.cross(self.up, self.eye), self.up, self.eye], dtype=np.float64)


VIEWS = {  # x to the subject's left, y backwards, z up
    "anterior": View((0, -1, 0), (0, 0, 1)),
    "posterior": View((0, 1, 0), (0, 0, 1)),
    "left": View((1, 0, 0), (0, 0, 1)),
    "right": View((-1, 0, 0), (0, 0, 1)),
    "superior": View((0, 0, 1), (0, -1, 0)),
    "inferior": View((0, 0, -1), (0, -1, 0)),
}


@dataclass(frozen=True, eq=False)
class Picture:
    """A bone from one side.

    Attributes:
        view: the side.
        light: (H, W) 0 to 1, NaN beside the bone.
        depth_mm: (H, W) height towards the eye of the surface, NaN beside the bone.
        values: (H, W) the vertices' values there; None where none were given.
        extent_mm: left, right, bottom and top of the picture, along the axes of the view.
    """

    view: View
    light: Array
    depth_mm: Array
    values: Array | None
    extent_mm: tuple[float, float, float, float]

    def sees(self, points: Array, tolerance_mm: float = 3.0) -> NDArray[np.bool_]:
        """(N,) which points (N, 3) the bone does not hide."""
        across, up, towards = (points @ self.view.axes.T).T
        left, right, bottom, top = self.extent_mm
        height, width = self.depth_mm.shape
        column = np.clip((across - left) / (right - left) * width, 0, width - 1).astype(int)
        row = np.clip((top - up) / (top - bottom) * height, 0, height - 1).astype(int)
        depth = self.depth_mm[row, column]
        return np.asarray(np.isnan(depth) | (towards > depth - tolerance_mm))


def draw(
    surface: Surface, view: View, mm_per_pixel: float = 0.7, margin_mm: float = 8.0, values: Array | None = None
) -> Picture:
    """Draw an orthographic picture: light from the eye and from above, farther is darker.

    Args:
        surface: mesh or cloud, mm.
        view: the side.
        mm_per_pixel: size of a pixel.
        margin_mm: empty border.
        values: (N,) of its points, to be shown as colours.
    """
    points, faces, normals = _mesh(surface)
    across, up, towards = (points @ view.axes.T).T
    extent = across.min() - margin_mm, across.max() + margin_mm, up.min() - margin_mm, up.max() + margin_mm
    width, height = (max(2, round((extent[k + 1] - extent[k]) / mm_per_pixel)) for k in (0, 2))
    flat = np.stack([across - extent[0], extent[3] - up, towards], axis=1) / mm_per_pixel - [0.5, 0.5, 0.0]
    face, weights = rasterised(flat[faces], height, width)
    shown = face >= 0
    corners, w = faces[face[shown]], weights[shown]
    normal = np.einsum("pk,pkx->px", w, normals[corners]) @ view.axes.T
    normal *= np.sign(normal[:, 2:]) / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    light, depth = np.full(shown.shape, np.nan), np.full(shown.shape, np.nan)
    depth[shown] = np.einsum("pk,pk->p", w, towards[corners])
    fades = 1.0 - 0.25 * (depth[shown].max(initial=0.0) - depth[shown]) / max(float(np.ptp(towards)), 1.0)
    above = np.clip(normal @ (np.array([1.0, 2.0, 1.0]) / np.sqrt(6.0)), 0.0, 1.0)
    light[shown] = np.clip((AMBIENT + 0.5 * normal[:, 2] + 0.35 * above) * fades, 0.0, 1.0)
    if values is None:
        return Picture(view, light, depth, None, extent)
    of_pixel = np.full(shown.shape, np.nan)
    of_vertex = values if len(values) == len(points) else np.repeat(values, len(points) // len(values))
    of_pixel[shown] = np.einsum("pk,pk->p", w, of_vertex[corners])
    return Picture(view, light, depth, of_pixel, extent)


def _mesh(surface: Surface) -> tuple[Array, NDArray[np.int64], Array]:
    """Vertices, faces and normals of vertices; of a cloud a small disc at each point, across its normal."""
    if surface.faces is not None and len(surface.faces):
        points, faces = surface.points, surface.triangles
        across = np.cross(points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]])
        normals = np.zeros_like(points)
        for corner in range(3):
            np.add.at(normals, faces[:, corner], across)
        return points, faces, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    centred = surface.points[cKDTree(surface.points).query(surface.points, k=min(12, len(surface.points)))[1]]
    centred = centred - centred.mean(axis=1, keepdims=True)
    frames = np.linalg.eigh(centred.transpose(0, 2, 1) @ centred)[1]
    turns = np.radians([90.0, 210.0, 330.0])
    rim = (
        2.0
        * DISC_MM
        * (np.cos(turns)[:, None, None] * frames[:, :, 1] + np.sin(turns)[:, None, None] * frames[:, :, 2])
    )
    points = (surface.points[:, None] + rim.transpose(1, 0, 2)).reshape(-1, 3)
    return points, np.arange(len(points)).reshape(-1, 3), np.repeat(frames[:, :, 0], 3, axis=0)
