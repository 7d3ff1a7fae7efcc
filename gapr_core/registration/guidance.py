"""Where to look next: the patch of the bone that makes the pose most precise and excludes its rivals.

A look at a patch of m points has residual Jacobians J, white noise of variance s^2 and a bias of variance b^2 that all
its points share. It adds the Fisher information J^T (s^2 I + b^2 1 1^T)^-1 J to the inverse covariance C^-1 of the pose
(Sherman and Morrison 1950 for the inverse). A patch is ranked by the 95 % bound of the error over the bone that then
remains. Every rival pose that the look would not exclude adds its own distance, weighted with its probability.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gapr_core.geometry import sampling, se3
from gapr_core.geometry.twists import bound_mm, distance_jacobian
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.fit.refinement import distances_mm
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.results import Guidance, Hypothesis, Patch

Array = NDArray[np.float64]
Patches = dict[int, NDArray[np.int64]]  # indices of a patch's target points, by that of its centre

PATCH_MM, PATCHES = 30.0, 250  # diameter of a patch, and number of patches
LOOK_POINTS, NOISE_MM, BIAS_MM = 60, 0.5, 0.7  # of a look: points, least white noise, least shared bias
SEEN_MM = 6.0  # a target point with a source point this near counts as seen
MOST_RIVALS = 50  # likeliest other poses
FACING_COS = 0.3  # least cosine between the normals of a patch and of its centre
SEEN_SHARE = 0.5  # of a patch, from which it counts as seen


def guide(assessment: Assessment) -> Guidance | None:
    """Rank patches of the target by the gain of a look there; None where the source covers the whole bone."""
    target = assessment.target
    rivals = sorted(assessment.hypotheses[1:], key=lambda rival: -rival.probability)[:MOST_RIVALS]
    patches = _unseen(_patches(target), assessment)
    if not patches:
        return None
    noise_mm = max(assessment.fit.sigma_mm, NOISE_MM)
    bias_mm = max(assessment.uncertainty.bias_mm, BIAS_MM)
    bounds = _bounds_mm(assessment, patches, LOOK_POINTS, noise_mm, bias_mm)
    now_mm2, left_mm2, share = _of_rivals(assessment, rivals, patches, noise_mm, bias_mm)
    now_mm = float(np.sqrt(assessment.tre95_mm**2 + now_mm2))
    after_mm = np.sqrt(bounds**2 + left_mm2)
    order = np.argsort(after_mm, kind="stable")
    points, normals = target.points[list(patches)], target.normals[list(patches)]  # copies
    ranked = tuple(
        Patch(points[k], normals[k], float(bounds[k]), float(share[k]), now_mm - float(after_mm[k])) for k in order
    )
    gain_mm = _spread(target, patches, now_mm - after_mm)
    return Guidance(target.points.copy(), gain_mm, now_mm, ranked, PATCH_MM)


def information(J: Array, points: int, noise_mm: float, bias_mm: float) -> Array:
    """Compute the (..., 6, 6) Fisher information of a look at patches.

    Args:
        J: (..., n, 6) Jacobians of the residuals at places spread over a patch.
        points: m, number of points of the look, evenly over these places.
        noise_mm: s, white noise of a point.
        bias_mm: b, standard deviation of the bias that all points share.
    """
    inner = points * np.einsum("...na,...nb->...ab", J, J) / J.shape[-2]
    total = points * J.mean(axis=-2)
    common = bias_mm**2 / (noise_mm**2 * (noise_mm**2 + points * bias_mm**2))
    return np.asarray(inner / noise_mm**2 - common * total[..., :, None] * total[..., None, :])


def _patches(target: PreparedTarget) -> Patches:
    """Cut balls around evenly spread points, without points that face away from the centre's normal."""
    centres = sampling.thin(target.points, PATCHES)
    balls = target.tree.query_ball_point(target.points[centres], PATCH_MM / 2.0)
    facing = (np.array(ball)[target.normals[ball] @ target.normals[i] > FACING_COS]
              for i, ball in zip(centres, balls, strict=True))  # fmt: skip
    return dict(zip(centres.tolist(), facing, strict=True))


def _unseen(patches: Patches, assessment: Assessment) -> Patches:
    """Select the patches of which the source shows less than half."""
    fit = assessment.fit.full_fit
    seen = fit.moved[fit.counts]
    if not len(seen):
        return patches
    surface = assessment.target.elements[:, :3]  # farther out by the stand-off
    near = cKDTree(seen).query(surface)[0] < SEEN_MM
    return {centre: members for centre, members in patches.items() if near[members].mean() < SEEN_SHARE}


def _bounds_mm(assessment: Assessment, patches: Patches, points: int, noise_mm: float, bias_mm: float) -> Array:
    """Compute (K,) 95 % bounds of the error over the bone after a look of `points` points at each patch."""
    target, centre = assessment.target, assessment.centre_mm
    known, anchors = np.linalg.inv(assessment.uncertainty.covariance), target.points[target.anchors]
    over_all = assessment.tre95_mm / assessment.bound_mm(anchors)  # the anchors represent the bone
    bounds = []
    for members in patches.values():
        J = distance_jacobian(target.points[members], target.normals[members], centre)
        covariance = np.asarray(np.linalg.inv(known + information(J, points, noise_mm, bias_mm)), np.float64)
        bounds.append(over_all * assessment.factor95 * bound_mm(covariance, anchors, centre))
    return np.array(bounds)


def _of_rivals(
    assessment: Assessment, rivals: Sequence[Hypothesis], patches: Patches, noise_mm: float, bias_mm: float
) -> tuple[float, Array, Array]:
    """Compute the rivals' part of the squared bound, mm^2, now and (K,) after each look; (K,) excluded shares."""
    if not rivals:
        return 0.0, np.zeros(len(patches)), np.ones(len(patches))
    target, best = assessment.target, assessment.hypotheses[0]
    seen_at = target.elements[:, :3]  # farther out by the stand-off, as in `distances_mm`
    in_source = se3.apply(se3.inverse(best.T_target_source), seen_at)
    distances = np.array([_apart_mm(best, rival, target) for rival in rivals])
    weights = np.array([rival.probability for rival in rivals])
    variance = noise_mm**2 + bias_mm**2
    excluded = np.array([_excluded(in_source[members], rivals, target, variance) for members in patches.values()])
    left_mm2 = (weights * distances**2) @ (1.0 - excluded).T
    return float(weights @ distances**2), left_mm2, excluded @ weights / max(float(weights.sum()), 1e-12)


def _apart_mm(best: Hypothesis, rival: Hypothesis, target: PreparedTarget) -> float:
    """Measure the root-mean-square distance over the bone between its places under two hypotheses."""
    motion = best.T_target_source @ se3.inverse(rival.T_target_source)
    return se3.rms_apart_mm(np.eye(4), motion, target.points[target.anchors])


def _excluded(patch: Array, rivals: Sequence[Hypothesis], target: PreparedTarget, variance: float) -> Array:
    """Compute the (R,) share of each rival's probability that a look at the patch excludes.

    Under a rival the patch (n, 3), by the best pose in the source's frame, lies d off the surface. Its likelihood falls
    by exp(-d^2 / 2 (s^2 + b^2)); `variance` is s^2 + b^2, mm^2. A slide along the surface is never excluded.
    """
    off = [distances_mm(rival.T_target_source, patch, target) for rival in rivals]
    return np.array([1.0 - np.exp(-0.5 * (d**2).mean() / variance) for d in off])


def _spread(target: PreparedTarget, patches: Patches, gain: Array) -> Array:
    """Spread the gain to every target point (M,): that of the nearest patch; 0 outside of all patches."""
    distance, nearest = cKDTree(target.points[list(patches)]).query(target.points)
    inside = np.zeros(len(target.points), dtype=bool)
    inside[np.concatenate(list(patches.values()))] = True
    return np.where(inside, np.maximum(gain[nearest], 0.0), 0.0)
