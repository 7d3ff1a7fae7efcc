"""Passive stereo: depth that is matched over windows, so that ridges are round and errors come in patches."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.sensors.acquired import Acquired, look, smooth_offsets, tangents
from gapr_core.data.sensors.depth_maps import windows
from gapr_core.data.specimen import Specimen
from gapr_core.geometry.sampling import log_uniform

Array = NDArray[np.float64]

SHARE = (0.08, 0.35)
POINTS = (400, 5000)
WINDOW_MM = (1.0, 4.0)  # standard deviation of the Gaussian window over which depth is matched
NOISE_MM = (0.2, 1.0)  # along the look, alike within a window
WHITE = 0.3  # standard deviation of what differs from point to point, in those of the noise
HOLES, HOLE_MM = (0, 6), (3.0, 10.0)  # without texture nothing is matched: how many, and their radius
BIAS_MM = 1.0


def stereo(specimen: Specimen, rng: np.random.Generator) -> Acquired:
    """400 to 5000 points of one look, smoothed over 1 to 4 mm, with holes."""
    view = look(specimen, SHARE, "seen", 30_000, rng)
    window_mm, noise_mm = rng.uniform(*WINDOW_MM), rng.uniform(*NOISE_MM)
    over, depth_mm = windows(view, window_mm), view.points @ view.towards
    matched = over.mean(depth_mm) - depth_mm + over.patchy(noise_mm, rng)
    bias_mm, bias = smooth_offsets(view.points, BIAS_MM, rng)
    off_mm = matched + bias_mm + rng.normal(0.0, WHITE * noise_mm, len(depth_mm))
    across = view.points @ np.stack(tangents(view), axis=1)
    kept = np.ones(len(depth_mm), dtype=bool)
    for middle in rng.integers(len(kept), size=int(rng.integers(HOLES[0], HOLES[1] + 1))):
        kept &= np.linalg.norm(across - across[middle], axis=1) > rng.uniform(*HOLE_MM)
    chosen = rng.permutation(np.flatnonzero(kept) if kept.any() else np.arange(len(kept)))
    chosen = chosen[: round(log_uniform(POINTS, rng))]
    parameters = {
        **view.parameters, **bias, "family": "stereo", "noise_mm": noise_mm, "window_mm": window_mm, "scale": 1.0,
        "standoff_mm": 0.0, "outlier_share": 0.0,
    }  # fmt: skip
    return Acquired((view.points + np.outer(off_mm, view.towards))[chosen], parameters)
