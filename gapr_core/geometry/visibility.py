"""Which points of a cloud are seen from outside, and which way is out.

Two depth buffers, for two kinds of cloud. A bone of one surface has nothing to hide: the first lets a point pass unless
something is clearly before it. A hollow one (a segmentation that follows the cortical bone on both sides) has a second
surface a few millimetres below the first, within what the first lets pass: the second asks whether anything in front
of a point lies above that point's own tangent plane, and the few outer points that this loses are found again next to
those that it keeps.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gapr_core.geometry import quadrics
from gapr_core.geometry.sampling import fibonacci_directions

Array = NDArray[np.float64]
View = Callable[[Array, Array, Array, float], NDArray[np.bool_]]  # direction, points, normals, pixel_mm -> seen

STEEPEST = 2.0  # tangent of the steepest slope that the depth buffer makes room for
FEWEST_VIEWS = 0.05  # share of the views that must see a point of the outer layer: gaps between outer points let some
MOST_PIXELS = 1024  # across a view: points in pairs have next to no spacing, and a buffer that fine has no end
HOLLOW_FROM = 0.15  # share of inner points that makes a bone a hollow one; deep folds of a solid pelvis reach 0.12


def seen_from(direction: Array, points: Array, normals: Array, pixel_mm: float) -> NDArray[np.bool_]:
    """Mask of the (N, 3) points that a depth buffer sees from far along `direction`.

    A point is seen when nothing in the 3 x 3 pixels around it stands higher than its own tangent plane explains.

    Args:
        direction: (3,) unit vector from the body to the viewer.
        points: (N, 3), mm.
        normals: (N, 3), unit; the sign does not matter.
        pixel_mm: edge of a pixel; about 1.5 point spacings closes the surface.
    """
    pixel, shape = _pixels(direction, points, pixel_mm)
    height = points @ direction
    flat = np.full(shape[0] * shape[1], -np.inf)
    np.maximum.at(flat, pixel, height)
    highest = flat.reshape(shape)
    for axis in (0, 1):  # 3 x 3 maximum, one axis after the other
        highest = np.maximum.reduce([highest, np.roll(highest, 1, axis), np.roll(highest, -1, axis)])
    facing = np.abs(normals @ direction)
    slope = np.minimum(np.sqrt(1.0 - np.minimum(facing, 1.0) ** 2) / np.maximum(facing, 1e-9), STEEPEST)
    return height >= highest.ravel()[pixel] - pixel_mm * (0.5 + 1.5 * slope)


def unobstructed_from(direction: Array, points: Array, normals: Array, pixel_mm: float) -> NDArray[np.bool_]:
    """Mask of the (N, 3) points over whose tangent plane nothing stands in the 3 x 3 pixels, as `seen_from` takes them.

    Unlike a difference in height, the distance to the plane is the wall's thickness from wherever a wall is seen.
    """
    pixel, shape = _pixels(direction, points, pixel_mm)
    highest = np.full(shape[0] * shape[1], -1)
    by_height = np.argsort(points @ direction, kind="stable")
    highest[pixel[by_height]] = by_height  # the last one written stays
    slant = normals @ direction
    towards = normals * np.sign(slant)[:, None]
    free = np.abs(slant) > 0.1
    for shift in (i * shape[1] + j for i in (-1, 0, 1) for j in (-1, 0, 1)):
        above = highest[pixel + shift]
        over_mm = np.einsum("ni,ni->n", points[above] - points, towards)
        free &= (above < 0) | (over_mm < 0.5 * pixel_mm)
    return free


def _pixels(direction: Array, points: Array, pixel_mm: float) -> tuple[NDArray[np.int64], tuple[int, int]]:
    """Flat pixel index (N,) of each point in a view along `direction`, with an empty frame around, and the shape."""
    side = np.cross(direction, [1.0, 0.0, 0.0] if abs(direction[0]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    pixel = np.floor(points @ np.stack([side, np.cross(direction, side)], axis=1) / pixel_mm).astype(np.int64)
    pixel -= pixel.min(axis=0) - 1
    rows, columns = (int(n) + 2 for n in pixel.max(axis=0))
    return pixel[:, 0] * columns + pixel[:, 1], (rows, columns)


def outward_votes(
    points: Array, normals: Array, spacing_mm: float, directions: int = 96, seen_from: View = seen_from
) -> tuple[Array, NDArray[np.int64]]:
    """Sum of the directions from which each point is seen, and their number.

    Args:
        points: (N, 3), mm.
        normals: (N, 3), unit; the sign does not matter.
        spacing_mm: typical distance between neighbouring points.
        directions: how many views, evenly spread.
        seen_from: which depth buffer, `seen_from` or `unobstructed_from`.

    Returns:
        (N, 3) sums of unit view directions, which point out of the body, and (N,) counts; a count of zero marks a
        point inside the shell, such as the wall of a medullary canal.
    """
    pixel_mm = max(1.5 * spacing_mm, float(np.linalg.norm(np.ptp(points, axis=0))) / MOST_PIXELS)
    votes, counts = np.zeros_like(points), np.zeros(len(points), dtype=np.int64)
    for direction in fibonacci_directions(directions):
        seen = seen_from(direction, points, normals, pixel_mm)
        votes[seen] += direction
        counts += seen
    return votes, counts


def outer_layer(
    points: Array, normals: Array, spacing_mm: float, directions: int = 96
) -> tuple[NDArray[np.bool_], Array] | None:
    """The outer one of the two surfaces of a hollow bone.

    Args:
        points: (N, 3), mm.
        normals: (N, 3), unit; the sign does not matter.
        spacing_mm: typical distance between neighbouring points.
        directions: how many views, evenly spread.

    Returns:
        (N,) mask and (N, 3) vectors that point out of the body; None for a bone of one surface. A wall thinner than
        the spacing of the points cannot be separated from one surface.
    """
    votes, counts = outward_votes(points, normals, spacing_mm, directions, unobstructed_from)
    outer = counts >= FEWEST_VIEWS * directions
    if outer.sum() < quadrics.FEWEST_NEIGHBOURS:
        return None
    for _ in range(3):
        if outer.mean() > 1.0 - HOLLOW_FROM:  # it only grows
            return None
        _grow(outer, votes, points, spacing_mm)
    return None if outer.mean() > 1.0 - HOLLOW_FROM else (outer, votes)


def _grow(outer: NDArray[np.bool_], outward: Array, points: Array, spacing_mm: float) -> None:
    """Add, in place, the points that lie on the surface elements of those already in the mask."""
    inside = np.flatnonzero(outer)
    tree = cKDTree(points[inside])
    neighbours = tree.query(points[inside], k=quadrics.FEWEST_NEIGHBOURS)[1]
    normals = quadrics.orient(quadrics.local_frames(points[inside], neighbours).normals, outward[inside])
    normals, shapes = quadrics.fit_quadrics(points[inside], normals, neighbours)
    rest = np.flatnonzero(~outer)
    apart, nearest = tree.query(points[rest])
    off = quadrics.heights(points[rest] - points[inside[nearest]], normals[nearest], shapes[nearest])
    on_it = (np.abs(off) < 0.5 * spacing_mm) & (apart < 3.0 * spacing_mm)
    outer[rest[on_it]] = True
    outward[rest[on_it]] = normals[nearest[on_it]]
