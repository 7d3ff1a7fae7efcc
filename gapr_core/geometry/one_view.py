"""Where a cloud was seen from, judged by its surface alone.

A camera measures no surface at a grazing angle: the direction in which none is grazed leads to it, or away from it.
Two things tell one end from the other. A camera measures nothing behind what it sees, so the end that hides fewer
points is the likelier one. And solid things bulge towards their camera: of a bone on a table, where neither end hides
much, that decides. The direction is good to 12 degrees at the median of simulated scenes; `pinhole` is exact where
pixels are known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gapr_core.geometry import quadrics, visibility
from gapr_core.geometry.sampling import fibonacci_directions

Array = NDArray[np.float64]

DIRECTIONS = 400  # over the sphere: 10 degrees apart
STEEPEST_SHARE = 0.05  # of the points: the normals of so many may be wrong, at edges and in noise
DISTANCE_MM = 450.0  # of a depth camera from what it looks at
CLEAR_OF_CLOUD = 1.5  # radii of the cloud, from its middle: a camera is no nearer
NEAREST_MM = 50.0  # that a camera sees
SMALLEST_PIXEL_MM = 1.0
PIXEL_SPACINGS = 1.5  # typical distances between neighbours: closes the surface
BULGE = 2.0  # how much more a share that bulges counts than one that is visible
LEVEL_MM = 1e-6  # a point no farther off its neighbours is level


@dataclass(frozen=True, eq=False)
class OneView:
    """The places that a cloud may have been seen from.

    Attributes:
        viewpoints: (2, 3) mm, frame of the cloud: before it and behind it, the likelier one first.
        steepest_cos: cosine of incidence that 95 % of the points exceed; a cloud seen from all around has a small one.
    """

    viewpoints: Array
    steepest_cos: float


def seen_from_one_place(
    points: Array, normals: Array, neighbours: NDArray[np.int64], some: NDArray[np.int64], spacing_mm: float
) -> OneView:
    """Find the places from which a cloud was most likely seen, if it was one place.

    Args:
        points: (N, 3), mm.
        normals: (N, 3), unit; the sign does not matter.
        neighbours: (N, k) indices of the nearest points of each.
        some: indices of points that are spread over the cloud: by these the direction is chosen.
        spacing_mm: typical distance between neighbouring points.
    """
    axes = fibonacci_directions(DIRECTIONS)
    axes = axes[axes[:, 2] >= 0.0]  # the sign comes after
    steepest = np.quantile(np.abs(normals[some] @ axes.T), STEEPEST_SHARE, axis=0)
    best = int(steepest.argmax())
    middle = points.mean(axis=0)
    distance_mm = max(DISTANCE_MM, CLEAR_OF_CLOUD * float(np.linalg.norm(points - middle, axis=1).max()))
    ends = middle + distance_mm * np.array([axes[best], -axes[best]])
    likely = [
        visible_share(points, normals, end, spacing_mm) + BULGE * bulging_share(points, normals, neighbours, end)
        for end in ends
    ]
    return OneView(ends[np.argsort(likely)[::-1]], float(steepest[best]))


def seen_from_origin(points: Array, normals: Array, widest_deg: float, least_cos: float) -> bool:
    """Check whether a cloud may be in the optical frame of its camera: z ahead (REP 103), the camera at the origin.

    Everything lies ahead, its middle about the z axis, and nearly nothing is grazed from the origin, as little of a
    camera's image is. By chance all of this holds for about one cloud in a hundred whose frame is another one.

    Args:
        points: (N, 3), mm.
        normals: (N, 3), unit; the sign does not matter.
        widest_deg: largest angle between the z axis and the middle of the points.
        least_cos: cosine of incidence that nearly all points exceed.
    """
    middle, distances_mm = points.mean(axis=0), np.linalg.norm(points, axis=1)
    is_ahead = middle[2] > np.cos(np.radians(widest_deg)) * np.linalg.norm(middle)
    if not is_ahead or points[:, 2].min() < NEAREST_MM:
        return False
    incidence = np.abs(np.einsum("ni,ni->n", points, normals)) / distances_mm
    return bool(np.quantile(incidence, STEEPEST_SHARE) >= least_cos)


def visible_share(points: Array, normals: Array, viewpoint: Array, spacing_mm: float) -> float:
    """Share of the points (N, 3), mm, that a camera at `viewpoint` (3,), outside of them, sees; 0 to 1."""
    straight, upright = with_parallel_sight(points, normals, viewpoint)
    pixel_mm = max(SMALLEST_PIXEL_MM, PIXEL_SPACINGS * spacing_mm)
    return float(visibility.seen_from(np.array([0.0, 0.0, 1.0]), straight, upright, pixel_mm).mean())


def bulging_share(points: Array, normals: Array, neighbours: NDArray[np.int64], viewpoint: Array) -> float:
    """Share of the points that bulge towards a viewpoint less the share that is hollow there; -1 to 1.

    Args:
        points: (N, 3), mm.
        normals: (N, 3), unit; the sign does not matter.
        neighbours: (N, k) indices of the nearest points of each.
        viewpoint: (3,), mm.
    """
    above = np.einsum("ni,ni->n", points - points[neighbours].mean(axis=1), normals)  # the middle of the neighbours
    above *= np.sign(np.einsum("ni,ni->n", viewpoint - points, normals))
    return float((above > LEVEL_MM).mean() - (above < -LEVEL_MM).mean())


def with_parallel_sight(points: Array, normals: Array, viewpoint: Array) -> tuple[Array, Array]:
    """Map points and normals so that the camera is infinitely far up the z axis.

    All lines of sight become parallel to z, and what is nearer to the camera is higher: (x, y, z) goes to
    (d x, d y, d^2) / z, with d the depth of the middle, in a frame of the camera that looks there. Planes stay planes:
    it is the perspective transformation of computer graphics (Foley et al. 1996, section 6.5).

    Args:
        points: (N, 3), mm, all before the camera.
        normals: (N, 3), unit.
        viewpoint: (3,), mm.

    Returns:
        (N, 3) mm and (N, 3) unit; near the middle lengths stay what they were.
    """
    ahead = points.mean(axis=0) - viewpoint
    d = float(np.linalg.norm(ahead))
    R = np.vstack([quadrics.tangent_basis(ahead[None] / d)[0], ahead[None] / d])
    seen, turned = (points - viewpoint) @ R.T, normals @ R.T
    x, y, z = seen.T
    straight = np.stack([d * x, d * y, np.full_like(z, d * d)], axis=1) / z[:, None]
    offset = np.einsum("ni,ni->n", seen, turned)  # of each tangent plane: n_x x + n_y y + n_z z = offset
    upright = np.stack([-d * turned[:, 0], -d * turned[:, 1], offset], axis=1)
    size = np.linalg.norm(upright, axis=1, keepdims=True)
    return straight, np.divide(upright, size, out=np.tile([0.0, 0.0, 1.0], (len(size), 1)), where=size > 0.0)
