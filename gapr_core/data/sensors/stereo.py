"""Passive stereo: depth that is matched over windows, so that ridges are round and errors come in patches."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gapr_core.data.sensors.acquired import Acquired, look, smooth_offsets, tangents
from gapr_core.data.specimen import Specimen
from gapr_core.geometry import sampling

Array = NDArray[np.float64]

SHARE = (0.08, 0.35)
POINTS = (400, 5000)
WINDOW_MM = (1.0, 4.0)  # standard deviation of the Gaussian window over which depth is matched
IN_WINDOW, MOST_STEP_MM = 80, 8.0  # points that a window looks at, and the step of depth that ends it
NOISE_MM = (0.2, 1.0)  # along the look, alike within a window
WHITE = 0.3  # standard deviation of what differs from point to point, in those of the noise
HOLES, HOLE_MM = (0, 6), (3.0, 10.0)  # without texture nothing is matched: how many, and their radius
BIAS_MM = 1.0


def stereo(specimen: Specimen, rng: np.random.Generator) -> Acquired:
    """400 to 5000 points of one look, smoothed over 1 to 4 mm, with holes."""
    view = look(specimen, SHARE, "seen", 30_000, rng)
    window_mm, noise_mm = rng.uniform(*WINDOW_MM), rng.uniform(*NOISE_MM)
    depth_mm, across = view.points @ view.towards, view.points @ np.stack(tangents(view), axis=1)
    some = sampling.voxel_indices(view.points, 0.5 * window_mm)
    apart, near = cKDTree(across[some]).query(across, k=min(IN_WINDOW, len(some)))
    near = some[near]
    weights = np.exp(-0.5 * (apart / window_mm) ** 2) * (np.abs(depth_mm[near] - depth_mm[:, None]) < MOST_STEP_MM)
    weights /= weights.sum(axis=1, keepdims=True)
    patchy = np.einsum("nk,nk->n", weights, rng.normal(size=len(depth_mm))[near])
    matched = np.einsum("nk,nk->n", weights, depth_mm[near]) - depth_mm + noise_mm * patchy / max(patchy.std(), 1e-9)
    bias_mm, bias = smooth_offsets(view.points, BIAS_MM, rng)
    off_mm = matched + bias_mm + rng.normal(0.0, WHITE * noise_mm, len(depth_mm))
    kept = np.ones(len(depth_mm), dtype=bool)
    for middle in rng.integers(len(kept), size=int(rng.integers(HOLES[0], HOLES[1] + 1))):
        kept &= np.linalg.norm(across - across[middle], axis=1) > rng.uniform(*HOLE_MM)
    chosen = rng.permutation(np.flatnonzero(kept) if kept.any() else np.arange(len(kept)))
    chosen = chosen[: round(float(np.exp(rng.uniform(*np.log(POINTS)))))]
    parameters = {
        **view.parameters, **bias, "family": "stereo", "noise_mm": noise_mm, "window_mm": window_mm, "scale": 1.0,
        "standoff_mm": 0.0, "outlier_share": 0.0,
    }  # fmt: skip
    return Acquired((view.points + np.outer(off_mm, view.towards))[chosen], parameters)
