"""Which points of a cloud are seen from outside, and which way is out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapr_core.geometry.sampling import fibonacci_directions

Array = NDArray[np.float64]

STEEPEST = 2.0  # tangent of the steepest slope that the depth buffer makes room for


def seen_from(direction: Array, points: Array, normals: Array, pixel_mm: float) -> NDArray[np.bool_]:
    """Mask of the (N, 3) points that a depth buffer sees from far along `direction`.

    A point is seen when nothing in the 3 x 3 pixels around it stands higher than its own tangent plane explains.

    Args:
        direction: (3,) unit vector from the body to the viewer.
        points: (N, 3), mm.
        normals: (N, 3), unit; the sign does not matter.
        pixel_mm: edge of a pixel; about 1.5 point spacings closes the surface.
    """
    side = np.cross(direction, [1.0, 0.0, 0.0] if abs(direction[0]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    pixel = np.floor(points @ np.stack([side, np.cross(direction, side)], axis=1) / pixel_mm).astype(np.int64)
    pixel -= pixel.min(axis=0) - 1
    height = points @ direction
    shape = pixel.max(axis=0) + 2
    highest = np.full(shape[0] * shape[1], -np.inf)
    np.maximum.at(highest, pixel[:, 0] * shape[1] + pixel[:, 1], height)
    highest = highest.reshape(shape)
    for axis in (0, 1):  # 3 x 3 maximum, one axis after the other
        highest = np.maximum.reduce([highest, np.roll(highest, 1, axis), np.roll(highest, -1, axis)])
    facing = np.abs(normals @ direction)
    slope = np.minimum(np.sqrt(1.0 - np.minimum(facing, 1.0) ** 2) / np.maximum(facing, 1e-9), STEEPEST)
    return height >= highest[pixel[:, 0], pixel[:, 1]] - pixel_mm * (0.5 + 1.5 * slope)


def outward_votes(
    points: Array, normals: Array, spacing_mm: float, directions: int = 96
) -> tuple[Array, NDArray[np.int64]]:
    """Sum of the directions from which each point is seen, and their number.

    Args:
        points: (N, 3), mm.
        normals: (N, 3), unit; the sign does not matter.
        spacing_mm: typical distance between neighbouring points.
        directions: how many views, evenly spread.

    Returns:
        (N, 3) sums of unit view directions, which point out of the body, and (N,) counts; a count of zero marks a
        point inside the shell, such as the wall of a medullary canal.
    """
    votes, counts = np.zeros_like(points), np.zeros(len(points), dtype=np.int64)
    for direction in fibonacci_directions(directions):
        seen = seen_from(direction, points, normals, pixel_mm=1.5 * spacing_mm)
        votes[seen] += direction
        counts += seen
    return votes, counts
