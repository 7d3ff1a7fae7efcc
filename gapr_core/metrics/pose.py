"""Errors of one pose against the truth, and recall over many. All distances in mm, angles in degrees."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from gapr_core.geometry import extent, se3
from gapr_core.geometry.se3 import RIGHT_DEG, RIGHT_MM

Array = NDArray[np.float64]

PAPER_RMSE_LIMIT = 0.02  # of the unit in which the longest edge of the target's box is 2: the paper's section III
STRICT_LIMITS = ((1.0, 1.0), (2.0, 2.0), (RIGHT_MM, RIGHT_DEG))  # mm at the source's centroid, deg


def rmse_mm(T_estimate: ArrayLike, T_true: ArrayLike, source: ArrayLike) -> float:
    """sqrt(mean_i |T_estimate p_i - T_true p_i|^2) over the source (N, 3): the paper's RMSE of one pair."""
    return se3.rms_apart_mm(T_estimate, T_true, source)


def whole_bone_rmse_mm(T_estimate: ArrayLike, T_true: ArrayLike, target: ArrayLike) -> float:
    """Compute the RMSE over the whole target (M, 3), target frame; the fit on the observed patch hides it."""
    return rmse_mm(error_motion(T_estimate, T_true), np.eye(4), target)


def tre_mm(T_estimate: ArrayLike, T_true: ArrayLike, targets: Mapping[str, ArrayLike]) -> dict[str, float]:
    """Target registration error at named points {name: (3,)} of the target frame, mm."""
    motion = error_motion(T_estimate, T_true)
    return {name: rmse_mm(motion, np.eye(4), np.reshape(point, (1, 3))) for name, point in targets.items()}


def extreme_points(target: ArrayLike) -> dict[str, Array]:
    """Six named targets of any bone (M, 3): its farthest points along both directions of its principal axes."""
    points = np.asarray(target, dtype=np.float64)
    axes = extent.principal(points).axes
    axes = axes * np.sign(np.take_along_axis(axes, np.abs(axes).argmax(axis=1)[:, None], axis=1))  # one sign for good
    along = (points - points.mean(axis=0)) @ axes.T
    ends = {f"axis{k + 1}+": points[along[:, k].argmax()] for k in range(3)}
    return ends | {f"axis{k + 1}-": points[along[:, k].argmin()] for k in range(3)}


def error_motion(T_estimate: ArrayLike, T_true: ArrayLike) -> Array:
    """(4, 4) motion of the target frame from where a point is to where the estimate puts it."""
    return np.asarray(T_estimate, dtype=np.float64) @ se3.inverse(T_true)


def within_paper_limit(rmse: float, target: ArrayLike) -> bool:
    """RMSE, mm, below 0.02 of half the longest edge of the box of the target (M, 3), mm."""
    return rmse < PAPER_RMSE_LIMIT * extent.half_edge_mm(np.asarray(target, dtype=np.float64))


def within_extent_limit(rmse: float, target: ArrayLike) -> bool:
    """RMSE, mm, below 0.02 of the half extent of the target (M, 3), mm: 6 to 43 % wider than the paper's limit."""
    return rmse < PAPER_RMSE_LIMIT * extent.half_extent_mm(np.asarray(target, dtype=np.float64))


def recall(successes: ArrayLike) -> float:
    """Share of successes, refusals and failures counted; NaN of nothing."""
    successes = np.asarray(successes, dtype=np.float64)
    return float(successes.mean()) if successes.size else float("nan")


def r2_rotation(T_estimates: ArrayLike, T_trues: ArrayLike) -> float:
    """Compute the paper's R2(R): coefficient of determination of Euler angles (zyx, degrees), mean of the three.

    Angles wrap around at 180 deg, so small errors can cost much: no measure of accuracy (1 deg errors give 0.965).
    """
    return r2(_euler_deg(T_estimates), _euler_deg(T_trues))


def r2_translation(T_estimates: ArrayLike, T_trues: ArrayLike) -> float:
    """Compute the paper's R2(t): coefficient of determination of the translation, mean of the three components."""
    return r2(np.asarray(T_estimates)[:, :3, 3], np.asarray(T_trues)[:, :3, 3])


def r2(predicted: ArrayLike, true: ArrayLike) -> float:
    """1 - residual / total sum of squares per column of (K, D), averaged.

    NaN for fewer than two rows, and where a column of the true ones is constant.
    """
    predicted, true = np.asarray(predicted, dtype=np.float64), np.asarray(true, dtype=np.float64)
    if len(true) < 2 or not np.ptp(true, axis=0).all():
        return float("nan")
    total = ((true - true.mean(axis=0)) ** 2).sum(axis=0)
    return float(np.mean(1.0 - ((true - predicted) ** 2).sum(axis=0) / total))


def centroid_alignment(source: ArrayLike, target: ArrayLike) -> Array:
    """Give the pose that stands for a refusal in errors over ALL pairs: no rotation, centroid on centroid."""
    return se3.from_rotation_translation(np.eye(3), np.asarray(target).mean(axis=0) - np.asarray(source).mean(axis=0))


def _euler_deg(transforms: ArrayLike) -> Array:
    return Rotation.from_matrix(np.asarray(transforms, dtype=np.float64)[:, :3, :3]).as_euler("zyx", degrees=True)
