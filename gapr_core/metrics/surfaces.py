"""How well clouds and matches agree: Chamfer distance and inlier ratios."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from gapr_core.geometry import se3


def chamfer_mm(first: ArrayLike, second: ArrayLike, cutoff_mm: float = 10.0) -> float:
    """Compute the paper's CD: mean nearest-neighbour distance, both directions added, pairs beyond the cut-off dropped.

    Args:
        first: (N, 3) cloud, mm.
        second: (M, 3) cloud in the same frame, mm.
        cutoff_mm: pairs at this distance or beyond are not counted; a direction without any pair counts as the cut-off.
    """
    return _one_way(first, second, cutoff_mm) + _one_way(second, first, cutoff_mm)


def _one_way(query: ArrayLike, reference: ArrayLike, cutoff_mm: float) -> float:
    distance, _ = cKDTree(np.asarray(reference)).query(np.asarray(query))
    kept = distance[distance < cutoff_mm]
    return float(kept.mean()) if len(kept) else cutoff_mm


def fine_inlier_ratio(source: ArrayLike, target: ArrayLike, T_true: ArrayLike, radius_mm: float) -> float:
    """Share of correspondences, source (K, 3) to target (K, 3), within the radius under the truth; 0 of none."""
    source, target = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    if len(source) == 0:
        return 0.0
    return float(np.mean(np.linalg.norm(se3.apply(T_true, source) - target, axis=1) < radius_mm))


def coarse_inlier_ratio(matches: ArrayLike, overlap: ArrayLike, least: float = 0.0) -> float:
    """Share of superpoint matches whose patches truly overlap (GeoTransformer's patch inlier ratio); 0 of none.

    Args:
        matches: (K, 2) indices, source superpoint and target superpoint.
        overlap: (S, T) share of each source patch that the true pose lays on each target patch.
        least: overlap that counts, exclusive.
    """
    matches = np.asarray(matches, dtype=np.int64).reshape(-1, 2)
    if len(matches) == 0:
        return 0.0
    return float(np.mean(np.asarray(overlap)[matches[:, 0], matches[:, 1]] > least))
