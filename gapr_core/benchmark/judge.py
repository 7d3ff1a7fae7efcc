"""One answer against its truth: a flat record of everything that the tables and plots need."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_core import metrics
from gapr_core.data.protocols import Pair
from gapr_core.geometry import se3
from gapr_core.metrics.pose import ACCEPT_LIMIT, STRICT_LIMITS
from gapr_core.results import RegistrationResult

Array = NDArray[np.float64]
Record = dict[str, Any]

ERROR = "ERROR"  # status of a record when the method raised or its process died
FACTS = ("cohort", "overlap", "noise_mm", "bias_mm", "outlier_share", "wrong_kind", "degraded_as")


def pair_facts(pair: Pair) -> Record:
    """What is known about the pair, whatever the method."""
    centred = pair.target - pair.target.mean(axis=0)
    facts = {key: pair.metadata.get(key) for key in FACTS}
    return {
        "pair": pair.name, "protocol": pair.protocol or "pairs", "bone": pair.bone or "bone", "person": pair.person,
        "has_truth": pair.has_truth, "source_points": len(pair.source), "target_points": len(pair.target),
        "half_extent_mm": float(np.linalg.norm(centred, axis=1).max()), **facts,
    }  # fmt: skip


def answer_facts(result: RegistrationResult) -> Record:
    """What the method answered."""
    T = result.T_target_source
    return {
        "status": str(result.status), "accepted": result.ok, "confidence": result.confidence, "reason": result.reason,
        "transform": None if T is None else T.tolist(), "predicted_tre_mm": result.tre_mm,
    }  # fmt: skip


def failure_facts(reason: str) -> Record:
    """What stands for the answer of a method that raised: a failure, never dropped."""
    return {
        "status": ERROR, "accepted": False, "confidence": 0.0, "reason": reason, "transform": None,
        "predicted_tre_mm": None,
    }  # fmt: skip


def judge(pair: Pair, result: RegistrationResult | None) -> Record:
    """Errors of the answer; for a refusal (or None) those of centroid on centroid without rotation, marked `stand_in`.

    Without a truth (protocol wrong) there is no error: any accepted answer is a false accept.
    """
    T = None if result is None else result.T_target_source
    if not pair.has_truth:
        return {"right": False, "false_accept": T is not None, "best_right": best_right(pair, result)}
    judged = metrics.centroid_alignment(pair.source, pair.target) if T is None else T
    errors = pose_facts(pair, judged, T is not None)
    facts = {**errors, "false_accept": T is not None and not errors["right"], "stand_in": T is None}
    facts["best_right"] = best_right(pair, result)
    if T is not None and result is not None:
        facts |= uncertainty_facts(pair, T, result, errors["rmse_mm"])
    return facts


def pose_facts(pair: Pair, T: Array, accepted: bool) -> Record:
    """Errors of one pose and the limits it keeps; nothing is within a limit that was not accepted."""
    true, error = pair.T_target_source, metrics.pose_error(T, pair.T_target_source, pair.source)
    rmse = metrics.rmse_mm(T, true, pair.source)
    half_extent = float(np.linalg.norm(pair.target - pair.target.mean(axis=0), axis=1).max())
    tre = metrics.tre_mm(T, true, named_targets(pair))
    limits = {f"within_{mm:g}_{deg:g}": accepted and error.within(mm, deg) for mm, deg in STRICT_LIMITS}
    return {
        "judged": T.tolist(), "true": true.tolist(), "rte_mm": error.rte_mm, "rre_deg": error.rre_deg,
        "rmse_mm": rmse, "whole_bone_mm": metrics.whole_bone_rmse_mm(T, true, pair.target), "tre_mm": tre,
        "chamfer_mm": metrics.chamfer_mm(se3.apply(T, pair.source), pair.target),
        "within_paper": accepted and metrics.within_paper_limit(rmse, half_extent), **limits,
        "right": accepted and error.within(*ACCEPT_LIMIT),
    }  # fmt: skip


def best_right(pair: Pair, result: RegistrationResult | None) -> bool | None:
    """Is the pose that the confidence speaks of right: the answer, or details["best_pose"] of a refusal?"""
    T = None if result is None else result.details.get("best_pose", result.T_target_source)
    if T is None:
        return None
    return pair.has_truth and metrics.pose_error(T, pair.T_target_source, pair.source).within(*ACCEPT_LIMIT)


def uncertainty_facts(pair: Pair, T: Array, result: RegistrationResult, rmse: float) -> Record:
    """The error as a twist, its NEES, and its ratio to the Cramer-Rao bound, each where it can be had."""
    twist = metrics.error_twist(T, pair.T_target_source, pair.source)
    centred = pair.target - pair.target.mean(axis=0)
    axes = np.linalg.eigh(centred.T @ centred)[1][:, ::-1].T  # rows: the bone's principal axes, longest first
    facts: Record = {"twist": twist.tolist(), "axes": axes.tolist()}
    if result.covariance is not None:
        facts |= {"nees": metrics.nees(twist, result.covariance), "covariance": result.covariance.tolist()}
    sigma = pair.metadata.get("noise_mm")
    bound = metrics.pose_bound(pair.source, pair.target, pair.T_target_source, float(sigma)) if sigma else None
    if bound is not None:
        facts |= {"bound_rmse_mm": bound.rmse_mm, "bound_ratio": rmse / bound.rmse_mm}
        facts["bound_covariance"] = bound.covariance.tolist()
    return facts


def named_targets(pair: Pair) -> dict[str, Array]:
    """Arrays `landmark_NAME` (3,) of the pair, target frame; the six extreme points of the bone where it has none."""
    marked = {key[9:]: np.asarray(value) for key, value in pair.metadata.items() if key.startswith("landmark_")}
    return marked or metrics.extreme_points(pair.target)


def jsonable(record: Record) -> Record:
    """The record with plain Python values and None for what is not finite."""
    return {key: _plain(value) for key, value in record.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(inner) for inner in value]
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not math.isfinite(value) else value
