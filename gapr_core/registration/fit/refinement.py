"""Robust point-to-surface refinement: many poses coarsely, a few to the end.

Point-to-plane (Chen and Medioni 1992) with second-order surface elements and Tukey's biweight at a scale that follows
the residuals. The offset that noise causes on curved surfaces is subtracted (see `kernels`). In the end elements that
fit their surroundings badly weigh less, and a patch of the source that is off as a whole weighs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gapr_core.config import RefinementConfig, SourceConfig
from gapr_core.geometry import se3
from gapr_core.geometry.twists import distance_jacobian
from gapr_core.registration.fit import kernels
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.runtime.parallel import in_pieces

Array = NDArray[np.float64]

SD_OF_MEDIAN = 1.4826  # standard deviation of normal residuals over the median of their absolute values
FAR_SIGMAS = 3.0  # standard deviations beyond which lie outliers, or noise with a long tail
WORTH_A_THREAD = 100_000  # points moved, some 3 ms: below, a second thread costs more than it saves
PATCH_POINTS = SourceConfig().normal_neighbours  # of an unprepared source


@dataclass(frozen=True, eq=False)
class Fit:
    """A pose and the residuals of the source on the target under it."""

    T: Array  # (4, 4) T_target_source, mm
    sigma_mm: float  # robust standard deviation of the residuals
    signed_mm: Array  # (N,) signed distances to the surface, NaN where none is near
    weights: Array  # (N,) weights of the points in the normal equations, 0 for outliers
    gradients: Array  # (N, 3) unit surface normals at the foot points, target frame
    moved: Array  # (N, 3) source points in the target frame
    bias_mm: float = 0.0  # standard deviation of the smooth bias that the pose is corrected for; 0: least squares
    whole: Fit | None = None  # the same pose with all points of the source; None where all are here

    @property
    def full_fit(self) -> Fit:
        """Fit of the same pose with all points of the source."""
        return self.whole or self

    @cached_property
    def counts(self) -> NDArray[np.bool_]:
        """(N,) mask of the points that count for the pose: all but outliers."""
        return self.weights > 0.0

    @cached_property
    def jacobian(self) -> Array:
        """(N, 6) derivative of the residuals by x y z rx ry rz about the moved source's centroid."""
        return distance_jacobian(self.moved, self.gradients, self.moved.mean(axis=0))

    @cached_property
    def feet(self) -> Array:
        """(N, 3) foot points on the surface, target frame; the points themselves where no surface is near."""
        return self.moved - np.nan_to_num(self.signed_mm)[:, None] * self.gradients


def refine_many(
    poses: Array, points: Array, target: PreparedTarget, limits_mm: Array, num_threads: int = 0
) -> tuple[Array, Array]:
    """Iterate Gauss-Newton from every pose on the same few source points.

    Args:
        poses: (K, 4, 4) T_target_source, mm.
        points: (N, 3) source points, mm.
        target: the prepared target.
        limits_mm: (iterations,) scale of Tukey's biweight in each iteration, mm, usually falling.
        num_threads: 0 for all cores.

    Returns:
        (K, 4, 4) refined poses and (K,) mean squared distances truncated at the last limit, mm^2 (small is good).
    """
    variances, trust = np.zeros_like(limits_mm), np.ones(len(points))

    def work(piece: Array) -> tuple[Array, Array]:
        return kernels.refine_batch(piece, points, trust, *target.kernel_view, limits_mm, variances, True)

    is_little = len(poses) * len(points) * len(limits_mm) < WORTH_A_THREAD
    pieces = in_pieces(work, np.ascontiguousarray(poses), 1 if is_little else num_threads)
    refined, scores = zip(*pieces, strict=True)
    return np.concatenate(refined), np.concatenate(scores)


def refine_fully(
    T: Array,
    points: Array,
    target: PreparedTarget,
    config: RefinementConfig,
    neighbours: NDArray[np.int64] | None = None,
) -> Fit:
    """Refine one pose on all points until it converges; the scale of the weights follows the residuals.

    Args:
        T: (4, 4) T_target_source within the basin, mm.
        points: (N, 3) source points, mm.
        target: the prepared target.
        config: iterations and scales.
        neighbours: (N, k) patch of each point, itself included (`PreparedSource.neighbours`); looked up when None.
    """
    if neighbours is None:
        neighbours = cKDTree(points).query(points, k=list(range(1, min(PATCH_POINTS, len(points)) + 1)))[1]
    fit = evaluate(T, points, target, config)
    for number in range(config.rounds):
        trust = patch_trust(fit, neighbours, config) if number >= config.free_rounds else np.ones(len(points))
        limits = np.full(config.iterations, tukey_limit(fit.signed_mm, fit.sigma_mm, config))
        variances = np.full_like(limits, fit.sigma_mm**2)
        poses, _ = kernels.refine_batch(fit.T[None], points, trust, *target.kernel_view, limits, variances, False)
        step = se3.apply(poses[0], points) - fit.moved
        fit = evaluate(poses[0], points, target, config)
        if number >= config.free_rounds and np.abs(step).max() < config.rest_mm:
            break
    return evaluate_with_patches(fit.T, points, target, config, neighbours)


def rest_on_whole(fit: Fit, source: PreparedSource, target: PreparedTarget, config: RefinementConfig) -> Fit:
    """Move the fit of some points of a source to where all its points fit best: their noise averages out."""
    if not source.is_part:
        return fit
    limits = np.full(config.iterations, tukey_limit(fit.signed_mm, fit.sigma_mm, config))
    variances, trust = np.full_like(limits, fit.sigma_mm**2), trust_of_whole(fit, source, config)
    poses, _ = kernels.refine_batch(fit.T[None], source.whole, trust, *target.kernel_view, limits, variances, False)
    some = evaluate_with_patches(poses[0], source.points, target, config, source.neighbours)
    return replace(some, whole=evaluate_trusted(poses[0], source.whole, target, config, trust))


def trust_of_whole(fit: Fit, source: PreparedSource, config: RefinementConfig) -> Array:
    """Average `patch_trust` over the patches of each point of the whole source; (M,), 0 for a point in none."""
    trust = patch_trust(fit, source.neighbours, config)
    points, count = source.patches.ravel(), len(source.whole)
    total = np.bincount(points, np.repeat(trust, source.patches.shape[1]), count)
    return np.asarray(total / np.maximum(np.bincount(points, minlength=count), 1))


def distances_mm(T: Array, points: Array, target: PreparedTarget) -> Array:
    """Measure (N,) distances of points (N, 3) to the surface under a pose; infinite without a near one."""
    signed, _, aside, _ = kernels.residuals_at(T, points, *target.kernel_view, 0.0)
    return np.hypot(np.nan_to_num(signed, nan=np.inf), aside)


def evaluate(T: Array, points: Array, target: PreparedTarget, config: RefinementConfig) -> Fit:
    """Compute residuals, scale and weights of a pose as it is; every patch is trusted."""
    signed, *_ = kernels.residuals_at(T, points, *target.kernel_view, 0.0)
    sigma_mm = _robust_sigma(signed, config)
    limit_mm = tukey_limit(signed, sigma_mm, config)
    signed, gradients, aside, elements = kernels.residuals_at(T, points, *target.kernel_view, sigma_mm**2)
    weights = np.maximum(1.0 - (signed * signed + aside * aside) / (limit_mm * limit_mm), 0.0) ** 2
    weights *= sigma_mm**2 / (sigma_mm**2 + target.elements[elements, -1])
    weights[elements < 0] = 0.0
    return Fit(T, sigma_mm, signed, weights, gradients, se3.apply(T, points))


def evaluate_trusted(T: Array, points: Array, target: PreparedTarget, config: RefinementConfig, trust: Array) -> Fit:
    """Evaluate a pose, made exactly rigid, with a known trust (N,) of the points in the weights."""
    fit = evaluate(se3.nearest_rigid(T), points, target, config)
    return replace(fit, weights=fit.weights * trust)


def evaluate_with_patches(
    T: Array, points: Array, target: PreparedTarget, config: RefinementConfig, neighbours: NDArray[np.int64]
) -> Fit:
    """Evaluate a pose, made exactly rigid, with the patches' trust in the weights."""
    fit = evaluate(se3.nearest_rigid(T), points, target, config)
    return replace(fit, weights=fit.weights * patch_trust(fit, neighbours, config))


def patch_trust(fit: Fit, neighbours: NDArray[np.int64], config: RefinementConfig) -> Array:
    """Compute (N,) Tukey weights of the patches' mean residuals, whose scale is their own median.

    The mean shows a patch that soft tissue takes off the surface by less than the noise of its points.
    """
    means = kernels.patch_means(fit.signed_mm, fit.weights, neighbours)
    by_noise = fit.sigma_mm / np.sqrt(neighbours.shape[1])
    limit_mm = config.patch_scale * max(SD_OF_MEDIAN * _median_size(means), by_noise)
    return np.clip(1.0 - (means / limit_mm) ** 2, 0.0, 1.0) ** 2


def _robust_sigma(signed: Array, config: RefinementConfig) -> float:
    """Compute the scale from the median absolute residual, within the limits; NaN residuals count as large."""
    spread = SD_OF_MEDIAN * _median_size(signed)
    return min(max(spread, config.smallest_sigma_mm), config.largest_sigma_mm)


def _median_size(residuals: Array) -> float:
    """Compute the median of the absolute values of (N,) residuals; NaN counts as infinitely large."""
    sizes = np.abs(residuals)
    sizes[np.isnan(sizes)] = np.inf
    middle = [(len(sizes) - 1) // 2, len(sizes) // 2]
    return float(np.partition(sizes, middle)[middle].mean())  # as `np.median`, which takes three times as long


def tukey_limit(signed: Array, sigma_mm: float, config: RefinementConfig) -> float:
    """Choose the end of Tukey's weight, mm: farther out, so more efficient, where almost no residual is beyond."""
    beyond = (~(np.abs(signed) <= FAR_SIGMAS * sigma_mm)).mean()  # NaN is beyond
    return float(sigma_mm * (config.clean_tukey_scale if beyond < config.clean_share else config.tukey_scale))
