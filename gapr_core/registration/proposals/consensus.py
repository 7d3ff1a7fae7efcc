"""Poses from correspondences: consensus per patch (local to global), with several answers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numba
import numpy as np
from numpy.typing import NDArray

from gapr_core.geometry import se3

Array = NDArray[np.float64]

REFITS = 4  # of a pose to the correspondences that agree with it
APART_MM, APART_DEG = 8.0, 8.0  # poses within both are the same


@dataclass(frozen=True)
class Correspondences:
    """Point pairs that may belong together."""

    source: Array  # (C, 3), mm
    target: Array  # (C, 3), mm
    score: Array  # (C,) positive weights
    patch: NDArray[np.int64]  # (C,) correspondences of one patch pair share a number

    @cached_property
    def products(self) -> Array:
        """(C, 9) outer products of each pair, the terms of a weighted covariance."""
        return (self.source[:, :, None] * self.target[:, None, :]).reshape(-1, 9)


def local_to_global(found: Correspondences, radius_mm: float, count: int = 32) -> Array:
    """Fit a pose per patch pair by weighted SVD, score all, and refine on inliers (GeoTransformer's LGR).

    Args:
        found: the correspondences.
        radius_mm: distance up to which a correspondence agrees with a pose.
        count: most poses returned.

    Returns:
        (K, 4, 4) distinct T_target_source, mm; first the one whose agreeing correspondences score most.
    """
    patches = np.unique(found.patch, return_counts=True)
    large = patches[0][patches[1] >= 3]
    members = (found.patch[None] == large[:, None]) * found.score
    return converge(batched_kabsch(found, members), found, radius_mm, count)


def converge(poses: Array, found: Correspondences, radius_mm: float, count: int) -> Array:
    """Refit the best poses to the correspondences that agree with them, and drop near-copies."""
    if len(poses) == 0:
        return np.empty((0, 4, 4))
    centroid = found.source.mean(axis=0)
    scores = _support(poses, found, radius_mm).sum(axis=1)
    poses = poses[distinct(poses, scores, centroid, 2 * count)]
    for _ in range(REFITS):
        weights = _support(poses, found, radius_mm)
        enough = (weights > 0).sum(axis=1) >= 3
        refitted = batched_kabsch(found, weights)
        poses = np.where(enough[:, None, None], refitted, poses)
    scores = _support(poses, found, radius_mm).sum(axis=1)
    return poses[distinct(poses, scores, centroid, count)]


def distinct(poses: Array, scores: Array, centroid: Array, count: int) -> NDArray[np.int64]:
    """Select up to `count` rows, best first, none within `APART_MM` (centroid) and `APART_DEG` of a better one."""
    order = np.argsort(-scores, kind="stable")
    rotations = np.ascontiguousarray(poses[order, :3, :3])
    places = rotations @ centroid + poses[order, :3, 3]
    trace_limit = 1.0 + 2.0 * np.cos(np.radians(APART_DEG))
    kept: list[int] = []
    left = np.arange(len(order))
    while len(left) and len(kept) < count:
        best, left = left[0], left[1:]
        kept.append(best)
        shift = np.linalg.norm(places[left] - places[best], axis=1)
        trace = np.einsum("kij,ij->k", rotations[left], rotations[best])
        left = left[~((shift < APART_MM) & (trace > trace_limit))]
    return order[kept]


def _support(poses: Array, found: Correspondences, radius_mm: float) -> Array:
    """Compute (K, C) scores: that of every correspondence that agrees with a pose, else 0."""
    columns = np.ascontiguousarray(found.source.T), np.ascontiguousarray(found.target.T)
    return _agreeing(np.ascontiguousarray(poses), *columns, found.score, radius_mm**2)


@numba.njit(cache=True, nogil=True)
def _agreeing(poses, source, target, score, limit):  # type: ignore[no-untyped-def]
    """Compute `_support` of the columns (3, C) of both clouds: compilers vectorise the inner loop."""
    weights = np.empty((len(poses), len(score)))
    for k in range(len(poses)):
        T = poses[k]
        for c in range(len(score)):
            squared = 0.0
            for i in range(3):
                moved = T[i, 0] * source[0, c] + T[i, 1] * source[1, c] + T[i, 2] * source[2, c] + T[i, 3]
                squared += (moved - target[i, c]) ** 2
            weights[k, c] = score[c] if squared < limit else 0.0
    return weights


def batched_kabsch(found: Correspondences, weights: Array) -> Array:
    """Fit poses to all correspondences under each row of weights (K, C), by SVD."""
    total = np.maximum(weights.sum(axis=1), 1e-12)[:, None]
    p_mean, q_mean = weights @ found.source / total, weights @ found.target / total
    covariance = (weights @ found.products / total).reshape(-1, 3, 3) - p_mean[:, :, None] * q_mean[:, None]
    return se3.fitting(covariance, p_mean, q_mean)
