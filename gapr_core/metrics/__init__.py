"""Metrics: pure functions of float64 numpy arrays, explained in docs/develop/metrics.md."""

from gapr_core.geometry.se3 import PoseError, pose_error
from gapr_core.geometry.twists import error_twist, nees, predicted_rmse_mm
from gapr_core.metrics.bootstrap import interval, share_interval
from gapr_core.metrics.confidence import (
    auroc,
    expected_calibration_error,
    false_accept_rate,
    false_accepts,
    reliability,
    risk_coverage,
)
from gapr_core.metrics.cramer_rao import pose_bound
from gapr_core.metrics.pose import (
    centroid_alignment,
    extreme_points,
    r2_rotation,
    r2_translation,
    recall,
    rmse_mm,
    tre_mm,
    whole_bone_rmse_mm,
    within_extent_limit,
    within_paper_limit,
)
from gapr_core.metrics.surfaces import chamfer_mm, coarse_inlier_ratio, fine_inlier_ratio

__all__ = [
    "PoseError", "auroc", "centroid_alignment", "chamfer_mm", "coarse_inlier_ratio", "error_twist",
    "expected_calibration_error", "extreme_points", "false_accept_rate", "false_accepts", "fine_inlier_ratio",
    "interval", "nees", "pose_bound", "pose_error", "predicted_rmse_mm", "r2_rotation", "r2_translation", "recall",
    "reliability", "risk_coverage", "rmse_mm", "share_interval", "tre_mm", "whole_bone_rmse_mm", "within_extent_limit",
    "within_paper_limit",
]  # fmt: skip
