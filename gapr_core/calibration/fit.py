"""The fit of the two numbers of the confidence, judged on unseen subjects and sensor families."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from gapr_core.calibration.additive import fit_log_odds
from gapr_core.calibration.answers import Answers, of_models_that_saw_neither, of_models_that_saw_no_subject
from gapr_core.calibration.pairs import HELD_OUT
from gapr_core.config import RegistrarConfig
from gapr_core.metrics.confidence import SURE, auroc, expected_calibration_error, false_accepts
from gapr_core.registration.confidence.additive import Additive
from gapr_core.registration.confidence.classifier import LARGEST_EVIDENCE, LARGEST_LOG_ODDS
from gapr_core.registration.confidence.features import SIGNS

Array = NDArray[np.float64]
ACCEPTED, PRIOR = RegistrarConfig.min_confidence, RegistrarConfig.other_bone_prior
ANOTHER_BONE = ("person", "scaled")  # of `pairs.WHAT`: another subject's bone, or one of another size


class Models(NamedTuple):
    """Models of both numbers for one kind of answer: log odds of the pose, log likelihood ratio of the bone."""

    pose: Additive
    bone: Additive


def known_families(answers: Answers) -> NDArray[np.bool_]:
    """Mark the answers (N,) that models are fitted to."""
    return ~np.isin(answers.family, HELD_OUT)


def fit(answers: Answers) -> Models:
    """Fit both models: the first to own bones, the second to right poses of these and to other subjects' bones."""
    own = answers.of(of_own_bone(answers))
    pose = fit_log_odds(own.features, own.right, own.feature_names, SIGNS)
    either = answers.of(of_own_bone(answers) & answers.right | is_another_bone(answers))
    is_own = ~is_another_bone(either)
    bone = fit_log_odds(either.features, is_own, either.feature_names, SIGNS)
    prior = np.log(max(is_own.sum(), 1) / max((~is_own).sum(), 1))
    return Models(pose, Additive(bone.constant - float(prior), bone.curves))


def of_own_bone(answers: Answers) -> NDArray[np.bool_]:
    """Mark the answers (N,) to which there is a right pose."""
    return np.isfinite(answers.true_mm)


def is_another_bone(answers: Answers) -> NDArray[np.bool_]:
    """Mark the answers (N,) to a source of another subject's bone, or of one of another size."""
    return np.isin(answers.what, ANOTHER_BONE)


def numbers(models: Models, answers: Answers) -> Array:
    """Predict (N, 2) log odds of the pose and log10 likelihood ratios of the bone, as `Classifier.judge`."""
    pose = np.clip(models.pose.values(answers.features), -LARGEST_LOG_ODDS, LARGEST_LOG_ODDS)
    bone = models.bone.values(answers.features) / np.log(10.0)
    return np.column_stack([pose, np.clip(bone, -LARGEST_EVIDENCE, LARGEST_EVIDENCE)])


def confidences(found: Array, prior: float = PRIOR) -> Array:
    """Compute (N,) P(pose | bone) x P(bone) of numbers (N, 2), as `classifier.joint`."""
    return np.asarray(expit(found[:, 0]) * expit(np.log(10.0) * found[:, 1] - np.log(prior / (1.0 - prior))))


def of_unseen_people(answers: Answers) -> Array:
    """Predict (N, 2) numbers by models fitted without the pair's subject and the held-out families."""
    return of_models_that_saw_no_subject(answers, known_families(answers), fit, numbers)


def of_unseen_families(answers: Answers) -> Array:
    """Predict (N, 2) numbers by models without the pair's subject and its sensor family."""
    return of_models_that_saw_neither(answers, known_families(answers), fit, numbers)


def quality(answers: Answers, found: Array) -> dict[str, Any]:
    """Measure the ranking of right above wrong by numbers (N, 2), and the calibration of the confidence.

    AUROC and ECE are of the pose's probability, over own bones. `wrong` counts wrong poses accepted at 0.5 or more,
    `wrong_sure` at 0.9 or more: no finding refuses them.
    """
    confidence, own = confidences(found), of_own_bone(answers)
    accepted = (confidence >= ACCEPTED) & ~answers.refused
    shares = [float((accepted & answers.right & (confidence >= least)).sum() / max(answers.right.sum(), 1))
              for least in (ACCEPTED, SURE)]  # fmt: skip
    return {
        "pairs": len(answers),
        "right": int(answers.right.sum()),
        "auroc": _rounded(auroc(expit(found[own, 0]), answers.right[own]) if own.any() else np.nan),
        "ece": _rounded(expected_calibration_error(confidence[own], answers.right[own]) if own.any() else np.nan),
        "wrong": false_accepts(accepted, answers.right, confidence),
        "wrong_sure": false_accepts(accepted, answers.right, confidence, SURE),
        "right_accepted": _rounded(shares[0]),
        "right_sure": _rounded(shares[1]),
    }


def by_group(answers: Answers, found: Array, groups: NDArray[np.str_]) -> dict[str, dict[str, Any]]:
    """Measure `quality` of all, and of each group."""
    rows = {"all": quality(answers, found)}
    for group in np.unique(groups):
        rows[str(group)] = quality(answers.of(groups == group), found[groups == group])
    return rows


def _rounded(value: float) -> float | None:
    return round(value, 4) if np.isfinite(value) else None
