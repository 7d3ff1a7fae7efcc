"""Where to look next: which patch of the bone would make the answer most precise and exclude the rivals.

A look at a patch of m points with residual Jacobians J, white noise of variance s^2 and a bias of variance b^2 that is
common to the patch adds the Fisher information J^T (s^2 I + b^2 1 1^T)^-1 J to the inverse covariance C^-1 of the pose
(Sherman and Morrison 1950 for the inverse). What then remains is the 95 % bound of the error over the bone, to which
every rival pose that the look would not exclude adds its own distance, weighted with its probability.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gapr_core.config import GuidanceConfig
from gapr_core.geometry import sampling, se3
from gapr_core.geometry.twists import distance_jacobian
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.fit.refinement import distances_mm
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.uncertainty import target_error as precision
from gapr_core.results import Guidance, Hypothesis, Patch

Array = NDArray[np.float64]

FACING_COS = 0.3  # least cosine between normals of a patch and that of its centre
SEEN_SHARE = 0.5  # of a patch, from which there is nothing new to see


@dataclass(frozen=True, eq=False)
class Patches:
    """Candidate patches of a target.

    Attributes:
        centres: (K,) indices of target points.
        members: for each patch the indices of its target points.
    """

    centres: NDArray[np.int64]
    members: list[NDArray[np.int64]]


def guide(assessment: Assessment, config: GuidanceConfig) -> Guidance | None:
    """Patches of the target ranked by what a look there would gain; None where the whole bone was seen.

    Args:
        assessment: the best pose so far, its covariance and its rivals.
        config: size of a patch, points and bias of a look.
    """
    target = assessment.target
    rivals = sorted(assessment.hypotheses[1:], key=lambda rival: -rival.probability)[: config.rivals]
    patches = _unseen(_patches(target, config), assessment, config)
    if not len(patches.centres):
        return None
    noise_mm = max(assessment.fit.sigma_mm, config.noise_mm)
    bias_mm = max(assessment.uncertainty.bias_mm, config.bias_mm)
    bounds = _bounds_mm(assessment, patches, config.points, noise_mm, bias_mm)
    now_mm2, left_mm2, share = _of_rivals(assessment, rivals, patches, noise_mm, bias_mm)
    now_mm = float(np.sqrt(assessment.tre95_mm**2 + now_mm2))
    after_mm = np.sqrt(bounds**2 + left_mm2)
    order = np.argsort(after_mm, kind="stable")
    points, normals = target.points[patches.centres], target.normals[patches.centres]  # copies
    ranked = tuple(
        Patch(points[k], normals[k], float(bounds[k]), float(share[k]), now_mm - float(after_mm[k])) for k in order
    )
    gain_mm = _spread(target, patches, now_mm - after_mm)
    return Guidance(target.points.copy(), gain_mm, now_mm, ranked, config.patch_mm)


def information(J: Array, points: int, noise_mm: float, bias_mm: float) -> Array:
    """(..., 6, 6) Fisher information of a look at patches.

    Args:
        J: (..., n, 6) Jacobians of the residuals at places spread over a patch.
        points: m, how many points the look gives, evenly over these places.
        noise_mm: s, white noise of a point.
        bias_mm: b, standard deviation of the bias that all of them share.
    """
    inner = points * np.einsum("...na,...nb->...ab", J, J) / J.shape[-2]
    total = points * J.mean(axis=-2)
    common = bias_mm**2 / (noise_mm**2 * (noise_mm**2 + points * bias_mm**2))
    return np.asarray(inner / noise_mm**2 - common * total[..., :, None] * total[..., None, :])


def _patches(target: PreparedTarget, config: GuidanceConfig) -> Patches:
    """Balls around evenly spread points, less what faces another way than the centre."""
    centres = sampling.thin(target.points, config.patches)
    balls = target.tree.query_ball_point(target.points[centres], config.patch_mm / 2.0)
    members = [np.array(ball)[target.normals[ball] @ target.normals[i] > FACING_COS]
               for i, ball in zip(centres, balls, strict=True)]  # fmt: skip
    return Patches(centres, members)


def _unseen(patches: Patches, assessment: Assessment, config: GuidanceConfig) -> Patches:
    """Those of which the source shows less than half."""
    fit = assessment.fit.rests_on
    seen = fit.moved[fit.weights > 0.0]
    if not len(seen):
        return patches
    surface = assessment.target.elements[:, :3]  # where a sensor with a stand-off sees the bone
    near = cKDTree(seen).query(surface)[0] < config.seen_mm
    kept = [k for k, members in enumerate(patches.members) if near[members].mean() < SEEN_SHARE]
    return Patches(patches.centres[kept], [patches.members[k] for k in kept])


def _bounds_mm(assessment: Assessment, patches: Patches, points: int, noise_mm: float, bias_mm: float) -> Array:
    """(K,) 95 % bound of the error over the bone after a look of so many points at each patch."""
    target, centre = assessment.target, assessment.centre_mm
    known, anchors = np.linalg.inv(assessment.uncertainty.covariance), target.points[target.anchors]
    over_all = assessment.tre95_mm / assessment.bound_mm(anchors)  # a few points stand for the bone
    bounds = []
    for members in patches.members:
        J = distance_jacobian(target.points[members], target.normals[members], centre)
        covariance = np.asarray(np.linalg.inv(known + information(J, points, noise_mm, bias_mm)), np.float64)
        bounds.append(over_all * assessment.factor95 * precision.bound_mm(covariance, anchors, centre))
    return np.array(bounds)


def _of_rivals(
    assessment: Assessment, rivals: Sequence[Hypothesis], patches: Patches, noise_mm: float, bias_mm: float
) -> tuple[float, Array, Array]:
    """What rivals add to the squared bound, mm^2, now and (K,) after a look at each patch; (K,) share it excludes."""
    if not rivals:
        return 0.0, np.zeros(len(patches.centres)), np.ones(len(patches.centres))
    target, best = assessment.target, assessment.hypotheses[0]
    seen_at = target.elements[:, :3]  # where a sensor with a stand-off sees the bone, as in `distances_mm`
    in_source = se3.apply(se3.inverse(best.T_target_source), seen_at)
    distances = np.array([_apart_mm(best, rival, target) for rival in rivals])
    weights = np.array([rival.probability for rival in rivals])
    variance = noise_mm**2 + bias_mm**2
    excluded = np.array([_excluded(in_source[members], rivals, target, variance) for members in patches.members])
    left_mm2 = (weights * distances**2) @ (1.0 - excluded).T
    return float(weights @ distances**2), left_mm2, excluded @ weights / max(float(weights.sum()), 1e-12)


def _apart_mm(best: Hypothesis, rival: Hypothesis, target: PreparedTarget) -> float:
    """Root-mean-square distance over the bone between where two hypotheses put it."""
    motion = best.T_target_source @ se3.inverse(rival.T_target_source)
    return se3.rms_apart_mm(np.eye(4), motion, target.points[target.anchors])


def _excluded(patch: Array, rivals: Sequence[Hypothesis], target: PreparedTarget, variance: float) -> Array:
    """(R,) share of each rival's probability that a look at the patch would take.

    Under a rival the patch (n, 3), by the best pose in the source's frame, lies d off the surface; its likelihood falls
    by exp(-d^2 / 2 (s^2 + b^2)), with that variance, mm^2. What slides along the surface tells nothing, however far.
    """
    off = [distances_mm(rival.T_target_source, patch, target) for rival in rivals]
    return np.array([1.0 - np.exp(-0.5 * (d**2).mean() / variance) for d in off])


def _spread(target: PreparedTarget, patches: Patches, gain: Array) -> Array:
    """(M,) the gain at every target point: that of the nearest patch; 0 for what was seen."""
    distance, nearest = cKDTree(target.points[patches.centres]).query(target.points)
    inside = np.zeros(len(target.points), dtype=bool)
    inside[np.concatenate(patches.members)] = True
    return np.where(inside, np.maximum(gain[nearest], 0.0), 0.0)
