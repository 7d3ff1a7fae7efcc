"""Things around a wound that are no bone: retractors, a hand, a drape."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gapr_core.data.scenes.wound import Wound
from gapr_core.data.solid import Solid, ellipsoid, tube
from gapr_core.surface import Surface

Array = NDArray[np.float64]
BOX_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
     [1, 5, 7], [1, 7, 3]]
)  # fmt: skip
CLOTH_MM, CLOTH_STEP_MM = 500.0, 8.0
HAND_MM = 125.0  # from the palm's middle to the finger tips


def retractor(wound: Wound, height_mm: float, rng: np.random.Generator) -> Surface:
    """Place a blade of 8-20 x 60-140 x 3 mm at the wound's edge, `height_mm` above the bone."""
    size = np.array([rng.uniform(8.0, 20.0), rng.uniform(60.0, 140.0), 3.0])
    turn = Rotation.from_euler("zx", [rng.uniform(0.0, 2.0 * np.pi), np.radians(rng.uniform(10.0, 60.0))])
    corners = (np.indices((2, 2, 2)).reshape(3, 8).T - [0.5, 0.0, 0.5]) * size  # its near end at the origin, along y
    start = turn.apply([0.0, wound.radius_mm, 0.0]) * [1.0, 1.0, 0.0] + [0.0, 0.0, height_mm]
    return Surface(wound.at(turn.apply(corners) + start), BOX_FACES)


def hand(wound: Wound, height_mm: float, rng: np.random.Generator) -> Surface:
    """Place a hand over the wound's edge, 10-30 mm above the skin, the wrist higher."""
    model = _hand()
    tips = rng.uniform(0.5, 1.0) * wound.radius_mm
    lying = model.points * [rng.choice([-1.0, 1.0]), -1.0, 1.0] + [0.0, HAND_MM, 0.0]  # a left or a right one
    tilted = Rotation.from_euler("x", rng.uniform(5.0, 30.0), degrees=True).apply(lying) + [0.0, tips, 0.0]
    around = Rotation.from_euler("z", rng.uniform(0.0, 360.0), degrees=True).apply(tilted)
    above = [0.0, 0.0, height_mm + rng.uniform(10.0, 30.0)]
    return Surface(wound.at(around + above), model.triangles)


def drape(wound: Wound, height_mm: float, rng: np.random.Generator) -> Surface:
    """Lay a cloth with a round hole over the wound, 5-25 mm above the skin, tilted and waved."""
    at = np.arange(-CLOTH_MM / 2.0, CLOTH_MM / 2.0 + 1.0, CLOTH_STEP_MM)
    points, faces = sheet(at)
    points[:, 2] = 3.0 * np.sin(points[:, :2] @ rng.normal(0.0, 0.03, 2) + rng.uniform(0.0, 2.0 * np.pi))
    middles = points[faces].mean(axis=1)
    faces = faces[np.hypot(middles[:, 0], middles[:, 1]) > rng.uniform(0.9, 1.5) * wound.radius_mm]
    tilted = Rotation.from_euler("xy", rng.uniform(-7.0, 7.0, 2), degrees=True).apply(points)
    return Surface(wound.at(tilted + [0.0, 0.0, height_mm + rng.uniform(5.0, 25.0)]), faces)


def sheet(at: Array) -> tuple[Array, NDArray[np.int64]]:
    """Make a flat square of triangles with corners at all pairs of `at` (K,)."""
    x, y = np.meshgrid(at, at)
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    corner = (np.arange(len(at) - 1)[:, None] * len(at) + np.arange(len(at) - 1)).ravel()
    right, up = corner + 1, corner + len(at)
    return points, np.vstack([np.stack([corner, right, up], axis=1), np.stack([right, up + 1, up], axis=1)])


@lru_cache(maxsize=1)
def _hand() -> Surface:
    """Make a flat hand, mm: palm about the origin, fingers along y, wrist at -y, back of the hand at +z."""
    solid = Solid([-90.0, -140.0, -40.0], [70.0, 140.0, 40.0], spacing_mm=3.0)
    solid.add(ellipsoid([0.0, 0.0, 0.0], [42.0, 52.0, 15.0]))
    for x, length in ((-30.0, 102.0), (-10.0, 117.0), (10.0, 112.0), (30.0, 92.0)):
        solid.add(tube([[x, 30.0, 2.0], [1.1 * x, 75.0, 4.0], [1.15 * x, length, -6.0]], [10.0, 9.0, 8.0]), 6.0)
    solid.add(tube([[-30.0, -20.0, 0.0], [-60.0, 15.0, -8.0], [-66.0, 45.0, -12.0]], [13.0, 11.0, 9.0]), 8.0)
    solid.add(tube([[0.0, -30.0, 0.0], [0.0, -120.0, 0.0]], [27.0, 30.0], [0.0, 0.0, 1.0], 0.7), 10.0)
    return solid.surface()
