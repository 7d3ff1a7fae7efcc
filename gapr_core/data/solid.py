"""Solids as signed distance on a grid: smooth-blended shapes in, one watertight triangle mesh in mm out.

Shapes are evaluated only in their own box, so that a bone of a million voxels takes about a second. Blends are the
polynomial smooth minimum of Inigo Quilez ("smooth minimum", 2013); the surface is Open3D's flying edges.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter

from gapr_core.surface import Surface

Array = NDArray[np.float64]
Grid = NDArray[np.float32]
Distance = Callable[[Grid, Grid, Grid], Grid]
FAR_MM = 1e3


@dataclass(frozen=True)
class Shape:
    """Signed distance, mm, negative inside, of broadcastable x, y, z; and the box that holds the shape."""

    low: Array
    high: Array
    distance: Distance


class Solid:
    """A grid of signed distances to which shapes are added and from which they are cut."""

    def __init__(self, low: ArrayLike, high: ArrayLike, spacing_mm: float = 2.0) -> None:
        self.low, self.spacing = np.asarray(low, dtype=np.float64), spacing_mm
        self.shape = tuple(int(n) for n in np.ceil((np.asarray(high) - self.low) / spacing_mm) + 1)
        self._values = np.full(self.shape[::-1], FAR_MM, dtype=np.float32)  # [z, y, x], as Open3D reads it

    def add(self, shape: Shape, blend_mm: float = 3.0) -> Solid:
        """Unite with a shape; surfaces nearer than `blend_mm` to each other melt together."""
        block, x, y, z = self._block(shape, blend_mm)
        self._values[block] = _smooth_min(self._values[block], shape.distance(x, y, z), blend_mm)
        return self

    def cut(self, shape: Shape, blend_mm: float = 2.0) -> Solid:
        """Take a shape away, with its rim rounded over `blend_mm`."""
        block, x, y, z = self._block(shape, blend_mm)
        self._values[block] = -_smooth_min(-self._values[block], shape.distance(x, y, z), blend_mm)
        return self

    def surface(self, smoothing_mm: float = 1.5) -> Surface:
        """Mesh the zero level, outward wound: smoothed, its largest component, at the grid's density."""
        import open3d as o3d

        band = np.clip(self._values, -4.0 * self.spacing, 4.0 * self.spacing)
        band = np.pad(gaussian_filter(band, smoothing_mm / self.spacing), 1, constant_values=4.0 * self.spacing)
        mesh = o3d.t.geometry.TriangleMesh.create_isosurfaces(o3d.core.Tensor(band), [0.0]).to_legacy()
        labels, counts, _ = mesh.cluster_connected_triangles()
        mesh.remove_triangles_by_mask(np.asarray(labels) != int(np.argmax(counts)))
        mesh.remove_unreferenced_vertices()
        in_voxels = Surface.from_open3d(mesh)
        surface = Surface(self.low + (in_voxels.points - 1.0) * self.spacing, in_voxels.triangles)
        return surface if volume_mm3(surface) > 0.0 else Surface(surface.points, surface.triangles[:, ::-1].copy())

    def _block(self, shape: Shape, margin: float) -> tuple[tuple[slice, ...], Grid, Grid, Grid]:
        margin += 2.0 * self.spacing
        first = np.floor((shape.low - margin - self.low) / self.spacing).astype(int).clip(0, self.shape)
        last = np.ceil((shape.high + margin - self.low) / self.spacing + 1).astype(int).clip(0, self.shape)
        x, y, z = ((self.low[i] + self.spacing * np.arange(first[i], last[i])).astype(np.float32) for i in range(3))
        block = tuple(slice(first[i], last[i]) for i in (2, 1, 0))
        return block, x[None, None, :], y[None, :, None], z[:, None, None]


def simplify(surface: Surface, faces: int) -> Surface:
    """About `faces` triangles by quadric decimation (Garland and Heckbert 1997); unchanged where that opens it."""
    coarse = Surface.from_open3d(surface.to_open3d().simplify_quadric_decimation(faces))
    return coarse if is_closed(coarse.triangles) else surface


def is_closed(faces: NDArray[np.integer]) -> bool:
    """Check that every edge of the faces (F, 3) belongs to exactly two of them, once in each direction."""
    half_edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    count = int(half_edges.max()) + 1
    forward = np.sort(half_edges[:, 0] * count + half_edges[:, 1])
    backward = np.sort(half_edges[:, 1] * count + half_edges[:, 0])
    return bool((forward == backward).all() and (np.diff(forward) > 0).all())


def volume_mm3(surface: Surface) -> float:
    """Signed volume of a closed mesh by the divergence theorem; positive when the faces are wound outward."""
    a, b, c = (surface.points[surface.triangles[:, i]] - surface.points.mean(axis=0) for i in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def ball(centre: ArrayLike, radius: float) -> Shape:
    """Make a ball of `radius` mm."""
    return tube([centre, centre], [radius, radius])


def ellipsoid(centre: ArrayLike, radii: ArrayLike, axes: ArrayLike | None = None) -> Shape:
    """Make an ellipsoid with semi-axes `radii` along x, y, z or the rows of `axes` (3, 3); first-order distance."""
    c, r = np.asarray(centre, dtype=np.float64), np.asarray(radii, dtype=np.float64)
    frame = np.eye(3) if axes is None else np.asarray(axes, dtype=np.float64)

    def distance(x: Grid, y: Grid, z: Grid) -> Grid:
        local = [_along(x, y, z, c, axis) for axis in frame]
        level = sum((p / r_i) ** 2 for p, r_i in zip(local, r, strict=True)) ** 0.5
        slope = sum((p / r_i**2) ** 2 for p, r_i in zip(local, r, strict=True)) ** 0.5
        return level * (level - 1.0) / np.maximum(slope, 1e-6)

    reach = np.abs(frame.T) @ r
    return Shape(c - reach, c + reach, distance)


def tube(
    points: Sequence[ArrayLike] | Array,
    radii: Sequence[float] | Array,
    flat: ArrayLike | None = None,
    flatness: float = 1.0,
) -> Shape:
    """Make a chain of round cones through `points` (K, 3) with `radii` (K,).

    With `flat` (a unit vector) the section is an ellipse, `flatness` times the radius along that vector.
    """
    path, radius = np.asarray(points, dtype=np.float64), np.asarray(radii, dtype=np.float64)
    direction = np.zeros(3) if flat is None else np.asarray(flat, dtype=np.float64)

    def distance(x: Grid, y: Grid, z: Grid) -> Grid:
        parts = [
            _cone(x, y, z, path[i], path[i + 1], radius[i], radius[i + 1], direction, flatness)
            for i in range(len(path) - 1)
        ]
        return np.minimum.reduce(parts)

    return Shape((path - radius[:, None]).min(axis=0), (path + radius[:, None]).max(axis=0), distance)


def wheel(centre: ArrayLike, axis: ArrayLike, radius: float, half_width: float, edge: float) -> Shape:
    """Make a cylinder about `axis` (unit vector) with rims rounded by `edge` mm: a condyle, a trochlea."""
    c, a = np.asarray(centre, dtype=np.float64), np.asarray(axis, dtype=np.float64)

    def distance(x: Grid, y: Grid, z: Grid) -> Grid:
        along = _along(x, y, z, c, a)
        squared = (x - c[0]) ** 2 + (y - c[1]) ** 2 + (z - c[2]) ** 2
        out = np.sqrt(np.maximum(squared - along**2, 0.0)) - (radius - edge)
        side = np.abs(along) - (half_width - edge)
        outside = np.sqrt(np.maximum(out, 0.0) ** 2 + np.maximum(side, 0.0) ** 2)
        return outside + np.minimum(np.maximum(out, side), 0.0) - edge

    reach = np.sqrt(radius**2 + half_width**2)
    return Shape(c - reach, c + reach, distance)


def loft(z_low: float, z_high: float, reach: float, radius: Callable[[Grid, Grid], Grid]) -> Shape:
    """Make a shaft along z about the origin: `radius(angle, z)` mm, angle = atan2(y, x); flat ends."""

    def distance(x: Grid, y: Grid, z: Grid) -> Grid:
        wall = np.sqrt(x**2 + y**2) - radius(np.arctan2(y, x), z)
        return np.maximum(wall, np.maximum(z_low - z, z - z_high))

    return Shape(np.array([-reach, -reach, z_low]), np.array([reach, reach, z_high]), distance)


def profile(stations: ArrayLike, values: ArrayLike) -> Callable[[Grid], Grid]:
    """Draw a smooth curve through `values` at increasing `stations`, without overshoot (PCHIP), constant beyond the
    ends.
    """
    at = np.asarray(stations, dtype=np.float64)
    curve = PchipInterpolator(at, np.asarray(values, dtype=np.float64))
    return lambda z: np.asarray(curve(np.clip(z, at[0], at[-1])), dtype=np.float32)


def half_space(point: ArrayLike, outward: ArrayLike, reach: float) -> Shape:
    """Everything on the far side of the plane through `point`, seen along `outward`, within `reach` mm; to cut with."""
    c, n = np.asarray(point, dtype=np.float64), np.asarray(outward, dtype=np.float64)
    n = n / np.linalg.norm(n)
    return Shape(c - reach, c + reach, lambda x, y, z: -_along(x, y, z, c, n))


def clipped(shape: Shape, point: ArrayLike, outward: ArrayLike) -> Shape:
    """Cut the shape at the plane through `point`, on the side that `outward` looks to."""
    c, n = np.asarray(point, dtype=np.float64), np.asarray(outward, dtype=np.float64)
    n = n / np.linalg.norm(n)

    def distance(x: Grid, y: Grid, z: Grid) -> Grid:
        return np.maximum(shape.distance(x, y, z), _along(x, y, z, c, n))

    return Shape(shape.low, shape.high, distance)


def sheet(rows: Sequence[tuple[ArrayLike, ArrayLike]], step_mm: float = 2.5) -> Shape:
    """Make a bent plate through rows of control points (K, 3), each with radii (K,)."""
    points, radii = (np.stack([np.asarray(row[i], dtype=np.float64) for row in rows]) for i in (0, 1))
    across = int(np.ceil(np.linalg.norm(np.diff(points, axis=0), axis=2).sum(axis=0).max() / step_mm)) + 1
    along = int(np.ceil(np.linalg.norm(np.diff(points, axis=1), axis=2).sum(axis=1).max() / step_mm)) + 1
    surface = np.concatenate([points, radii[..., None]], axis=2)
    for axis, count in ((0, across), (1, along)):
        knots = np.linspace(0.0, 1.0, surface.shape[axis])
        surface = PchipInterpolator(knots, surface, axis=axis)(np.linspace(0.0, 1.0, count))
    return skeleton(surface[..., :3].reshape(-1, 3), surface[..., 3].ravel())


def skeleton(points: ArrayLike, radii: ArrayLike) -> Shape:
    """Make a solid from samples of its medial sheet or line: `points` (K, 3) dense against `radii` (K,).

    Every place sees the two samples that are nearest to it, so that the surface is no chain of beads.
    """
    centres, radius = np.asarray(points, dtype=np.float64), np.asarray(radii, dtype=np.float64)

    def distance(x: Grid, y: Grid, z: Grid) -> Grid:
        from gapr_core.data.solid_kernels import nearest_samples

        cells = (np.asarray(axis, dtype=np.float64).ravel() for axis in (x, y, z))
        return nearest_samples(*cells, centres, radius, float(radius.max()) + 8.0)  # type: ignore[no-any-return]

    return Shape((centres - radius[:, None]).min(axis=0), (centres + radius[:, None]).max(axis=0), distance)


def _along(x: Grid, y: Grid, z: Grid, origin: Array, axis: Array) -> Grid:
    o, a = origin.astype(np.float32), axis.astype(np.float32)
    return (x - o[0]) * a[0] + (y - o[1]) * a[1] + (z - o[2]) * a[2]


def _cone(x: Grid, y: Grid, z: Grid, a: Array, b: Array, ra: float, rb: float, flat: Array, flatness: float) -> Grid:
    axis = b - a
    squared = max(float(axis @ axis), 1e-9)
    t = np.clip(_along(x, y, z, a, axis / squared), 0.0, 1.0)
    dx, dy, dz = ((g - np.float32(a[i])) - t * np.float32(axis[i]) for i, g in enumerate((x, y, z)))
    apart = dx**2 + dy**2 + dz**2
    if flatness != 1.0:
        apart = apart + (1.0 / flatness**2 - 1.0) * _along(dx, dy, dz, np.zeros(3), flat) ** 2
    return np.asarray(np.sqrt(apart) - (ra + t * np.float32(rb - ra)), dtype=np.float32)


def _smooth_min(first: Grid, second: Grid, blend: float) -> Grid:
    if blend <= 0.0:
        return np.minimum(first, second)
    overlap = np.maximum(blend - np.abs(first - second), 0.0) / blend
    return (np.minimum(first, second) - overlap**2 * blend * 0.25).astype(np.float32)
