"""Thoracic cartilage: sternum and costal cartilages 1-10. Frame: x left, y backwards, z up; the jugular notch on top.

Cartilages lie on the chest wall, an elliptic cylinder behind the sternum. They lead from the sternum to the bony rib.
Numbers 8 to 10 end on the one above and make the costal arch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from gapr_core.data.parameters import length, trait
from gapr_core.data.solid import Shape, Solid, ball, sheet, tube
from gapr_core.surface import Surface

Array = NDArray[np.float64]

# Costal cartilages from the sternum outward as x, z of an average adult; the first point of 8-10 is on the one above
PATHS = {
    1: [[18, -16], [32, -15], [46, -11]],
    2: [[13, -49], [38, -48], [62, -43]],
    3: [[14, -72], [45, -74], [74, -75]],
    4: [[15, -92], [48, -101], [84, -108]],
    5: [[16, -111], [36, -126], [62, -138], [93, -134]],
    6: [[15, -128], [32, -148], [62, -168], [100, -160]],
    7: [[11, -144], [28, -168], [56, -194], [86, -205], [116, -190]],
    8: [[0, 0], [70, -222], [98, -232], [128, -216]],
    9: [[0, 0], [100, -250], [117, -257], [138, -244]],
    10: [[0, 0], [124, -274], [143, -271]],
}
JOINS = {8: 0.42, 9: 0.5, 10: 0.6}  # where along the cartilage above
HEIGHT = {1: 8.0, 2: 7.0, 3: 6.5, 4: 6.5, 5: 7.0, 6: 7.5, 7: 8.0, 8: 7.0, 9: 6.0, 10: 5.0}  # half of it


@dataclass(frozen=True)
class ThoracicParameters:
    """Measures on a CT; ranges hold about 95 % of adults."""

    manubrium_length_mm: float = length(42.0, 56.0)
    body_length_mm: float = length(84.0, 118.0)
    xiphoid_length_mm: float = trait(18.0, 42.0)
    manubrium_width_mm: float = length(50.0, 70.0)
    body_width_mm: float = length(27.0, 45.0)
    sternum_thickness_mm: float = length(9.0, 14.0)
    chest_width_mm: float = length(250.0, 310.0)
    chest_roundness: float = trait(0.62, 0.86)  # depth over width
    sternal_angle_deg: float = trait(8.0, 24.0)  # between manubrium and body
    sternal_tilt_deg: float = trait(12.0, 30.0)  # lower end forward
    costal_angle: float = trait(0.85, 1.15)  # breadth of the arch below the sternum against the average
    arch_length: float = trait(0.88, 1.12)
    cartilage_height: float = trait(0.85, 1.15)
    cartilage_thickness_mm: float = trait(7.0, 10.5)
    asymmetry_mm: float = trait(1.0, 4.0)  # standard deviation of a point of a cartilage against its mirror image


def thoracic_surface(p: ThoracicParameters, rng: np.random.Generator, spacing_mm: float = 2.2) -> Surface:
    """Mesh sternum and cartilages; `rng` draws how the two sides differ."""
    chest = _Chest(p)
    reach = 0.5 * p.chest_width_mm + 20.0
    solid = Solid([-reach, -110.0, -350.0 * chest.scale], [reach, 150.0, 25.0], spacing_mm)
    _sternum(solid, chest)
    for side in (-1.0, 1.0):
        _cartilages(solid, chest, side, rng)
    return solid.surface(smoothing_mm=1.4)


class _Chest:
    """Where the chest wall is: the sternum's line in side view, and how the wall falls back to the sides."""

    def __init__(self, p: ThoracicParameters) -> None:
        self.p = p
        self.sternum_mm = p.manubrium_length_mm + p.body_length_mm
        self.scale = self.sternum_mm / 150.0
        upper, lower = np.radians(p.sternal_tilt_deg + p.sternal_angle_deg), np.radians(p.sternal_tilt_deg)
        steps = [p.manubrium_length_mm, p.body_length_mm, 80.0, 120.0]
        slopes = [upper, lower, lower - 0.5, -0.30]  # below the sternum the wall turns back
        y = np.concatenate([[0.0], -np.cumsum(np.array(steps) * np.sin(slopes))])
        z = np.concatenate([[0.0], -np.cumsum(np.array(steps) * np.cos(slopes))])
        self._line = CubicSpline(-z, y, bc_type="natural")

    def front(self, z: ArrayLike) -> Array:
        """Give y of the wall amid the chest at height z."""
        return np.asarray(self._line(np.clip(-np.asarray(z), 0.0, 330.0)))

    def on_wall(self, x: ArrayLike, z: ArrayLike) -> Array:
        """Points (K, 3) on the wall."""
        half = self.p.chest_width_mm / 2.0 * np.interp(-np.asarray(z), [0.0, 150.0], [0.72, 1.12])
        depth = half * self.p.chest_roundness
        fall = depth * (1.0 - np.sqrt(np.clip(1.0 - (np.asarray(x) / half) ** 2, 0.02, 1.0)))
        return np.stack([np.broadcast_to(x, np.shape(z)), self.front(z) + fall, np.asarray(z)], axis=-1)

    def normals(self, points: Array) -> Array:
        """Outward unit normals (K, 3) of the wall, by differences."""
        x, z = points[:, 0], points[:, 2]
        across = self.on_wall(x + 1.0, z) - self.on_wall(x - 1.0, z)
        upward = self.on_wall(x, z + 1.0) - self.on_wall(x, z - 1.0)
        normal = np.cross(across, upward)
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _sternum(solid: Solid, chest: _Chest) -> None:
    p = chest.p
    m, total = p.manubrium_length_mm, chest.sternum_mm
    z = -np.array(
        [
            2.0,
            0.3 * m,
            0.65 * m,
            m,
            m + 0.3 * p.body_length_mm,
            m + 0.72 * p.body_length_mm,
            total - 4.0,
            total + 0.35 * p.xiphoid_length_mm,
            total + p.xiphoid_length_mm,
        ]
    )
    wide, body = p.manubrium_width_mm / 2.0, p.body_width_mm / 2.0
    half = np.array([0.78 * wide, wide, 0.72 * wide, 0.82 * body, 0.9 * body, body, 0.72 * body, 8.0, 3.5])
    thick = p.sternum_thickness_mm / 2.0 * np.array([1.15, 1.2, 1.1, 1.0, 0.95, 0.9, 0.85, 0.6, 0.5])
    half = np.maximum(half - thick, 0.5)
    rows = [(np.stack([f * half, chest.front(z), z], axis=1), thick) for f in (-1.0, 0.0, 1.0)]
    solid.add(sheet(rows), 4.0)
    y = float(chest.front(-2.0))
    solid.cut(tube([[0.0, y - 15.0, 9.0], [0.0, y + 15.0, 9.0]], [13.0, 13.0]), 4.0)  # jugular notch
    for side in (-1.0, 1.0):
        solid.cut(ball([side * 0.95 * wide, y, 8.0], 11.0), 4.0)  # clavicle
    angle = float(chest.front(-m)) - 0.5 * p.sternum_thickness_mm
    solid.add(tube([[-0.6 * body, angle, -m], [0.6 * body, angle, -m]], [2.5, 2.5]), 5.0)


def _cartilages(solid: Solid, chest: _Chest, side: float, rng: np.random.Generator) -> None:
    above: Array | None = None
    for rib in PATHS:
        outline = _outline(chest, rib, above, rng)
        above = CubicSpline(np.linspace(0.0, 1.0, len(outline)), outline)(np.linspace(0.0, 1.0, 13))
        middle = chest.on_wall(above[:, 0], above[:, 1])
        solid.add(_band(chest, middle, rib, side), 3.0)


def _outline(chest: _Chest, rib: int, above: Array | None, rng: np.random.Generator) -> Array:
    """Control points (K, 2) as x, z on the subject's own chest."""
    p = chest.p
    path = np.array(PATHS[rib], dtype=np.float64) + rng.normal(0.0, p.asymmetry_mm, np.shape(PATHS[rib]))
    path[:, 0] *= np.interp(-path[:, 1], [0.0, 140.0, 200.0], [1.0, 1.0, p.costal_angle]) * p.chest_width_mm / 280.0
    path[:, 0] = np.minimum(path[:, 0], 0.5 * p.chest_width_mm)
    below = np.minimum(path[:, 1] + 150.0, 0.0)
    path[:, 1] = chest.scale * (path[:, 1] - below + below * p.arch_length)
    if rib in JOINS:
        assert above is not None
        path[0] = above[round(JOINS[rib] * (len(above) - 1))]
        return path
    edge = p.manubrium_width_mm / 2.0 - 6.0 if rib == 1 else p.body_width_mm / 2.0 * (0.6 if rib == 7 else 0.85) - 3.0
    path[0] = [max(edge, 5.0), chest.scale * PATHS[rib][0][1]]
    return path


def _band(chest: _Chest, middle: Array, rib: int, side: float) -> Shape:
    """Make a cartilage: higher than thick, lying on the wall, swelling a little at the bony rib."""
    p = chest.p
    normal = chest.normals(middle)
    tangent = np.gradient(middle, axis=0)
    upward = np.cross(tangent / np.linalg.norm(tangent, axis=1, keepdims=True), normal)
    thick = p.cartilage_thickness_mm / 2.0 * np.interp(rib, [1, 6, 10], [1.0, 1.0, 0.85])
    half = max(HEIGHT[rib] * p.cartilage_height - thick, 0.8)
    swelling = np.interp(np.linspace(0.0, 1.0, len(middle)), [0.0, 0.15, 0.8, 1.0], [1.0, 0.92, 1.0, 1.12])
    mirror = np.array([side, 1.0, 1.0])
    radii = thick * swelling
    return sheet([((middle + f * half * upward) * mirror, radii) for f in (-1.0, 1.0)], step_mm=2.5)
