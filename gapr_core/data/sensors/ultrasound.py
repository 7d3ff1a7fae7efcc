"""Tracked ultrasound: slices across the bone, whose errors lie along the beam and go with the slice."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gapr_core.data.sensors.acquired import Acquired, View, look, smooth_offsets, some, tangents
from gapr_core.data.specimen import Specimen
from gapr_core.geometry.sampling import log_uniform

Array = NDArray[np.float64]

SHARE = (0.05, 0.25)  # of the surface under the probe's way
SLICES, SLICE_POINTS = (4, 40), (20, 120)
SLICE_MM = 1.2  # thickness of what is taken for a slice
WIDTH_MM = (25.0, 50.0)  # of the transducer
TILT_DEG = 8.0  # standard deviation of a slice's tilt
TISSUE_MM = (5.0, 35.0)  # between the transducer and the highest point of bone
SPEED_OF_SOUND = (0.01, 0.03)  # size of its relative error, of either sign
THICKNESS_MM = 0.5  # largest offset of where in the echo the bone is drawn
AXIAL_MM, LATERAL_MM, ELEVATION_MM = (0.2, 0.6), (0.1, 0.3), (0.2, 0.8)  # noise along and across the beam
TRACKING_MM, TRACKING_DEG = (0.1, 0.5), (0.05, 0.5)  # standard deviations of a slice's pose
BIAS_MM = 0.5
OUTLIERS, OUTLIER_MM = 0.08, (2.0, 10.0)  # other interfaces, along the beam


def ultrasound(specimen: Specimen, rng: np.random.Generator, count: tuple[int, int] = SLICES) -> Acquired:
    """Take 4 to 40 slices (`count`), each with the errors of its own pose, beam and depth."""
    view = look(specimen, SHARE, "band" if rng.random() < 0.7 else "seen", 60_000, rng)
    slices = _slices(view, count, rng)
    drawn = {
        "speed_of_sound": 1.0 + rng.choice([-1.0, 1.0]) * rng.uniform(*SPEED_OF_SOUND),
        "thickness_mm": rng.uniform(-THICKNESS_MM, THICKNESS_MM),
        "axial_mm": rng.uniform(*AXIAL_MM),
        "lateral_mm": rng.uniform(*LATERAL_MM),
        "elevation_mm": rng.uniform(*ELEVATION_MM),
        "tracking_mm": rng.uniform(*TRACKING_MM),
        "tracking_deg": rng.uniform(*TRACKING_DEG),
        "tissue_mm": rng.uniform(*TISSUE_MM),
    }
    true = view.only(np.concatenate(slices))
    offsets_mm, bias = smooth_offsets(true.points, BIAS_MM, rng)
    ends = np.cumsum([len(chosen) for chosen in slices])[:-1]
    share = rng.uniform(0.0, OUTLIERS)
    of_slices = zip(np.split(true.points, ends), np.split(offsets_mm, ends), strict=True)
    points = np.concatenate([_image(p, bias_mm, view, drawn, share, rng) for p, bias_mm in of_slices])
    outside_mm = np.einsum("ni,ni->n", points - true.points, true.outward)
    parameters = {
        **view.parameters, **drawn, **bias, "family": "ultrasound", "slices": len(slices), "outlier_share": share,
        "noise_mm": drawn["axial_mm"], "scale": drawn["speed_of_sound"], "standoff_mm": float(np.median(outside_mm)),
    }  # fmt: skip
    return Acquired(points, parameters)


def _slices(view: View, limits: tuple[int, int], rng: np.random.Generator) -> list[NDArray[np.intp]]:
    """Indices of the points of each slice; slices lie across the way of the probe, tilted by hand."""
    along, across = tangents(view)
    count = round(log_uniform(limits, rng))
    most, width_mm = int(rng.integers(*SLICE_POINTS)), rng.uniform(*WIDTH_MM)
    low, high = np.quantile(view.points @ along, (0.03, 0.97))
    places = np.linspace(low, high, count) + rng.normal(0.0, 0.2, count) * (high - low) / count
    found = [_slice(view, place, along, across, width_mm, most, rng) for place in places]
    whole = [chosen for chosen in found if len(chosen) > 3]
    return whole or [np.arange(len(view.points))[:most]]


def _slice(
    view: View, place: float, along: Array, across: Array, width_mm: float, most: int, rng: np.random.Generator
) -> NDArray[np.intp]:
    tilt = Rotation.from_rotvec(np.radians(rng.normal(0.0, TILT_DEG, 2)) @ np.stack([across, view.towards]))
    normal = tilt.apply(along)
    near = np.abs(view.points @ along - place) < 0.5 * width_mm
    middle = view.points[near].mean(axis=0) if near.any() else view.points.mean(axis=0)
    middle = middle + along * (place - middle @ along)
    offsets = view.points - middle
    inside = (np.abs(offsets @ normal) < 0.5 * SLICE_MM) & (np.abs(offsets @ across) < 0.5 * width_mm)
    return rng.permutation(np.flatnonzero(inside))[:most]


def _image(
    points: Array, bias_mm: Array, view: View, drawn: dict[str, Any], share: float, rng: np.random.Generator
) -> Array:
    """Measure one slice (N, 3): depth scaled, noise by axis, other interfaces, then the tracker's error."""
    beam = Rotation.from_rotvec(np.radians(rng.normal(0.0, 5.0, 3))).apply(-view.towards)
    depth = points @ beam
    depth_mm = drawn["tissue_mm"] + depth - depth.min()
    too_deep_mm = (drawn["speed_of_sound"] - 1.0) * depth_mm - drawn["thickness_mm"] - bias_mm
    off = some(share, len(points), rng)
    too_deep_mm[off] += rng.choice([-1.0, 1.0], len(off)) * rng.uniform(*OUTLIER_MM, len(off))
    along, across = tangents(view)
    noise = rng.normal(size=(len(points), 3)) * [drawn["axial_mm"], drawn["lateral_mm"], drawn["elevation_mm"]]
    measured = points + np.outer(too_deep_mm, beam) + noise @ np.stack([beam, across, along])
    centre = measured.mean(axis=0)
    turn = Rotation.from_rotvec(np.radians(rng.normal(0.0, drawn["tracking_deg"], 3)))
    return turn.apply(measured - centre) + centre + rng.normal(0.0, drawn["tracking_mm"], 3)
