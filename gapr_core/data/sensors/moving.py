"""A probe that passes over a bone which does not keep still: breathing, a drifting reference, late time stamps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gapr_core.data.sensors.acquired import Acquired, look, smooth_offsets, tangents
from gapr_core.data.specimen import Specimen
from gapr_core.geometry.sampling import log_uniform, random_directions

Array = NDArray[np.float64]

SHARE = (0.06, 0.3)
POINTS = (300, 4000)
NOISE_MM = (0.1, 0.8)
SHIFT_MM, TURN_DEG = (0.2, 2.5), (0.0, 1.5)  # largest motion from its mean
CYCLES = (0.3, 3.0)  # of the motion during the pass
BIAS_MM = 0.5


def moving(specimen: Specimen, rng: np.random.Generator) -> Acquired:
    """300 to 4000 points of one pass; the frame is that of the bone's mean pose."""
    view = look(specimen, SHARE, "band" if rng.random() < 0.5 else "seen", 20_000, rng)
    view = view.only(rng.permutation(len(view.points))[: round(log_uniform(POINTS, rng))])
    place = view.points @ tangents(view)[0]
    when = (place - place.min()) / max(np.ptp(place), 1e-9)
    phase = np.sin(2.0 * np.pi * (rng.uniform(*CYCLES) * when + rng.random()))
    phase -= phase.mean()
    phase /= max(np.abs(phase).max(), 1e-9)
    shift_mm, turn_deg, noise_mm = rng.uniform(*SHIFT_MM), rng.uniform(*TURN_DEG), rng.uniform(*NOISE_MM)
    axis, way = random_directions(2, rng)
    bias_mm, bias = smooth_offsets(view.points, BIAS_MM, rng)
    points = view.points + bias_mm[:, None] * view.outward
    centre = points.mean(axis=0)
    turned = Rotation.from_rotvec(np.radians(turn_deg) * phase[:, None] * axis).apply(points - centre)
    points = centre + turned + shift_mm * phase[:, None] * way + rng.normal(0.0, noise_mm, points.shape)
    parameters = {
        **view.parameters, **bias, "family": "moving", "noise_mm": noise_mm, "scale": 1.0, "standoff_mm": 0.0,
        "outlier_share": 0.0, "shift_mm": shift_mm, "turn_deg": turn_deg,
    }  # fmt: skip
    return Acquired(points, parameters)
