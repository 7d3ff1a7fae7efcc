"""The paper's way from correspondences to a pose: RANSAC, then refits by Tukey's weights."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapr_core.geometry import se3
from gapr_core.registration.proposals.consensus import Correspondences, batched_kabsch, converge

Array = NDArray[np.float64]

SHRINKING = (2.0, 1.5, 1.0, 0.7)  # successive radii of `sharpened`, over `radius_mm`
ROUNDS = 5  # fits with each radius


def ransac(
    found: Correspondences, radius_mm: float, rng: np.random.Generator, draws: int = 2000, count: int = 32
) -> Array:
    """Fit poses to random triples of correspondences (Fischler and Bolles 1981), drawn by score, with equal sides.

    Args and returns: as `local_to_global`; `draws` triples are tried.
    """
    if len(found.score) < 3:
        return np.empty((0, 4, 4))
    triples = rng.choice(len(found.score), (draws, 3), p=found.score / found.score.sum())
    p, q = found.source[triples], found.target[triples]
    sides_p, sides_q = (np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2) for x in (p, q))
    rigid = (np.abs(sides_p - sides_q) < 2.0 * radius_mm).all(axis=1) & (sides_p > 2.0 * radius_mm).all(axis=1)
    return converge(se3.kabsch(p[rigid], q[rigid]), found, radius_mm, count)


def sharpened(pose: Array, found: Correspondences, radius_mm: float) -> Array:
    """Refit a pose (4, 4) to the correspondences near it by Tukey's weights, within a radius that shrinks.

    A correspondence within `radius_mm` can be that far off. Those of a pose that is nearly right agree better.
    """
    for within_mm in radius_mm * np.repeat(SHRINKING, ROUNDS):
        squared = ((se3.apply(pose, found.source) - found.target) ** 2).sum(axis=1)
        weights = found.score * np.maximum(1.0 - squared / within_mm**2, 0.0) ** 2
        if np.count_nonzero(weights) < 3:
            break
        pose = batched_kabsch(found, weights[None])[0]
    return pose
