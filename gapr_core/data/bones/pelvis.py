"""A pelvis with its sacrum, joints fused. Frame: x to the subject's left, y back, z up; origin in the bone's middle.

The left hip bone is laid out by landmarks in millimetres (an average adult); parameters move the landmarks, each side
on its own, and the right side is mirrored.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.data.bones.sacrum import add_sacrum
from gapr_core.data.parameters import length, trait
from gapr_core.data.solid import Solid, ball, clipped, ellipsoid, sheet, tube
from gapr_core.surface import Surface

Array = NDArray[np.float64]

# Iliac wing, from the front edge to the back: crest (ASIS, tubercle, top, PSIS), middle, base (AIIS, roof, notch, PIIS)
CREST = [
    [115, -82, 24],
    [128, -66, 38],
    [131, -44, 51],
    [118, -15, 70],
    [95, 8, 79],
    [72, 33, 69],
    [54, 54, 48],
    [45, 66, 25],
]
CREST_RADII = [6.0, 6.0, 8.0, 5.0, 4.5, 6.0, 8.0, 7.5]
MIDDLE = [
    [101, -60, 3],
    [113, -50, 11],
    [117, -32, 18],
    [107, -8, 26],
    [89, 10, 31],
    [70, 27, 32],
    [55, 44, 25],
    [47, 60, 10],
]
MIDDLE_RADII = [5.0, 4.5, 3.5, 3.0, 3.5, 6.5, 9.0, 7.0]
BASE = [
    [87, -64, -23],
    [89, -52, -26],
    [87, -42, -28],
    [80, -27, -24],
    [70, -8, -14],
    [60, 12, -5],
    [53, 30, -2],
    [47, 50, -4],
]
BASE_RADII = [7.5, 10.0, 13.5, 14.5, 11.5, 8.0, 8.5, 7.0]
HIP = [84.0, -38.0, -56.0]
OPENING = [0.72, -0.36, -0.60]  # where the acetabulum looks
COLUMN = [[70, -14, -30], [76, -14, -50], [70, -2, -68], [62, 7, -88], [56, -2, -107], [50, -14, -113]]  # ischium
COLUMN_RADII = [13.0, 16.0, 16.0, 17.0, 15.0, 11.0]
SPINE = [[60, 6, -50], [50, 19, -57]]
SUPERIOR_RAMUS = [[80, -50, -43], [59, -60, -46], [40, -71, -54], [20, -78, -68]]
SUPERIOR_RADII = [15.0, 11.5, 9.0, 10.0]
INFERIOR_RAMUS = [[50, -12, -114], [38, -28, -111], [27, -42, -105], [17, -54, -96]]
INFERIOR_RADII = [11.0, 10.0, 9.5, 10.0]
BODY = [[13, -79, -67], [13, -67, -82], [15, -55, -96]]  # pubis
TUBERCLE = [[22, -84, -65]]


@dataclass(frozen=True)
class PelvisParameters:
    """Measures of a surgeon; ranges hold about 95 % of adults."""

    intercristal_mm: float = length(248.0, 300.0)
    hip_distance_mm: float = length(154.0, 184.0)  # between the centres of the acetabula
    tuberosity_distance_mm: float = length(92.0, 135.0)
    height_mm: float = length(188.0, 228.0)
    depth_mm: float = length(138.0, 172.0)
    acetabulum_diameter_mm: float = length(46.0, 59.0)
    sacrum_width_mm: float = length(98.0, 124.0)
    sacrum_length_mm: float = length(104.0, 134.0)  # along its curve
    iliac_flare_deg: float = trait(-7.0, 7.0)  # against the average wing, about the line between ASIS and PSIS
    wing_thickness: float = trait(0.8, 1.25)
    fossa_depth_mm: float = trait(-2.0, 5.0)
    acetabular_anteversion_deg: float = trait(-8.0, 8.0)  # against the average one
    ramus_thickness: float = trait(0.85, 1.2)
    tuberosity_size: float = trait(0.88, 1.15)
    sacral_curvature: float = trait(0.5, 1.5)
    sacral_tilt_deg: float = trait(-9.0, 9.0)
    asymmetry_mm: float = trait(0.4, 2.2)  # standard deviation of a landmark against its mirror image


def pelvis_surface(p: PelvisParameters, rng: np.random.Generator, spacing_mm: float = 2.3) -> Surface:
    """Mesh one pelvis; `rng` draws how its two sides differ."""
    solid = Solid((-175.0, -115.0, -150.0), (175.0, 105.0, 110.0), spacing_mm)
    for side in (-1.0, 1.0):
        _Hip(p, side, rng).add_to(solid)
    symphysis = _spread(np.array([[0.0, -68.0, -80.0]]), p)[0]
    slanted = np.array([[1.0, 0.0, 0.0], [0.0, 0.77, 0.64], [0.0, -0.64, 0.77]])  # its long axis runs down and back
    solid.add(ellipsoid(symphysis, [9.0, 7.0, 17.0], slanted), 4.0)
    add_sacrum(solid, p.sacrum_width_mm, p.sacrum_length_mm, p.sacral_curvature, p.sacral_tilt_deg, p.depth_mm / 162.0)
    return solid.surface(smoothing_mm=1.3)


def _spread(points: ArrayLike, p: PelvisParameters) -> Array:
    """Landmarks of the average pelvis moved to the subject's widths, height and depth."""
    x, y, z = np.asarray(points, dtype=np.float64).T
    widths = [p.tuberosity_distance_mm / 112.0, p.hip_distance_mm / 168.0, p.intercristal_mm / 278.0]
    wide = np.interp(z, [-112.0, -56.0, 50.0], widths)
    return np.stack([x * wide, y * p.depth_mm / 162.0, z * p.height_mm / 209.0], axis=1)


class _Hip:
    """One hip bone: its landmarks on the subject's own place, on its own side."""

    def __init__(self, p: PelvisParameters, side: float, rng: np.random.Generator) -> None:
        self.p, self.side, self.rng = p, side, rng
        self.hip = self._own([HIP])[0]

    def add_to(self, solid: Solid) -> None:
        """Wing, column, rami, then the acetabulum hollowed out of them."""
        self._wing(solid)
        self._ischium_and_pubis(solid)
        self._acetabulum(solid)

    def _own(self, points: ArrayLike) -> Array:
        moved = _spread(points, self.p) + self.rng.normal(0.0, self.p.asymmetry_mm, np.shape(points))
        return moved * [self.side, 1.0, 1.0]

    def _wing(self, solid: Solid) -> None:
        hinge, axis = np.array(BASE[3], dtype=np.float64), np.array([-0.45, 0.9, 0.0])
        crest, middle = (_turn(rows, hinge, axis, self.p.iliac_flare_deg) for rows in (CREST, MIDDLE))
        out = np.array([0.75, 0.6, -0.2])
        hollow = np.array([0.0, 0.5, 1.0, 1.0, 1.0, 0.5, 0.0, 0.0])[:, None] * self.p.fossa_depth_mm * out
        k = self.p.wing_thickness
        rows = [
            (self._own(crest), k * np.array(CREST_RADII)),
            (self._own(middle + hollow), k * np.array(MIDDLE_RADII)),
            (self._own(BASE), np.array(BASE_RADII)),
        ]
        solid.add(sheet(rows, step_mm=2.5), 6.0)

    def _ischium_and_pubis(self, solid: Solid) -> None:
        k = self.p.ramus_thickness
        flat = np.array([0.75 * self.side, 0.6, 0.0]) / np.hypot(0.75, 0.6)
        size = np.array([1.0, 1.0, 1.0, *[self.p.tuberosity_size] * 3])
        column, below = self._own(COLUMN), self._own(INFERIOR_RAMUS)
        below[0] = column[-1]
        solid.add(tube(column, size * np.array(COLUMN_RADII), flat, 0.8), 8.0)
        solid.add(tube(self._own(SPINE), [9.0, 4.0]), 8.0)
        solid.add(tube(self._own(SUPERIOR_RAMUS), k * np.array(SUPERIOR_RADII)), 8.0)
        solid.add(tube(below, k * np.array(INFERIOR_RADII), flat, 0.75), 6.0)
        solid.add(tube(self._own(BODY), [11.0, 11.5, 10.5], [0.0, 0.77, 0.64], 0.9), 6.0)
        solid.add(ball(self._own(TUBERCLE)[0], 4.5), 5.0)

    def _acetabulum(self, solid: Solid) -> None:
        radius = self.p.acetabulum_diameter_mm / 2.0
        towards = np.array(OPENING) / np.linalg.norm(OPENING)
        towards = _turn([towards], np.zeros(3), np.array([0.0, 0.0, 1.0]), -self.p.acetabular_anteversion_deg)[0]
        towards = towards * [self.side, 1.0, 1.0]
        rim = self.hip + 1.5 * towards
        solid.add(clipped(ball(self.hip, radius + 5.5), rim, towards), 8.0)
        solid.cut(tube([self.hip, self.hip + 45.0 * towards], [radius, radius + 1.0]), 3.0)
        deep = self.hip - (radius - 11.0) * towards
        notch = self.hip + radius * np.array([0.15 * self.side, -0.35, -0.92])
        solid.cut(tube([deep, deep + 0.6 * (notch - deep), notch + 4.0 * towards], [12.5, 12.0, 9.0]), 4.0)


def _turn(points: ArrayLike, about: Array, axis: Array, angle_deg: float) -> Array:
    """Points (N, 3) turned about an axis through a point, Rodrigues' formula."""
    a, offset = axis / np.linalg.norm(axis), np.asarray(points, dtype=np.float64) - about
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return about + c * offset + s * np.cross(a, offset) + (1.0 - c) * (offset @ a)[:, None] * a
