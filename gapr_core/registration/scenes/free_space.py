"""Lines of sight: each point of the target is compared with the measured point on its own line of sight.

A pose that puts bone between the camera and a measured point is impossible, whatever else it explains. Bone behind a
measured point may be hidden, and outside the image nothing is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import minimum_filter
from scipy.spatial import cKDTree

from gapr_core.errors import InvalidViewpointError
from gapr_core.geometry import quadrics, se3
from gapr_core.registration.scenes.kernels import compare_with_image
from gapr_core.runtime.parallel import in_pieces

Array = NDArray[np.float64]

SMALLEST_PIXEL, MOST_PIXELS = 0.003, 160_000  # least width, tangent of an angle; pixels grow to stay below the number
REACH = 0.006  # tangent of the angle up to which a point counts for a line of sight
WIDEST_COS = 0.25  # cosine to the middle of the view up to which points are seen
FACING_COS = 0.2  # cosine to the line of sight from which a surface is measured
HIDDEN_MM = 3.0  # bone farther behind the measured point is hidden
SLANT_MM = 9.0  # largest difference in depth to a point in whose plane bone lies
SAME_SURFACE_COS = 0.6  # cosine of normals up to which they are of one surface
VIOLATION_COSTS, MISFIT_COSTS = 2.0, 0.2  # costs of the violating share, and of the share off the surface


@dataclass(frozen=True, eq=False)
class DepthImage:
    """A source as a pinhole image of its camera, which looks at the middle of the cloud."""

    T_camera_source: Array  # (4, 4), mm; the camera looks along its z
    # (rows, columns, 6), mm, camera frame: unit normal (3) of the measured surface towards the camera, its offset
    # n . p, depth z of the measured point (0 where there is none), smallest depth of the 3 x 3 pixels around
    pixels: NDArray[np.float32]
    origin: Array  # (2,) x / z and y / z of the middle of pixel (0, 0)
    pixel: float  # edge of a pixel as a difference of x / z


@dataclass(frozen=True, eq=False)
class Visible:
    """Agreement of poses with an image, as shares of the target's surface."""

    explained: Array  # (K,) share that faces the camera and lies on the measured surface
    violating: Array  # (K,) share that lies clearly in front of the measured surface
    compared: Array  # (K,) share that faces the camera and is visible: neither outside the image nor hidden

    @property
    def score(self) -> Array:
        """(K,) explained share, less the misfitting and, at a higher price, the violating share.

        Large is good: 1 at most, and below 0 where the camera saw more against the pose than for it.
        """
        otherwise = np.maximum(self.compared - self.explained, 0.0)
        return np.asarray(self.explained - MISFIT_COSTS * otherwise - VIOLATION_COSTS * self.violating)


def average(seen: Sequence[Visible]) -> Visible:
    """Average the shares of several images, each of which counts alike."""
    names = ("explained", "violating", "compared")
    explained, violating, compared = (np.mean([getattr(each, name) for each in seen], axis=0) for name in names)
    return Visible(explained, violating, compared)


def see(points: Array, normals: Array, viewpoint: ArrayLike) -> DepthImage:
    """Build the image of points (N, 3), mm, with normals (N, 3) of any sign, from a viewpoint (3,).

    Raises:
        InvalidViewpointError: a viewpoint in the middle of the points, where no camera sees them.
    """
    eye = np.asarray(viewpoint, dtype=np.float64)
    T = _looking_at(eye, points)
    seen = se3.apply(T, points)
    in_view = seen[:, 2] > WIDEST_COS * np.linalg.norm(seen, axis=1)
    if in_view.sum() < min(quadrics.FEWEST_NEIGHBOURS, len(points)):
        raise InvalidViewpointError("a viewpoint outside the cloud", f"{eye}", "pass the camera's place in its frame")
    seen, turned = seen[in_view], normals[in_view] @ T[:3, :3].T
    turned = quadrics.orient(turned, -seen)
    rays = seen[:, :2] / seen[:, 2:]
    nearest, origin, pixel = _nearest_rays(rays)
    return DepthImage(T, _pixels(nearest, seen, turned), origin, pixel)


def _nearest_rays(rays: Array) -> tuple[NDArray[np.int64], Array, float]:
    """Assign the nearest of rays (N, 2), x / z and y / z, to each pixel; N for none.

    Also returns (2,) the middle of the first pixel, and the edge of a pixel: the rays' spacing, within the limits set.
    """
    tree, origin, size = cKDTree(rays), rays.min(axis=0), np.ptp(rays, axis=0)
    pixel = max(SMALLEST_PIXEL, float(np.median(tree.query(rays, k=2)[0][:, 1])))
    pixel = max(pixel, float(np.sqrt(np.prod(size) / MOST_PIXELS)))
    columns, rows = (int(n) for n in np.ceil(size / pixel) + 1)
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    centres = origin + pixel * np.stack([x.ravel(), y.ravel()], axis=1)
    _, nearest = tree.query(centres, distance_upper_bound=max(REACH, 1.5 * pixel))
    return nearest.reshape(rows, columns), origin, pixel


def _looking_at(eye: Array, points: Array) -> Array:
    """Compute T_camera_source of a camera at `eye` that looks at the middle of the points."""
    ahead = points.mean(axis=0) - eye
    length = float(np.linalg.norm(ahead))
    ahead = ahead / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])
    R = np.concatenate([quadrics.tangent_basis(ahead[None])[0], ahead[None]])
    return se3.from_rotation_translation(R, -R @ eye)


def _pixels(nearest: NDArray[np.int64], points: Array, normals: Array) -> NDArray[np.float32]:
    """Fill pixels (rows, columns, 6) from the index of each one's point; the index behind the last one means none."""
    offsets = np.einsum("ni,ni->n", points, normals)
    rows = np.vstack([np.column_stack([normals, offsets, points[:, 2], points[:, 2]]), np.zeros(6)])
    pixels = rows[nearest].astype(np.float32)
    depth = np.where(pixels[..., 4] > 0.0, pixels[..., 4], np.inf)
    pixels[..., 5] = np.where(pixels[..., 4] > 0.0, minimum_filter(depth, size=3), 0.0)
    return pixels


def compare(
    poses: Array,
    points: Array,
    normals: Array,
    image: DepthImage,
    on_mm: float,
    front_mm: float,
    num_threads: int = 0,
) -> Visible:
    """Compare a target under many poses with an image.

    Args:
        poses: (K, 4, 4) T_target_source, mm.
        points: (M, 3) of the target, evenly spread, mm.
        normals: (M, 3) unit, outward.
        image: image of the camera.
        on_mm: distance from the measured surface up to which it explains a point.
        front_mm: distance in front of the measured surface from which bone is impossible.
        num_threads: 0 for all cores.
    """
    inverse = poses[:, :3, :3].transpose(0, 2, 1)
    T = np.tile(np.eye(4), (len(poses), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = inverse, -np.einsum("kij,kj->ki", inverse, poses[:, :3, 3])
    T = (image.T_camera_source @ T)[:, :3].astype(np.float32)
    cloud = np.hstack([points, normals]).astype(np.float32)
    view = image.pixels, np.float32(image.origin[0]), np.float32(image.origin[1]), np.float32(1.0 / image.pixel)

    limits = on_mm, front_mm, FACING_COS, HIDDEN_MM, SLANT_MM, SAME_SURFACE_COS
    limits32 = tuple(map(np.float32, limits))

    def work(piece: NDArray[np.float32]) -> NDArray[np.float32]:
        return compare_with_image(piece, cloud, *view, *limits32)  # type: ignore[no-any-return]

    explained, violating, compared = np.concatenate(in_pieces(work, T, num_threads)).astype(np.float64).T
    return Visible(explained, violating, compared)
