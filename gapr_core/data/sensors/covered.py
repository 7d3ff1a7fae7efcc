"""Bone that is not bare: cartilage, periosteum or a clot, of which the preoperative scan knows nothing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.sensors.acquired import Acquired, look, smooth_offsets
from gapr_core.data.specimen import Specimen
from gapr_core.geometry.sampling import log_uniform

Array = NDArray[np.float64]

SHARE = (0.08, 0.4)
POINTS = (300, 5000)
COVERED, LAYERS = (0.1, 0.7), (1, 3)  # share of what is seen under each layer, and how many there are
THICKNESS_MM, RIM_MM = (0.5, 4.0), (2.0, 12.0)  # of a layer, and the width over which it ends
NOISE_MM = (0.1, 1.0)
BIAS_MM = 0.5


def covered(specimen: Specimen, rng: np.random.Generator) -> Acquired:
    """300 to 5000 points of one side, parts of it up to 4 mm above the bone."""
    view = look(specimen, SHARE, "seen", 20_000, rng)
    view = view.only(rng.permutation(len(view.points))[: round(log_uniform(POINTS, rng))])
    above_mm = layers(view.points, rng)
    bias_mm, bias = smooth_offsets(view.points, BIAS_MM, rng)
    noise_mm = rng.uniform(*NOISE_MM)
    points = view.points + (above_mm + bias_mm)[:, None] * view.outward
    parameters = {
        **view.parameters, **bias, "family": "covered", "noise_mm": noise_mm, "scale": 1.0, "outlier_share": 0.0,
        "standoff_mm": float(above_mm.mean()), "covered_share": float((above_mm > 0.0).mean()),
    }  # fmt: skip
    return Acquired(points + rng.normal(0.0, noise_mm, points.shape), parameters)


def layers(points: Array, rng: np.random.Generator) -> Array:
    """(N,) mm of tissue over points (N, 3): one to three round layers that thin out at their rims."""
    above_mm = np.zeros(len(points))
    for middle in rng.integers(len(above_mm), size=int(rng.integers(LAYERS[0], LAYERS[1] + 1))):
        apart = np.linalg.norm(points - points[middle], axis=1)
        inside = (np.quantile(apart, rng.uniform(*COVERED)) - apart) / rng.uniform(*RIM_MM)  # in widths of the rim
        above_mm = np.maximum(above_mm, rng.uniform(*THICKNESS_MM) * np.clip(inside, 0.0, 1.0))
    return above_mm
