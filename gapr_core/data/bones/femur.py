"""A left femur. Frame: x lateral, y backwards, z up along the shaft; z = 0 at the distal end of the lateral condyle."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.parameters import length, trait
from gapr_core.data.solid import Grid, Solid, ball, ellipsoid, loft, profile, tube, wheel
from gapr_core.surface import Surface

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FemurParameters:
    """Measures of a surgeon; ranges hold about 95 % of adults."""

    length_mm: float = length(395.0, 495.0)
    head_diameter_mm: float = length(41.0, 53.0)
    neck_width_mm: float = length(28.0, 37.0)
    offset_mm: float = length(33.0, 50.0)  # head centre to shaft axis
    shaft_width_mm: float = length(24.0, 31.0)
    epicondylar_width_mm: float = length(72.0, 92.0)
    condyle_depth_mm: float = length(56.0, 70.0)  # front of the trochlea to the back of the condyles
    neck_shaft_angle_deg: float = trait(117.0, 136.0)
    anteversion_deg: float = trait(2.0, 26.0)
    valgus_deg: float = trait(3.5, 8.0)  # shaft against the line under both condyles
    bow_mm: float = trait(8.0, 18.0)  # sagitta of the forward curvature
    lateral_bow_mm: float = trait(-3.0, 6.0)
    shaft_roundness: float = trait(0.95, 1.15)  # depth over width
    trochanter_size: float = trait(0.85, 1.15)
    trochanter_height_mm: float = trait(-4.0, 8.0)  # its tip above the centre of the head
    lesser_trochanter_size: float = trait(0.75, 1.25)
    linea_aspera_mm: float = trait(1.5, 4.5)
    notch_width_mm: float = trait(17.0, 24.0)
    groove_depth_mm: float = trait(4.0, 8.0)
    condyle_flare_deg: float = trait(4.0, 11.0)


def femur_surface(p: FemurParameters, spacing_mm: float = 2.0) -> Surface:
    """Mesh one femur; the forward bow is a bend of the straight solid."""
    solid = Solid((-75.0, -60.0, -20.0), (65.0, 60.0, p.length_mm + 15.0), spacing_mm)
    _shaft(solid, p)
    _proximal_end(solid, p)
    _distal_end(solid, p)
    return _bow(solid.surface(), p)


def _shaft(solid: Solid, p: FemurParameters) -> None:
    """Make an oval shaft that flares at both ends, with the linea aspera as a ridge at its back."""
    width, wide = p.shaft_width_mm / 2.0, p.epicondylar_width_mm / 80.0
    stations = np.array([0.05, 0.09, 0.13, 0.18, 0.25, 0.40, 0.55, 0.70, 0.78, 0.84, 0.88]) * p.length_mm
    half_width = np.array(
        [
            33.0 * wide,
            31.0 * wide,
            26.5 * wide,
            21.5 * wide,
            1.22 * width,
            1.04 * width,
            width,
            1.03 * width,
            1.2 * width,
            1.42 * width,
            1.3 * width,
        ]
    )
    half_depth = p.shaft_roundness * width * np.array([1.5, 1.4, 1.25, 1.12, 1.04, 1.02, 1.0, 0.97, 1.0, 1.08, 1.0])
    ridge = profile(p.length_mm * np.array([0.2, 0.32, 0.66, 0.80]), [0.0, p.linea_aspera_mm, p.linea_aspera_mm, 0.0])
    a, b = profile(stations, half_width), profile(stations, half_depth)

    def radius(angle: Grid, z: Grid) -> Grid:
        oval = 1.0 / np.sqrt((np.cos(angle) / a(z)) ** 2 + (np.sin(angle) / b(z)) ** 2)
        return oval + ridge(z) * np.exp(-(((angle - np.pi / 2.0) / 0.28) ** 2))

    solid.add(loft(stations[0], stations[-1], float(half_width.max()) + 3.0, radius), 0.0)


def _proximal_end(solid: Solid, p: FemurParameters) -> None:
    head_radius, neck = p.head_diameter_mm / 2.0, p.neck_width_mm / 2.0
    rise, turn = np.radians(p.neck_shaft_angle_deg - 90.0), np.radians(p.anteversion_deg)
    medial = np.array([-np.cos(turn), -np.sin(turn), 0.0])
    head = p.offset_mm * medial + [0.0, 0.0, p.length_mm - head_radius]
    root = head - p.offset_mm * (medial + [0.0, 0.0, np.tan(rise)])
    along = (head - root) / np.linalg.norm(head - root)
    across = np.cross(along, [0.0, 0.0, 1.0])
    stations = root + np.array([-0.05, 0.25, 0.55, 0.8, 1.0])[:, None] * (head - root)
    solid.add(tube(stations, neck * np.array([1.35, 1.18, 1.0, 1.02, 1.1]), across / np.linalg.norm(across), 0.82), 8.0)
    solid.add(ball(head, head_radius), 4.0)
    fovea = along * 0.93 + np.array([0.0, 0.30, -0.15])
    solid.cut(ball(head + (head_radius + 3.5) * fovea / np.linalg.norm(fovea), 6.0), 2.5)
    _trochanters(solid, p, root, head)


def _trochanters(solid: Solid, p: FemurParameters, root: Array, head: Array) -> None:
    k = p.trochanter_size
    tip = np.array([14.0, 8.0, head[2] + p.trochanter_height_mm - 13.0 * k])
    top = np.array([15.0, -1.0, tip[2] - 6.0])
    front = [root + [1.0, 0.0, -62.0], root + [9.0, -2.0, -26.0], root + [16.0, -4.0, -2.0], top]
    back = [root + [4.0, 2.0, -44.0], root + [14.0, 6.0, -8.0], tip, tip + [-5.0, 7.0, 3.0]]
    solid.add(tube(front, k * np.array([10.0, 14.0, 13.0, 9.5])), 12.0)
    solid.add(tube(back, k * np.array([11.0, 14.5, 11.5, 7.5])), 9.0)
    lesser = root + [-13.5, 11.0, -37.0]
    solid.add(tube([root + [-3.0, 2.0, -38.0], lesser], np.array([12.0, 6.5]) * p.lesser_trochanter_size), 7.0)
    crest = [tip + [-4.0, 7.0, -4.0], root + [4.0, 14.0, -8.0], lesser + [2.0, -1.0, 4.0]]
    solid.add(tube(crest, [6.0, 5.0, 5.0]), 8.0)
    solid.cut(ball(root + [-5.0, 19.0, tip[2] - root[2] - 9.0], 8.0), 6.0)


def _distal_end(solid: Solid, p: FemurParameters) -> None:
    """Two condyles as three wheels each, the trochlea between them; then groove and notch are cut."""
    wide, deep = p.epicondylar_width_mm / 80.0, p.condyle_depth_mm / 63.0
    lower = 44.0 * wide * np.tan(np.radians(p.valgus_deg))  # the medial condyle reaches farther down
    inner = p.notch_width_mm / 2.0
    for side, drop in ((-1.0, lower), (1.0, 0.0)):  # medial, lateral
        flare = np.radians(p.condyle_flare_deg) * side
        axis = np.array([np.cos(flare), -np.sin(flare), 0.0])
        half = (37.0 * wide - inner) / 2.0
        middle = side * (inner + half)
        back, front = (20.5 if side < 0 else 19.5) * deep, 26.0 * deep
        solid.add(wheel([middle + 2.5 * side, 37.0 * deep - back, back + 3.0 - drop], axis, back, half, 9.0), 3.0)
        solid.add(wheel([middle, 11.0 * deep, front - drop + 1.0], axis, front, half, 10.0), 8.0)
        trochlea = [side * 12.0 * wide, -4.5 * deep, 27.0 * deep - 0.6 * drop]
        solid.add(wheel(trochlea, axis, (21.0 + 1.5 * side) * deep, 14.0 * wide, 10.0), 9.0)
        solid.add(ellipsoid([side * 35.0 * wide, 9.0, 31.0 - 0.7 * drop], [9.0, 11.0, 13.0]), 9.0)
    solid.add(wheel([0.0, -1.0, 28.0 * deep - 0.5 * lower], [1.0, 0.0, 0.0], 22.0 * deep, 16.0 * wide, 8.0), 8.0)
    upper = [[x * wide, -2.0, 40.0 * deep] for x in (-12.0, 13.0)]
    solid.add(tube(upper, [17.0 * deep, 17.5 * deep]), 14.0)
    _groove_and_notch(solid, p, deep, inner, 0.5 * lower)


def _groove_and_notch(solid: Solid, p: FemurParameters, deep: float, inner: float, drop: float) -> None:
    """Make the trochlea's groove, `groove_depth_mm` deep, and the notch, an arch open to the back and below."""
    radius = 13.0
    hub = np.array([0.5, -4.0 * deep, 27.0 * deep - drop])
    reach = 22.5 * deep + radius - p.groove_depth_mm
    turns = np.radians([-38.0, -15.0, 5.0, 35.0, 65.0, 85.0])
    path = [hub + reach * np.array([0.0, -np.cos(t), -np.sin(t)]) for t in turns]
    path.insert(0, path[0] + [0.0, -7.0, 20.0])  # runs out of the bone above the trochlea
    solid.cut(tube(path, [8.0, 11.0, radius, radius, radius, radius, 12.0]), 8.0)
    roof = 24.0 * deep - drop
    for low in (roof - inner, 2.0, -12.0):
        start = 15.0 if low > 5.0 else 9.0
        solid.cut(tube([[0.0, start, low], [0.0, 60.0, low + 5.0]], [inner, inner]), 4.0)


def _bow(surface: Surface, p: FemurParameters) -> Surface:
    """Bend between the ends, most at mid-shaft: forward (-y) by `bow_mm`, outward (+x) by `lateral_bow_mm`."""
    t = (surface.points[:, 2] / p.length_mm - 0.52) / 0.52
    bend = np.array([p.lateral_bow_mm, -p.bow_mm, 0.0])
    return replace(surface, points=surface.points + (1.0 - t**2)[:, None] * bend)
