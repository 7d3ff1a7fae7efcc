"""The sacrum of the pelvis: a curved wedge with wings, a promontory, crests behind and foramina on both faces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from gapr_core.data.solid import Solid, ball, sheet, tube, wheel

Array = NDArray[np.float64]

# Side view (y backwards, z up), S1's upper plate to the tip of the coccyx, for a length of 120 mm
MIDLINE = np.array([[-6.0, 50.0], [11.0, 36.0], [31.0, 22.0], [49.0, 4.0], [60.0, -16.0], [61.0, -36.0], [54.0, -48.0]])
HALF_WIDTH = np.array([0.84, 1.0, 0.88, 0.64, 0.47, 0.33, 0.16])  # of half the sacrum's width
BODY_RADII = np.array([13.0, 14.0, 11.5, 9.0, 7.0, 5.0, 4.0])
WING_RADII = np.array([10.0, 12.0, 10.0, 7.5, 5.5, 4.0, 3.5])


def add_sacrum(
    solid: Solid, width_mm: float, length_mm: float, curvature: float, tilt_deg: float, depth: float
) -> None:
    """Add a sacrum of this width and length; `curvature` 1 and `tilt_deg` 0 are average, `depth` scales the pelvis."""
    middle = _midline(length_mm, curvature, tilt_deg, depth)
    half = (width_mm / 2.0 - 7.0) * HALF_WIDTH
    columns = []
    for x, radii, set_back in (
        (-1.0, WING_RADII, 4.0),
        (-0.5, WING_RADII, 0.0),
        (0.0, BODY_RADII, 0.0),
        (0.5, WING_RADII, 0.0),
        (1.0, WING_RADII, 4.0),
    ):
        row = np.stack([x * half, middle[:, 0] + set_back * abs(x), middle[:, 1]], axis=1)
        columns.append((row, radii * np.interp(half, [0.0, 40.0], [0.85, 1.0])))
    solid.add(sheet(columns, step_mm=3.0), 5.0)
    down, back = _frame(middle)
    _promontory(solid, middle, down, back)
    _crests(solid, middle, back)
    _foramina(solid, middle, half, back)


def _midline(length_mm: float, curvature: float, tilt_deg: float, depth: float) -> Array:
    """Draw the side view as (K, 2) y, z: bent, scaled to the length, tilted about S1."""
    chord = MIDLINE[0] + np.linspace(0.0, 1.0, len(MIDLINE))[:, None] * (MIDLINE[-1] - MIDLINE[0])
    bent = chord + curvature * (MIDLINE - chord) - MIDLINE[0]
    c, s = np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))
    turned = bent @ np.array([[c, -s], [s, c]]).T * length_mm / 120.0
    return turned + MIDLINE[0] * [depth, 1.0]


def _frame(middle: Array) -> tuple[Array, Array]:
    """Unit vectors (K, 3) along the midline downwards and backwards across it."""
    tangent = CubicSpline(np.arange(len(middle)), middle)(np.arange(len(middle)), 1)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    zero = np.zeros(len(middle))
    return (
        np.stack([zero, tangent[:, 0], tangent[:, 1]], axis=1),
        np.stack([zero, -tangent[:, 1], tangent[:, 0]], axis=1),
    )


def _at(middle: Array, index: float) -> Array:
    y, z = CubicSpline(np.arange(len(middle)), middle)(index)
    return np.array([0.0, y, z])


def _promontory(solid: Solid, middle: Array, down: Array, back: Array) -> None:
    centre = _at(middle, 0.1) - 3.0 * back[0]
    for x in (-9.0, 0.0, 9.0):
        solid.add(wheel(centre + [x, 0.0, 0.0], down[0], 16.0, 9.0, 3.0), 8.0)
    for side in (-1.0, 1.0):  # articular processes
        root = centre + 19.0 * back[0] + [17.0 * side, 0.0, 0.0]
        solid.add(tube([root + 10.0 * down[0], root + 2.0 * back[0] - 7.0 * down[0]], [8.0, 6.0]), 7.0)


def _crests(solid: Solid, middle: Array, back: Array) -> None:
    path = []
    for level in range(4):
        spinous = _at(middle, level + 0.6) + (BODY_RADII[level] + 5.0 - 1.5 * level) * back[level]
        solid.add(ball(spinous, 4.5 - 0.4 * level), 5.0)
        path.append(spinous - 3.0 * back[level])
        for side in (-1.0, 1.0):
            lateral = _at(middle, level + 0.6) + (WING_RADII[level] + 1.0) * back[level]
            solid.add(ball(lateral + [side * (27.0 - 5.0 * level), 0.0, 0.0], 3.5), 4.0)
    solid.add(tube(path, [6.0, 6.0, 5.5, 5.0]), 9.0)


def _foramina(solid: Solid, middle: Array, half: Array, back: Array) -> None:
    for level in range(4):
        for side in (-1.0, 1.0):
            x = side * (20.0 - 2.2 * level) * half[0] / 55.0
            centre = _at(middle, level + 1.05) + [x, 0.0, 0.0]
            reach = np.interp(level, [0, 3], [WING_RADII[1], WING_RADII[4]])
            front = centre - (reach - 3.0) * back[level + 1]
            out = front - 14.0 * back[level + 1] + [7.0 * side, 0.0, 0.0]
            solid.cut(tube([front, out], [6.0 - 0.7 * level, 7.5 - 0.7 * level]), 4.0)
            behind = centre + (reach - 1.0) * back[level + 1]
            solid.cut(tube([behind, behind + 12.0 * back[level + 1]], [4.0 - 0.4 * level] * 2), 3.0)
