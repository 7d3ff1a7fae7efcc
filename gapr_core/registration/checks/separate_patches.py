"""Does one of the separate patches of a source lie off the bone? Then the others fit far better without it.

A pointer or a probe shows a bone in a few places, such as the two spines and the symphysis of a pelvis. Where one of
them is muscle fascia or skin, the pose tilts until all nearly fit, since few patches hardly determine it more than
once: the residuals stay small, and a smooth bias explains what is left. So each patch is left out in turn.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from gapr_core.config import RegistrarConfig
from gapr_core.geometry import sampling, se3
from gapr_core.geometry.twists import error_twist
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.fit.refinement import refine_fully

Array = NDArray[np.float64]

NAME = "patch_off"
GAP_MM, GRAIN_MM = 12.0, 3.0  # between two patches, as seen by one point of each voxel
FEWEST_PATCHES, FEWEST_POINTS, LEAST_SHARE = 3, 20, 0.05  # that are left out in turn; of each: points, and of all
FALLS_TO = 0.65  # of the residuals' scale: a patch off the bone by 3 to 9 mm, found on pelves of train and val subjects
MOVES_MM = 2.0  # root mean square over the bone


def allowing_for_a_patch(assessment: Assessment, config: RegistrarConfig) -> Assessment:
    """The same; where one patch speaks against all others, with what the pose moves by without it in its covariance.

    Which of them is right nobody knows, so the answer is not sure (`limits`). Of two patches none can be named. A scene
    is not asked: its parts that are no bone are left out already.
    """
    a = assessment
    if a.seen is not None:
        return a
    points = np.ascontiguousarray(a.source.points)
    patch = patches(points)
    numbers = range(patch.max() + 1)
    if len(numbers) < FEWEST_PATCHES:
        return a
    whole = refine_fully(a.fit.T, points, a.target, config.refinement)
    fits = [
        refine_fully(whole.T, np.ascontiguousarray(points[patch != k]), a.target, config.refinement) for k in numbers
    ]
    without = min(fits, key=lambda fit: fit.sigma_mm)
    moved_mm = se3.rms_apart_mm(without.T @ se3.inverse(whole.T), np.eye(4), a.target.points)
    if without.sigma_mm >= FALLS_TO * whole.sigma_mm or moved_mm <= MOVES_MM:
        return a
    twist = error_twist(without.T, whole.T, points)
    uncertainty = a.uncertainty.with_more(np.outer(twist, twist))
    return replace(a, uncertainty=uncertainty, deformed={NAME: moved_mm, **a.deformed})


def patches(points: Array) -> NDArray[np.int64]:
    """(N,) number of the patch that each point (N, 3), mm, is of: 0 and on, the largest first; -1 for small ones.

    Points nearer than `GAP_MM` to each other are of one patch.
    """
    some = sampling.voxel_indices(points, GRAIN_MM)
    tree = cKDTree(points[some])
    near = tree.query_pairs(GAP_MM, output_type="ndarray")
    joined = csr_array((np.ones(len(near)), (near[:, 0], near[:, 1])), shape=2 * (len(some),))
    _, of_some = connected_components(joined, directed=False)
    found = of_some[tree.query(points)[1]]
    counts = np.bincount(found)
    large = [
        k for k in np.argsort(-counts, kind="stable") if counts[k] >= max(FEWEST_POINTS, LEAST_SHARE * len(points))
    ]
    number = np.full(len(counts), -1)
    number[large] = np.arange(len(large))
    return np.asarray(number[found])
