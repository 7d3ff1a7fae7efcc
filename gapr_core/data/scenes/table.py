"""A bone on a table, as in a first trial with a camera; no wound, no tissue."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from gapr_core.data.pair import Pair
from gapr_core.data.scenes import wound as wounds
from gapr_core.data.scenes.scene import SceneLevel, Setting, draw
from gapr_core.data.scenes.things import sheet
from gapr_core.data.scenes.wound import Wound
from gapr_core.data.specimen import Specimen
from gapr_core.surface import Surface

Array = NDArray[np.float64]
ON_A_TABLE = SceneLevel((0.10, 0.60))
HALF_TABLE_MM, STEP_MM = 400.0, 20.0
FARTHEST_OFF_DEG = 25.0  # of the cone of cameras from the upright


def table_scene(specimen: Specimen, rng: np.random.Generator, level: SceneLevel = ON_A_TABLE) -> Pair:
    """Lay a bone on a table, seen from up to 50 degrees off the upright.

    Metadata as in `scene.scene`.

    Raises:
        ConfigError: no view shows that share of bone.
    """
    return draw(specimen, rng, level, partial(_laid_down, specimen))


def _laid_down(specimen: Specimen, rng: np.random.Generator, level: SceneLevel) -> Setting:
    up = resting(specimen.surface.points, rng)
    tilted = _tilted(up, np.radians(FARTHEST_OFF_DEG) * np.sqrt(rng.random()), rng)
    seen = specimen.sample(4000, rng)[0]
    middle = seen[rng.choice(np.flatnonzero(specimen.visible_from(seen, np.tile(tilted, (len(seen), 1)))))]
    view = Wound(middle, wounds.frame(tilted, rng), HALF_TABLE_MM, wounds.lobed(HALF_TABLE_MM, rng))
    points, faces = sheet(np.arange(-HALF_TABLE_MM, HALF_TABLE_MM + 1.0, STEP_MM))
    below_mm = (specimen.surface.points @ up).min() - middle @ up
    table = Surface(middle + below_mm * up + points @ wounds.frame(up, rng), faces)
    return Setting(view, [specimen.surface, table], {"up": up, "middle": middle})


def resting(points: Array, rng: np.random.Generator) -> Array:
    """(3,) unit, which way is up for a body (N, 3) at rest: a face of its convex hull, below its middle, lies down.

    The middle is that of the points, as if they had its mass. At least one face is such a one: that nearest to it.
    """
    hull, middle = ConvexHull(points), points.mean(axis=0)
    inward, offsets = -hull.equations[:, :3], -hull.equations[:, 3]
    foot = middle - (offsets + inward @ middle)[:, None] * inward
    stable = np.flatnonzero(_inside(foot, points[hull.simplices], inward))
    return np.asarray(inward[rng.choice(stable)])


def _inside(points: Array, corners: Array, normals: Array) -> NDArray[np.bool_]:
    """(K,) whether each point (K, 3) of the plane of a triangle (K, 3, 3) lies in it."""
    sides = []
    for i in range(3):
        edge, away = corners[:, (i + 1) % 3] - corners[:, i], points - corners[:, i]
        sides.append(np.einsum("ki,ki->k", np.cross(edge, away), normals))
    lowest, highest = np.min(sides, axis=0), np.max(sides, axis=0)
    slack = 1e-9 * np.abs(sides).max()  # on an edge between two faces it lies in both
    return np.asarray((lowest >= -slack) | (highest <= slack))


def _tilted(up: Array, angle: float, rng: np.random.Generator) -> Array:
    across = wounds.frame(up, rng)[0]
    return np.asarray(np.cos(angle) * up + np.sin(angle) * across)
