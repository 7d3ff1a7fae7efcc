"""A left tibia. Frame: x lateral, y backwards, z up along the shaft; z = 0 at the ankle's joint surface."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.parameters import length, trait
from gapr_core.data.solid import Grid, Solid, ball, ellipsoid, half_space, loft, profile, tube, wheel
from gapr_core.surface import Surface

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TibiaParameters:
    """Measures of a surgeon; ranges hold about 95 % of adults."""

    length_mm: float = length(320.0, 410.0)
    plateau_width_mm: float = length(66.0, 84.0)
    plateau_depth_mm: float = length(42.0, 55.0)
    shaft_width_mm: float = length(20.0, 27.0)
    ankle_width_mm: float = length(40.0, 51.0)
    malleolus_mm: float = length(10.0, 16.0)  # below the joint surface
    posterior_slope_deg: float = trait(3.0, 12.0)
    torsion_deg: float = trait(14.0, 42.0)  # the ankle turned outward against the knee
    tuberosity_size: float = trait(0.8, 1.25)
    crest_sharpness: float = trait(5.0, 9.0)  # exponent of the triangular section: larger is sharper
    medial_dish_mm: float = trait(1.5, 4.0)
    eminence_mm: float = trait(5.0, 10.0)
    fibular_notch_mm: float = trait(2.0, 5.0)
    bow_mm: float = trait(-3.0, 6.0)  # to the lateral side
    recurvature_mm: float = trait(1.0, 7.0)  # the shaft's middle in front of its ends


def tibia_surface(p: TibiaParameters, spacing_mm: float = 2.0) -> Surface:
    """Mesh one tibia; torsion and bow bend the straight solid."""
    solid = Solid((-55.0, -55.0, -30.0), (55.0, 55.0, p.length_mm + 20.0), spacing_mm)
    _shaft(solid, p)
    _plateau(solid, p)
    _ankle(solid, p)
    return _twist_and_bow(solid.surface(), p)


def _shaft(solid: Solid, p: TibiaParameters) -> None:
    """Three faces with the crest in front: medial, lateral and posterior distances from the axis along z."""
    width, knee, ankle = p.shaft_width_mm / 24.0, p.plateau_width_mm / 75.0, p.ankle_width_mm / 46.0
    stations = p.length_mm * np.array([0.0, 0.04, 0.09, 0.16, 0.25, 0.4, 0.55, 0.7, 0.8, 0.87, 0.92, 0.96])
    scale = np.array([ankle] * 3 + [width] * 6 + [knee] * 3)
    medial = scale * np.array([19.0, 17.5, 14.0, 10.8, 9.6, 9.8, 10.8, 13.0, 17.5, 24.0, 29.0, 30.0])
    lateral = scale * np.array([19.0, 17.5, 13.5, 10.5, 9.3, 9.6, 10.8, 13.0, 18.0, 24.5, 29.0, 30.0])
    back = scale * np.array([16.0, 15.0, 12.5, 10.3, 9.5, 10.2, 11.5, 13.0, 15.0, 19.0, 24.0, 26.0])
    front = scale * np.array([15.0, 14.5, 13.5, 13.0, 13.5, 16.5, 18.5, 20.5, 22.0, 23.0, 23.0, 23.0])
    faces = {207.0: medial, -20.0: lateral, 90.0: back, 262.0: front}  # where each looks, degrees from x
    walls = [(np.radians(angle), profile(stations, d)) for angle, d in faces.items()]
    sharp = p.crest_sharpness
    sharpness = profile(stations[[0, 2, 4, 7, 9]], [3.5, 4.5, sharp, sharp, 3.0])  # rounder ends

    def radius(angle: Grid, z: Grid) -> Grid:
        n, unit = sharpness(z), 20.0  # of the order of the distances, so that the powers stay near 1
        pressed = sum(np.maximum(unit * np.cos(angle - towards) / d(z), 0.0) ** n for towards, d in walls)
        return np.asarray(unit * (pressed + 1e-9) ** (-1.0 / n))

    solid.add(loft(stations[0], stations[-1], 46.0, radius), 0.0)


def _plateau(solid: Solid, p: TibiaParameters) -> None:
    """Two condyles under a sloping cut, the medial one dished and the lateral one flat, the eminence between them."""
    w, d, top = p.plateau_width_mm / 75.0, p.plateau_depth_mm / 48.0, p.length_mm
    for side, across, along in ((-1.0, 19.5, 26.0), (1.0, 19.0, 23.5)):  # medial, lateral
        centre = np.array([side * 18.5 * w, 5.0 * d, top - 12.0])
        solid.add(ellipsoid(centre, [across * w, along * d, 24.0]), 14.0)
    solid.add(ellipsoid([0.0, -1.0, top - 14.0], [28.0 * w, 22.0 * d, 22.0]), 14.0)
    solid.add(ellipsoid([30.0 * w, 17.0 * d, top - 19.0], [8.0, 8.0, 8.0]), 8.0)  # facet of the fibula
    tuberosity = np.array([[3.0, -14.0, -24.0], [3.0, -17.0, -38.0], [2.0, -15.0, -56.0], [1.0, -12.0, -80.0]])
    solid.add(tube(tuberosity + [0.0, 0.0, top], p.tuberosity_size * np.array([8.0, 9.0, 8.0, 5.0])), 14.0)
    slope = np.radians(p.posterior_slope_deg)
    up = np.array([0.0, np.sin(slope), np.cos(slope)])
    solid.cut(half_space([0.0, 0.0, top], up, 60.0), 6.0)
    solid.cut(ball(np.array([-19.0 * w, 6.0, top]) + (70.0 - p.medial_dish_mm) * up, 70.0), 3.0)
    solid.cut(ball(np.array([19.0 * w, 6.0, top]) + (110.0 - 0.8) * up, 110.0), 3.0)
    for x, height in ((-5.5, 1.0), (5.5, 0.8)):
        ridge = np.array([x, 1.0, top - 4.0]) + (p.eminence_mm * height - 0.5) * up
        solid.add(tube([ridge + [0.3 * x, -9.0, -4.0], ridge, ridge + [0.3 * x, 8.0, -4.0]], [5.0, 4.5, 5.0]), 8.0)
    solid.cut(tube([[0.0, 38.0 * d, top - 26.0], [0.0, 32.0 * d, top + 8.0]], [10.0, 12.0]), 7.0)


def _ankle(solid: Solid, p: TibiaParameters) -> None:
    """Make the arched joint surface, the medial malleolus and the notch for the fibula."""
    w = p.ankle_width_mm / 46.0
    solid.add(ellipsoid([1.0, 1.0, 8.0], [23.0 * w, 18.5 * w, 15.0]), 8.0)
    solid.cut(half_space([0.0, 0.0, -1.0], [-0.05, -0.1, -1.0], 45.0), 4.0)
    tip = np.array([-19.5 * w, -1.0, 4.0 - p.malleolus_mm])
    solid.add(tube([[-15.0 * w, -2.0, 22.0], [-18.5 * w, -3.0, 4.0], tip], [11.0 * w, 10.0 * w, 6.5 * w]), 8.0)
    solid.add(ball(tip + [1.0, 7.0, 4.0], 5.5 * w), 5.0)
    solid.cut(wheel([12.0, 1.0, -26.0], [1.0, 0.0, 0.0], 28.5, 12.0 + 11.0 * w, 2.5), 3.0)  # the arch over the talus
    depth = p.fibular_notch_mm
    solid.cut(tube([[35.5 * w - depth, 3.0, -8.0], [33.5 * w - depth, 4.0, 38.0]], [13.0, 12.0]), 5.0)
    solid.cut(tube([[-14.0 * w, 23.5 * w, -12.0], [-11.0 * w, 23.0 * w, 24.0]], [6.0, 6.0]), 4.0)  # tendon groove


def _twist_and_bow(surface: Surface, p: TibiaParameters) -> Surface:
    t = np.clip(surface.points[:, 2] / p.length_mm, 0.0, 1.0)
    turn = np.radians(p.torsion_deg) * (1.0 - t) ** 1.3  # outward at the ankle: the front turns to lateral (+x)
    x, y = surface.points[:, 0], surface.points[:, 1]
    middle = 4.0 * t * (1.0 - t)
    moved = np.stack(
        [
            np.cos(turn) * x - np.sin(turn) * y + p.bow_mm * middle,
            np.sin(turn) * x + np.cos(turn) * y - p.recurvature_mm * middle,
            surface.points[:, 2],
        ],
        axis=1,
    )
    return replace(surface, points=moved)
