"""The fold of numbers and findings into an answer.

Order: a finding that refuses, the user's `min_confidence`, the user's `max_tre_mm`, the name of a refusal of a cloud
that is mostly not bone, and the questions of a refusal.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gapr_core.clouds import MM_PER_UNIT, PLAUSIBLE
from gapr_core.config import RegistrarConfig
from gapr_core.geometry import extent
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.checks.table import refuse
from gapr_core.registration.confidence import features
from gapr_core.registration.fit import alternatives
from gapr_core.results import Effect, Finding, RegistrationResult, RegistrationStatus, confidence_text
from gapr_core.surface import Surface

Array = NDArray[np.float64]

ROOM = 1.2  # a piece of a bone is at most that much longer, wider and thicker than the bone
OTHER_UNITS = {unit: mm for unit, mm in MM_PER_UNIT.items() if unit in ("m", "cm")}  # units that may be mistaken for mm
STANDOFF_BETTER = 0.15  # log of mean squares: refused sources without a stand-off hardly fit better by more


def conclude(assessment: Assessment, config: RegistrarConfig, clutter: Finding | None = None) -> RegistrationResult:
    """Fold an assessment into the answer.

    Args:
        assessment: the best pose with its numbers and findings.
        config: thresholds of the user.
        clutter: name of the refusal where most of the cloud is not this bone.
    """
    a, tre95_mm, judged = assessment, assessment.tre95_mm, assessment.judgement
    against = features.against(judged.contributions)
    refusal = a.refusal or by_threshold(a.confidence, judged.pose_probability, tre95_mm, config, against)
    if refusal is not None and clutter is not None:
        refusal = replace(clutter, text=f"{clutter.text}; {refusal.text}")
    findings = a.findings if refusal is None or refusal in a.findings else (*a.findings, refusal)
    common = RegistrationResult(
        status=RegistrationStatus.LOW_CONFIDENCE,
        confidence=a.confidence,
        pose_probability=judged.pose_probability,
        bone_evidence=judged.bone_evidence,
        findings=findings,
        inlier_ratio=a.features["inlier_ratio"],
        hypotheses=a.hypotheses,
        proposer=a.proposer,
        rounds=a.rounds,
        features=a.features,
        contributions=judged.contributions,
        residuals=a.residuals,
        inferred_viewpoint=a.inferred_viewpoint,
        looks=a.looks,
    )
    if refusal is None:
        return replace(
            common,
            status=RegistrationStatus.OK,
            T_target_source=a.fit.T,
            covariance=a.uncertainty.covariance,
            tre_mm=a.tre_mm,
            tre95_mm=tre95_mm,
            factor95=a.factor95,
            centre_mm=a.centre_mm,
        )
    asked = question(a, refusal, config)
    reason = "; ".join(filter(None, (refusal.text, refusal.advice, asked.text if asked else "")))
    return replace(common, status=refusal.status, reason=reason, findings=(*findings, asked) if asked else findings)


def by_threshold(
    confidence: float, pose_probability: float, tre95_mm: float, config: RegistrarConfig, against: str = ""
) -> Finding | None:
    """Find that numbers miss the user's thresholds, as a confidence of NaN does; None where they meet them."""
    least, most_mm = config.min_confidence, config.max_tre_mm
    if not confidence >= least:
        status = RegistrationStatus.LOW_CONFIDENCE
        if pose_probability >= least:
            text = f"the points may be of another subject's bone (confidence {confidence_text(confidence)})"
            return refuse("min_confidence", confidence, least, status, text, "check that it is this subject's bone")
        why = f"; against it: {against}" if against else ""
        text = f"the best pose is right with a probability of only {confidence_text(confidence)}{why}"
        return refuse("min_confidence", confidence, least, status, text)
    if most_mm > 0.0 and not tre95_mm <= most_mm:
        text = f"the error over the bone is below {tre95_mm:.1f} mm (95 %), allowed are {most_mm:g} mm"
        return refuse("max_tre_mm", tre95_mm, most_mm, RegistrationStatus.IMPRECISE, text)
    return None


def question(a: Assessment, refusal: Finding, config: RegistrarConfig) -> Finding | None:
    """Ask whether the unit, or the stand-off, of a refused source is right."""
    if refusal.status is RegistrationStatus.DEGENERATE:
        return unit_question(a.source.points, a.target.points)
    if refusal.status is RegistrationStatus.LOW_CONFIDENCE and a.seen is None:
        return standoff_question(a, config)
    return None


def unit_question(source: Array, target: Array) -> Finding | None:
    """Ask for the unit where the source, read as mm, would have the target's size in another one.

    A short scan of a long bone is as small as a whole one in cm taken for mm; one too round for the bone is neither.
    """
    low, high = PLAUSIBLE
    extent_mm, target_mm = Surface(source).extent_mm, Surface(target).extent_mm
    for unit, mm in OTHER_UNITS.items():
        share = extent_mm * mm / target_mm
        if low <= share <= high and (mm * _sides(source, (2, 98)) <= ROOM * _sides(target, (0, 100)) + 1.0).all():
            text = f"the cloud is {extent_mm:.3g} mm across, the bone {target_mm:.3g} mm: is the cloud in {unit}?"
            return Finding("unit", Effect.ASK, share, low, RegistrationStatus.OK, text)
    return None


def _sides(points: Array, percentiles: tuple[float, float]) -> Array:
    """Measure (N, 3) points along their principal axes, longest first, mm."""
    along = (points - points.mean(axis=0)) @ extent.principal(points).axes.T
    return np.sort(np.ptp(np.percentile(along, percentiles, axis=0), axis=0))[::-1]


def standoff_question(a: Assessment, config: RegistrarConfig) -> Finding | None:
    """Ask for the stand-off with which the source would fit clearly better, refined from the pose."""
    best_mm, log_ratio = alternatives.standoff(alternatives.trial_of(a.fit, a.source, a.target, config))
    if not log_ratio < -STANDOFF_BETTER:
        return None
    off_mm, stated_mm = a.target.offset_mm + best_mm, config.sensor.standoff_mm
    side = "outside" if off_mm > 0.0 else "inside"
    where = f"{abs(off_mm):g} mm {side} of the bone" if off_mm else "on the bone"
    question = "is the radius of the tip subtracted, or is there a standoff_mm to state?"
    if stated_mm is not None:
        question = f"is the standoff_mm of {stated_mm:g} right?"
    text = f"it fits better {where}: {question}"
    return Finding("stand-off", Effect.ASK, log_ratio, -STANDOFF_BETTER, RegistrationStatus.OK, text)
