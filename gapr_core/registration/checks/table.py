"""Checks of a pose: each compares a statistic with its threshold, and may give a finding.

A check refuses only where no probability can decide: a motion that is not observed, a rival that is as good, a mirror
image. Anything learnable is a feature of the classifier. `docs/concepts/checks.md` has a row for each check.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapr_core.config import RegistrarConfig
from gapr_core.geometry import se3
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.fit import alternatives
from gapr_core.results import Effect, Finding, RegistrationStatus

DEGENERATE, AMBIGUOUS = RegistrationStatus.DEGENERATE, RegistrationStatus.AMBIGUOUS
LARGEST_TURN_DEG, LARGEST_SHIFT_MM = 6.0, 5.0  # standard deviations of a motion that is not observed
EQUAL_SHARE, EQUAL_MM = 0.015, 0.25  # mean square of a rival as good over the best's, less 1; the same as a length
MIRRORED_BETTER = 0.01  # log of mean squares by which the mirror image may fit better
MORE_BONE = "measure another side or an end of the bone"


def unobserved_motion(a: Assessment) -> Assessment:
    """Refuse a pose with a motion that the points do not determine: a spin about a shaft, a slide along it."""
    turn_deg, shift_mm = a.uncertainty.largest_turn_deg, a.uncertainty.largest_shift_mm
    turns, slides = turn_deg > LARGEST_TURN_DEG, shift_mm > LARGEST_SHIFT_MM
    turned = _open("turned about", a.uncertainty.weakest_turn, turn_deg, 180.0, "degrees", a)
    shifted = _open("shifted along", a.uncertainty.weakest_shift, shift_mm, 1000.0, "mm", a)
    text = f"the bone could still be {' and '.join([turned] * turns + [shifted] * slides)}"
    if turns:
        return a.with_finding(refuse("unobserved turn", turn_deg, LARGEST_TURN_DEG, DEGENERATE, text))
    if slides:
        return a.with_finding(refuse("unobserved shift", shift_mm, LARGEST_SHIFT_MM, DEGENERATE, text))
    return a


def equal_rival(a: Assessment) -> Assessment:
    """Refuse a pose where a distinct one explains the source as well."""
    scores = a.candidates.scores
    if len(scores) < 2 or not scores[1] < as_good_as(scores[0]):
        return a
    shift_mm, turn_deg = se3.pose_error(a.candidates.poses[1], a.candidates.poses[0], a.source.points)
    text = f"another pose, {shift_mm:.0f} mm and {turn_deg:.0f} deg away, explains the source as well"
    return a.with_finding(refuse("equal rival", scores[1] / scores[0], 1.0 + EQUAL_SHARE, AMBIGUOUS, text))


def flat_valley(a: Assessment, config: RegistrarConfig) -> Assessment:
    """Refuse a pose that, pushed along its weakest motions, rests elsewhere and explains the source as well."""
    trial = alternatives.trial_of(a.fit, a.source, a.target, config)
    pushed_mm2, limit_mm2 = alternatives.pushed(trial, a.fit), as_good_as(trial.own_mm2)
    if not pushed_mm2 < limit_mm2:
        return a
    text = "a pose a few mm away fits as well: the observed surface is flat or straight"
    return a.with_finding(refuse("flat valley", pushed_mm2, limit_mm2, DEGENERATE, text))


def as_good_as(mean_square_mm2: float) -> float:
    """Compute the mean square, mm^2, below which another pose explains the source as well as one of this mean square.

    Above 2 mm of noise a small share is chance. Below it the target's own roughness decides between such poses:
    terraces of voxels, or the misfit of a smooth element at an edge.
    """
    return max((1.0 + EQUAL_SHARE) * mean_square_mm2, mean_square_mm2 + EQUAL_MM**2)


def mirror_image(a: Assessment, log_ratio: float) -> Assessment:
    """Refuse a source whose mirror image fits the bone better, by a log ratio of misfits."""
    if not log_ratio < -MIRRORED_BETTER:
        return a
    text = "the mirror image of the source fits the bone better"
    advice = "check the side of the body, and whether a scan was flipped from left to right"
    finding = refuse("mirror image", log_ratio, -MIRRORED_BETTER, RegistrationStatus.LOW_CONFIDENCE, text, advice)
    return a.with_finding(finding)


def _open(how: str, axis: NDArray[np.float64], size: float, most: float, unit: str, a: Assessment) -> str:
    """Describe an open motion about or along the main axis of the bone that is nearest to an axis (3,)."""
    named = ("its long axis", "its middle axis", "its short axis")[int(np.abs(a.target.main_axes @ axis).argmax())]
    return f"{how} {named} " + (f"by {size:.0f} {unit}" if size <= most else "freely")


def refuse(
    check: str, statistic: float, threshold: float, status: RegistrationStatus, text: str, advice: str = MORE_BONE
) -> Finding:
    """Make a finding that refuses a pose."""
    return Finding(check, Effect.REFUSE, float(statistic), float(threshold), status, text, advice)
