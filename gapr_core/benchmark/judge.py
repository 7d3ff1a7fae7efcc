"""One answer against its truth: everything that the tables and plots need."""

from __future__ import annotations

from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_core import metrics
from gapr_core.benchmark.record import ERROR, Answer, PairFacts, Record, Verdict
from gapr_core.data.pair import Pair
from gapr_core.data.pair_files import LANDMARK, NUMBERS, TEXTS, pair_hash
from gapr_core.geometry import extent, se3
from gapr_core.metrics.pose import STRICT_LIMITS
from gapr_core.results import RegistrationResult
from gapr_core.runtime import origin

Array = NDArray[np.float64]

FACTS = (*NUMBERS, *TEXTS)  # in the metadata of a pair


def record_of(pair: Pair, result: RegistrationResult) -> Record:
    """Judge GAPR's answer to a pair that is in no file."""
    facts = {**vars(pair_facts(pair)), **vars(answer_of(result)), **vars(judge(pair, result))}
    seconds, code = result.seconds, origin.commit() or ""
    return Record(**facts, file="", sha256=pair_hash(pair), method="gapr", seconds=seconds, commit=code)


def pair_facts(pair: Pair) -> PairFacts:
    """Collect the facts of a pair, whatever the method."""
    return PairFacts(
        pair=pair.name,
        protocol=pair.protocol or "pairs",
        bone=pair.bone or "bone",
        person=pair.person,
        has_truth=pair.has_truth,
        source_points=len(pair.source),
        target_points=len(pair.target),
        half_extent_mm=extent.half_extent_mm(pair.target),
        **{key: pair.metadata.get(key) for key in FACTS},
    )


def answer_of(result: RegistrationResult) -> Answer:
    """Collect the answer of a method."""
    T = result.T_target_source
    return Answer(
        status=str(result.status),
        accepted=result.ok,
        confidence=result.confidence,
        reason=result.reason,
        transform=None if T is None else T.tolist(),
        predicted_tre_mm=result.tre_mm,
        predicted_tre95_mm=result.tre95_mm,
    )


def why_unusable(result: Any) -> str:
    """Say why an answer can be neither judged nor written down; empty if it can."""
    if not isinstance(result, RegistrationResult):
        return f"the method answered {type(result).__name__}, no RegistrationResult"
    if not isinstance(result.confidence, Real) or not np.isfinite(result.confidence):
        return f"the method's confidence is {result.confidence}, no finite number"
    if not 0.0 <= result.confidence <= 1.0:
        return f"the method's confidence is {result.confidence}, not from 0 to 1"
    for name, shape in {"T_target_source": (4, 4), "best": (4, 4), "covariance": (6, 6), "centre_mm": (3,)}.items():
        array = getattr(result, name)
        if array is not None and not _is_finite(array, shape):
            return f"the method's {name} is no array of {shape} finite numbers"
        if array is not None and shape == (4, 4) and (why := se3.why_not_rigid(array)):
            return f"the method's {name} is not rigid: its {why}"
    return ""


def _is_finite(array: Any, shape: tuple[int, ...]) -> bool:
    is_array = isinstance(array, np.ndarray) and array.shape == shape
    return is_array and array.dtype.kind in "fiu" and bool(np.isfinite(array).all())


def failure(reason: str) -> Answer:
    """Make the record of a method that raised: a failure, never dropped."""
    return Answer(status=ERROR, accepted=False, reason=reason)


def judge(pair: Pair, result: RegistrationResult | None) -> Verdict:
    """Errors of the answer; for a refusal (or None) those of centroid on centroid without rotation, marked `stand_in`.

    Without a truth (protocol wrong) there is no error: any accepted answer is a false accept.
    """
    T = None if result is None else result.T_target_source
    best = best_right(pair, result)
    if not pair.has_truth:
        return Verdict(right=False, false_accept=T is not None, best_right=best)
    if T is None or result is None:
        stand_in = metrics.centroid_alignment(pair.source, pair.target)
        errors = pose_errors(pair, stand_in, accepted=False)
        return Verdict(right=False, false_accept=False, best_right=best, stand_in=True, **errors)
    right = metrics.pose_error(T, pair.T_target_source, pair.source).is_right
    errors = pose_errors(pair, T, accepted=True) | uncertainty(pair, T, result)
    return Verdict(right=right, false_accept=not right, best_right=best, **errors)


def pose_errors(pair: Pair, T: Array, accepted: bool) -> dict[str, Any]:
    """Errors of one pose and the limits it keeps; nothing is within a limit that was not accepted."""
    true, error = pair.T_target_source, metrics.pose_error(T, pair.T_target_source, pair.source)
    rmse = metrics.rmse_mm(T, true, pair.source)
    limits = {f"within_{mm:g}_{deg:g}": accepted and error.within(mm, deg) for mm, deg in STRICT_LIMITS}
    return {
        "judged": T.tolist(), "true": true.tolist(), "rte_mm": error.rte_mm, "rre_deg": error.rre_deg,
        "rmse_mm": rmse, "whole_bone_mm": metrics.whole_bone_rmse_mm(T, true, pair.target),
        "tre_mm": metrics.tre_mm(T, true, named_targets(pair)),
        "chamfer_mm": metrics.chamfer_mm(se3.apply(T, pair.source), pair.target),
        "within_paper": accepted and metrics.within_paper_limit(rmse, pair.target),
        "within_extent": accepted and metrics.within_extent_limit(rmse, pair.target), **limits,
    }  # fmt: skip


def best_right(pair: Pair, result: RegistrationResult | None) -> bool | None:
    """Is the pose that the confidence speaks of right: the best hypothesis, accepted or not?"""
    T = None if result is None else result.best
    if T is None:
        return None
    return pair.has_truth and metrics.pose_error(T, pair.T_target_source, pair.source).is_right


def uncertainty(pair: Pair, T: Array, result: RegistrationResult) -> dict[str, Any]:
    """Compute the error as a twist, its NEES, and its ratio to the Cramer-Rao bound, if they exist."""
    turns_about = pair.source if result.centre_mm is None else se3.apply(se3.inverse(T), result.centre_mm[None])
    twist = metrics.error_twist(T, pair.T_target_source, turns_about)
    facts: dict[str, Any] = {"twist": twist.tolist(), "axes": extent.principal(pair.target).axes.tolist()}
    if result.covariance is not None:
        facts |= {"nees": metrics.nees(twist, result.covariance), "covariance": result.covariance.tolist()}
    sigma = pair.metadata.get("noise_mm")
    bound = (
        metrics.pose_bound(pair.source, pair.target, pair.T_target_source, float(sigma))
        if sigma and np.isfinite(sigma)
        else None
    )
    if bound is not None:
        rmse = metrics.rmse_mm(T, pair.T_target_source, pair.source)
        facts |= {"bound_rmse_mm": bound.rmse_mm, "bound_ratio": rmse / bound.rmse_mm}
        facts["bound_covariance"] = bound.covariance.tolist()
    return facts


def named_targets(pair: Pair) -> dict[str, Array]:
    """Arrays `landmark_NAME` (3,) of the pair, target frame; the six extreme points of the bone where it has none."""
    marked = {key[9:]: np.asarray(value) for key, value in pair.metadata.items() if key.startswith(LANDMARK)}
    return marked or metrics.extreme_points(pair.target)
