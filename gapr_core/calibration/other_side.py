"""The pose of a mirrored bone on the bone itself, for bones that are their own mirror image."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gapr_core.data.specimen import Specimen
from gapr_core.geometry import extent, se3

Array = NDArray[np.float64]
POINTS, ROUNDS = 1200, 30
MODEL_POINTS = 6000


def on_own_side(mirrored: Specimen, specimen: Specimen) -> Array:
    """Lay a mirrored bone on the bone by trimmed ICP from all turns of its main axes: (4, 4), mm."""
    rng = np.random.default_rng(0)
    moving, fixed = mirrored.sample(POINTS, rng)[0], specimen.sample(MODEL_POINTS, rng)[0]
    tree = cKDTree(fixed)
    fits = [_icp(start, moving, fixed, tree) for start in _turns(moving, fixed)]
    return min(fits, key=lambda each: each[1])[0]


def _turns(moving: Array, fixed: Array) -> list[Array]:
    """Compute the four rotations (4, 4) that lay the principal axes of one on those of the other."""
    of_moving, of_fixed = (extent.principal(points).axes.T for points in (moving, fixed))
    turns = [of_fixed @ np.diag(signs) @ of_moving.T for signs in product((1.0, -1.0), repeat=3)]
    rotations = [turn for turn in turns if np.linalg.det(turn) > 0.0]
    shifts = [fixed.mean(axis=0) - turn @ moving.mean(axis=0) for turn in rotations]
    return [se3.from_rotation_translation(*each) for each in zip(rotations, shifts, strict=True)]


def _icp(T: Array, moving: Array, fixed: Array, tree: cKDTree) -> tuple[Array, float]:
    """Refine a pose; returns it and the root mean square of the nearer 90 % of the distances, mm."""
    for _ in range(ROUNDS):
        gaps, nearest = tree.query(se3.apply(T, moving))
        near = gaps <= np.quantile(gaps, 0.9)
        T = se3.kabsch(moving[near], fixed[nearest[near]])
    return T, float(np.sqrt((gaps[near] ** 2).mean()))
