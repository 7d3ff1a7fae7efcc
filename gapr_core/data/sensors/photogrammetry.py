"""Photogrammetry: many pictures made into one cloud, of not quite the right size and a little bent."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.sensors.acquired import Acquired, look, smooth_offsets, some, tangents
from gapr_core.data.specimen import Specimen
from gapr_core.geometry.sampling import log_uniform

Array = NDArray[np.float64]

SHARE = (0.1, 0.45)
POINTS = (500, 6000)
NOISE_MM = (0.1, 0.6)
SCALE = 0.007  # standard deviation of the relative error of the size
BENT_MM = 1.2  # largest sag of the middle over the rims of what is seen
BIAS_MM = 0.5
OUTLIERS, OUTLIER_MM = 0.04, (1.0, 10.0)


def photogrammetry(specimen: Specimen, rng: np.random.Generator) -> Acquired:
    """500 to 6000 points of one side, bent by up to 1.2 mm."""
    view = look(specimen, SHARE, "seen", 30_000, rng)
    view = view.only(rng.permutation(len(view.points))[: round(log_uniform(POINTS, rng))])
    noise_mm, scale, centre = rng.uniform(*NOISE_MM), 1.0 + rng.normal(0.0, SCALE), view.points.mean(axis=0)
    across = (view.points - centre) @ np.stack(tangents(view), axis=1)
    across /= max(np.abs(across).max(), 1e-9)
    bend = rng.normal(size=(2, 2))
    sag = np.einsum("ni,ij,nj->n", across, bend, across)
    bent_mm = rng.uniform(0.0, BENT_MM) * sag / max(np.ptp(sag), 1e-9)
    bias_mm, bias = smooth_offsets(view.points, BIAS_MM, rng)
    points = centre + scale * (view.points - centre) + np.outer(bent_mm, view.towards) + bias_mm[:, None] * view.outward
    points += rng.normal(0.0, noise_mm, points.shape)
    off = some(rng.uniform(0.0, OUTLIERS), len(points), rng)
    points[off] += (rng.choice([-1.0, 1.0], len(off)) * rng.uniform(*OUTLIER_MM, len(off)))[:, None] * view.outward[off]
    parameters = {
        **view.parameters, **bias, "family": "photogrammetry", "noise_mm": noise_mm, "scale": scale,
        "bent_mm": float(np.ptp(bent_mm)), "standoff_mm": 0.0, "outlier_share": len(off) / len(points),
    }  # fmt: skip
    return Acquired(points, parameters)
