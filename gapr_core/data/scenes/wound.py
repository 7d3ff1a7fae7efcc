"""A wound: where it is on the bone and the shape of its opening."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.specimen import Specimen
from gapr_core.errors import ConfigError
from gapr_core.geometry.sampling import random_directions
from gapr_core.surface import Surface

Array = NDArray[np.float64]
Opening = Callable[[Array], NDArray[np.bool_]]  # which points (N, 2) mm of the wound's plane lie in the opening
Shape = Callable[[float, np.random.Generator], Opening]  # of a radius, mm
Allowed = Callable[[Array], NDArray[np.bool_]]  # which of (N, 3) points on a bone may be the middle of a wound
RADIUS_MM = (25.0, 70.0)
TRIES = 50
NORMAL_OVER_MM = 12.0  # the wound's axis is the mean normal of the bone within this distance


@dataclass(frozen=True)
class Wound:
    """An opening above a point of the bone.

    Attributes:
        centre: (3,) mm, on the bone.
        axes: (3, 3) rows: two directions in the wound's plane, and outward.
        radius_mm: of the opening, about.
        opening: its shape.
    """

    centre: Array
    axes: Array
    radius_mm: float
    opening: Opening

    def local(self, points: Array) -> Array:
        """(N, 3) points in the wound's frame: two coordinates in its plane and the height above the bone."""
        return (points - self.centre) @ self.axes.T

    def at(self, local: Array) -> Array:
        """Transform (N, 3) points from the wound's frame to the bone's."""
        return self.centre + local @ self.axes


def everywhere(points: Array) -> NDArray[np.bool_]:
    """(N,) all true: a wound may be anywhere."""
    return np.ones(len(points), dtype=bool)


def somewhere(specimen: Specimen, rng: np.random.Generator, shape: Shape, allowed: Allowed = everywhere) -> Wound:
    """Open a wound above a random point of the bone that is seen along its normal, where it is `allowed`."""
    centre, outward = _open_place(specimen, rng, allowed)
    radius = rng.uniform(*RADIUS_MM)
    return Wound(centre, frame(outward, rng), radius, shape(radius, rng))


def _open_place(specimen: Specimen, rng: np.random.Generator, allowed: Allowed) -> tuple[Array, Array]:
    """Choose a surface point (3,) and its outward normal, with nothing of the bone above it.

    Raises:
        ConfigError: there is none.
    """
    points, normals = specimen.sample(4000, rng)
    for row in np.flatnonzero(allowed(points))[:TRIES]:
        normal = _mean_normal(points, normals, row)
        for outward in (normal, -normal):
            if specimen.visible_from(points[row][None], outward)[0]:
                return points[row], outward
    given = f"{specimen.bone} of {specimen.person}, all hidden"
    raise ConfigError("a surface that can be seen from outside", given, "check that no closed mesh surrounds it")


def _mean_normal(points: Array, normals: Array, row: np.intp) -> Array:
    """Average the normals about a point that look to its own side, as a unit vector (3,)."""
    close = ((points - points[row]) ** 2).sum(axis=1) < NORMAL_OVER_MM**2
    same_side = normals[close & (normals @ normals[row] > 0.0)]
    return np.asarray(same_side.sum(axis=0) / np.linalg.norm(same_side.sum(axis=0)))


def frame(outward: Array, rng: np.random.Generator) -> Array:
    """(3, 3) orthonormal rows, the last one `outward`, the first two turned at random about it."""
    first = np.cross(outward, random_directions(1, rng)[0])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(outward, first), outward])


def lobed(radius: float, rng: np.random.Generator) -> Opening:
    """Make a round hole with lobes: r(a) = radius (1 + sum of c_k cos(k a + phase)), k = 2 to 5."""
    depth, phase, waves = rng.uniform(0.0, 0.12, 4), rng.uniform(0.0, 2.0 * np.pi, 4), np.arange(2, 6)

    def inside(plane: Array) -> NDArray[np.bool_]:
        angle = np.arctan2(plane[:, 1], plane[:, 0])
        edge = 1.0 + np.cos(angle[:, None] * waves + phase) @ depth
        return np.hypot(plane[:, 0], plane[:, 1]) < radius * edge

    return inside


def slit(radius: float, rng: np.random.Generator) -> Opening:
    """Make a cut with round ends, `radius` to either side of its middle and 20-36 mm wide."""
    half = rng.uniform(10.0, 18.0)
    reach = max(radius - half, 0.0)
    return lambda plane: np.hypot(np.maximum(np.abs(plane[:, 0]) - reach, 0.0), plane[:, 1]) < half


def windows(radius: float, rng: np.random.Generator) -> Opening:
    """Make two round holes of .35 to .6 of the radius, with a bridge of 8-16 mm between them."""
    first, second = radius * rng.uniform(0.35, 0.6, 2)
    apart = first + second + rng.uniform(8.0, 16.0)

    def inside(plane: Array) -> NDArray[np.bool_]:
        in_first = np.hypot(plane[:, 0], plane[:, 1]) < first
        return in_first | (np.hypot(plane[:, 0] - apart, plane[:, 1]) < second)

    return inside


def opened(skin: Surface, wound: Wound) -> Surface:
    """Cut the triangles above the bone that lie in the wound's opening out of the skin."""
    middles = wound.local(skin.points[skin.triangles].mean(axis=1))
    hole = (middles[:, 2] > 0.0) & wound.opening(middles[:, :2])
    return Surface(skin.points, skin.triangles[~hole])
