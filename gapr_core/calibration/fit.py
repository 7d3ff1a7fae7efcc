"""Fit the confidence of one round, and judge it on subjects and on sensor families that it has not seen."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from gapr_core.calibration.additive import fit_log_odds
from gapr_core.calibration.answers import Answers, of_models_that_saw_neither, of_models_that_saw_no_subject
from gapr_core.calibration.pairs import HELD_OUT
from gapr_core.config import RegistrarConfig
from gapr_core.metrics.confidence import SURE, auroc, expected_calibration_error, false_accepts
from gapr_core.registration.confidence.additive import Additive
from gapr_core.registration.confidence.classifier import LARGEST_LOG_ODDS
from gapr_core.registration.confidence.features import SIGNS

Array = NDArray[np.float64]
ACCEPTED = RegistrarConfig.min_confidence


def known_families(answers: Answers) -> NDArray[np.bool_]:
    """(N,) mask of the answers that models are fitted to."""
    return ~np.isin(answers.family, HELD_OUT)


def fit(answers: Answers) -> Additive:
    """The log odds that an answer is right; every record counts once."""
    return fit_log_odds(answers.features, answers.right, answers.feature_names, SIGNS)


def probability(model: Additive, answers: Answers) -> Array:
    """(N,) probabilities as `Calibration.probability` gives them."""
    return np.asarray(expit(np.clip(model.values(answers.features), -LARGEST_LOG_ODDS, LARGEST_LOG_ODDS)))


def of_unseen_people(answers: Answers) -> Array:
    """(N,) probabilities, each by a model fitted without the pair's subject and the held-out families."""
    return of_models_that_saw_no_subject(answers, known_families(answers), fit, probability)


def of_unseen_families(answers: Answers) -> Array:
    """(N,) probabilities, each by a model that has seen neither the subject nor the sensor family."""
    return of_models_that_saw_neither(answers, known_families(answers), fit, probability)


def quality(answers: Answers, confidence: Array) -> dict[str, Any]:
    """How well confidences (N,) tell right from wrong, and whether they are probabilities.

    `wrong` counts wrong poses that would be accepted at 0.5 or more, `wrong_sure` at 0.9 or more: no rule refuses them.
    """
    accepted = (confidence >= ACCEPTED) & ~answers.refused
    found = [float((accepted & answers.right & (confidence >= least)).sum() / max(answers.right.sum(), 1))
             for least in (ACCEPTED, SURE)]  # fmt: skip
    return {
        "pairs": len(answers),
        "right": int(answers.right.sum()),
        "auroc": _rounded(auroc(confidence, answers.right)),
        "ece": _rounded(expected_calibration_error(confidence, answers.right)),
        "wrong": false_accepts(accepted, answers.right, confidence),
        "wrong_sure": false_accepts(accepted, answers.right, confidence, SURE),
        "right_accepted": _rounded(found[0]),
        "right_sure": _rounded(found[1]),
    }


def by_group(answers: Answers, confidence: Array, groups: NDArray[np.str_]) -> dict[str, dict[str, Any]]:
    """`quality` of all, and of each group."""
    rows = {"all": quality(answers, confidence)}
    for group in np.unique(groups):
        rows[str(group)] = quality(answers.of(groups == group), confidence[groups == group])
    return rows


def _rounded(value: float) -> float | None:
    return round(value, 4) if np.isfinite(value) else None
