"""How uncertain a refined pose is, under noise and under the smooth bias that probes and segmentations have.

The weighted least-squares pose reacts to residuals e by H^-1 J^T W e. With independent noise of variance s^2 and a
smooth bias of variance b^2 and correlation exp(-d^2 / 2 l^2), its covariance is the sandwich
H^-1 J^T W (s^2 I + b^2 K) W J H^-1 (White 1980; Censi 2007 for the noise alone). A Hessian alone is over-confident.
A weak prior is in H and in the noise: a motion of which nothing was observed has the prior's variance, not none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from gapr_core.config import CovarianceConfig
from gapr_core.metrics.uncertainty import predicted_rmse_mm
from gapr_core.refinement import Fit

Array = NDArray[np.float64]

AXES = ("x", "y", "z")
POSE_PRIOR = np.diag([1e-6] * 3 + [1e-3] * 3)  # information of an unobserved motion, in units of 1 / noise variance


@dataclass(frozen=True, eq=False)
class PoseUncertainty:
    """Covariance of a pose, and what follows from it.

    Attributes:
        covariance: (6, 6), x y z (mm) rx ry rz (rad), fixed target axes, about the moved source's centroid.
        bias_mm: standard deviation of the smooth bias that the covariance reckons with.
        smooth_mm: the smooth misfit that the residuals show (see `smooth_misfits_mm`).
        short_mm: the same at a shorter range, which also holds what is rougher: another bone's surface.
        weakest_turn: (3,) unit axis, target frame, about which the rotation is least certain.
        weakest_shift: (3,) unit direction, target frame, along which the position is least certain.
    """

    covariance: Array
    bias_mm: float
    smooth_mm: float
    short_mm: float
    weakest_turn: Array
    weakest_shift: Array

    @property
    def largest_shift_mm(self) -> float:
        """Standard deviation along the least certain direction, mm."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))

    @property
    def largest_turn_deg(self) -> float:
        """Standard deviation about the least certain axis, deg."""
        return float(np.degrees(np.sqrt(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1])))

    def tre_mm(self, points: Array, centroid: Array) -> float:
        """Predicted root-mean-square error over (M, 3) target points: the trace of J Sigma J^T (Fitzpatrick 1998)."""
        return predicted_rmse_mm(self.covariance, points, centroid)


def estimate(fit: Fit, config: CovarianceConfig) -> PoseUncertainty:
    """Covariance of a fit from its residuals; always symmetric and positive definite."""
    J, w = fit.jacobian, fit.weights
    H = (J * w[:, None]).T @ J + POSE_PRIOR
    noise = fit.sigma_mm**2 * ((J * (w**2)[:, None]).T @ J + POSE_PRIOR)
    smooth_mm, short_mm = smooth_misfits_mm(fit, (config.smooth_neighbours, config.short_neighbours))
    bias_mm = np.hypot(config.bias_floor_mm, config.bias_gain * smooth_mm)
    H_inverse = np.linalg.inv(H)
    covariance = H_inverse @ (noise + bias_mm**2 * _correlated(fit, config)) @ H_inverse
    covariance = 0.5 * (covariance + covariance.T) + np.diag([1e-6] * 3 + [1e-10] * 3)
    weakest = _largest_axis(covariance[3:, 3:]), _largest_axis(covariance[:3, :3])
    return PoseUncertainty(covariance, float(bias_mm), smooth_mm, short_mm, *weakest)


def smooth_misfits_mm(fit: Fit, neighbours: tuple[int, ...]) -> tuple[float, ...]:
    """Root mean square of the inliers' locally averaged residuals, less what noise leaves in an average.

    Args:
        fit: the residuals.
        neighbours: of how many points an average is taken; a figure for each count.
    """
    inlier = fit.weights > 0.0
    points, signed = fit.moved[inlier], fit.signed_mm[inlier]
    if len(points) <= min(neighbours):
        return (fit.sigma_mm,) * len(neighbours)
    nearest = cKDTree(points).query(points, k=min(max(neighbours), len(points)))[1]

    def misfit_mm(count: int) -> float:
        averages = signed[nearest[:, :count]].mean(axis=1)
        return float(np.sqrt(max((averages**2).mean() - signed.var() / count, 0.0)))

    return tuple(misfit_mm(count) if len(points) > count else fit.sigma_mm for count in neighbours)


def _correlated(fit: Fit, config: CovarianceConfig) -> Array:
    """J^T W K W J of a smooth field, from a regular subset of the inliers scaled to all of them."""
    inlier = np.flatnonzero(fit.weights > 0.0)
    if not len(inlier):
        return np.zeros((6, 6))
    some = inlier[:: max(1, len(inlier) // config.correlation_points)]
    weighted = fit.jacobian[some] * fit.weights[some, None] * (len(inlier) / len(some))
    points = fit.moved[some]
    return np.asarray(weighted.T @ smooth_correlation(points, points, config.correlation_mm) @ weighted)


def smooth_correlation(a: Array, b: Array, length_mm: float) -> Array:
    """(N, M) exp(-d^2 / 2 l^2) between points (N, 3) and (M, 3): how alike a smooth bias is in both."""
    return np.asarray(np.exp(-0.5 * cdist(a, b, "sqeuclidean") / length_mm**2))


def _largest_axis(block: Array) -> Array:
    return np.asarray(np.linalg.eigh(block)[1][:, -1])
