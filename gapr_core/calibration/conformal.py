"""Fit of the precision: the scale of predicted errors at the whole bone, and a bound that holds.

An additive model of a few features predicts the logarithm of the scale of a standard deviation, as true errors and NEES
require it. The factor of the bound is the conformal quantile of true errors over bounds in bins of the confidence (Vovk
et al. 2005), by models without the subject.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.calibration.additive import fit_centre
from gapr_core.calibration.answers import Answers, of_models_that_saw_neither, of_models_that_saw_no_subject
from gapr_core.registration.confidence.additive import Additive
from gapr_core.registration.uncertainty.error_calibration import PRECISION_FEATURES, SCALE_LIMITS

Array = NDArray[np.float64]
MEDIAN_NEES = 5.348  # of chi square with six degrees of freedom
MEDIAN_RATIO = 0.8  # of a true error to its expected root mean square, for two to three effective directions
COVERED = 0.95  # of the errors in a bin, and of each sensor family in it
BINS = (0.5, 0.8, 0.9, 0.97, 1.0)  # edges of the confidence
FEWEST = 30  # least answers of a bin, or of a family in it


def fit_scale(answers: Answers) -> Additive:
    """Fit the logarithm of the scale of a predicted standard deviation."""
    by_error = np.log(answers.true_mm / (MEDIAN_RATIO * answers.tre_mm))
    by_nees = 0.5 * np.log(answers.nees / MEDIAN_NEES)  # a variance over a variance
    return fit_centre(precision_table(answers), 0.5 * (by_error + by_nees), PRECISION_FEATURES)


def scales(model: Additive, answers: Answers) -> Array:
    """Compute (N,) scales, as `Precision.scale`."""
    return np.clip(np.exp(model.values(precision_table(answers))), *SCALE_LIMITS)


def precision_table(answers: Answers) -> Array:
    """Collect (N, P) features in the order of `PRECISION_FEATURES`."""
    columns = {"log_tre": np.log(np.maximum(answers.tre_mm, 1e-6))}
    columns |= {name: answers.features[:, number] for number, name in enumerate(answers.feature_names)}
    return np.column_stack([columns[name] for name in PRECISION_FEATURES])


def scales_of_unseen_families(answers: Answers, known: NDArray[np.bool_]) -> Array:
    """Predict (N,) scales by models of the known families without the subject and its sensor family."""
    return of_models_that_saw_neither(answers, known, fit_scale, scales)


def scales_of_unseen_people(answers: Answers, known: NDArray[np.bool_]) -> Array:
    """Predict (N,) scales by models of the known families without the subject."""
    return of_models_that_saw_no_subject(answers, known, fit_scale, scales)


def factors(scores: Array, confidence: Array, family: NDArray[np.str_]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Find the factor of the bound in bins of the confidence, never rising with it.

    Args:
        scores: (N,) true errors over their bounds.
        confidence: (N,) confidences of the answers.
        family: (N,) sensor families, each of which the bound covers in each bin.

    Returns:
        Upper end and factor of each bin that has enough answers; interpolation never falls below a bin's own factor.
    """
    at, found = [], []
    for low, high in zip(BINS[:-1], BINS[1:], strict=True):
        in_bin = (confidence >= low) & (confidence <= high)
        if in_bin.sum() < FEWEST:
            continue
        families = [in_bin & (family == name) for name in np.unique(family[in_bin])]
        of_each = [conformal_quantile(scores[of_it], COVERED) for of_it in families if of_it.sum() >= FEWEST]
        at.append(high)
        found.append(max([conformal_quantile(scores[in_bin], COVERED), *of_each]))
    return tuple(at), tuple(np.maximum.accumulate(found[::-1])[::-1])


def conformal_quantile(scores: Array, share: float) -> float:
    """Find a number that the next score of the same kind stays below with at least this probability.

    The k-th smallest of n scores, k = ceil((n + 1) share): one more than the plain quantile has (Vovk et al. 2005).
    Where k > n, as of 5 scores for .95, it is the largest one, which the next score stays below only with n / (n + 1).
    """
    k = int(np.ceil((len(scores) + 1) * share))
    return float(np.sort(scores)[min(k, len(scores)) - 1])


def coverage(answers: Answers, scale: Array, factor: Array) -> dict[str, dict[str, Any]]:
    """Measure how often the bound holds, its width, and the NEES: all, by family, by round.

    Args:
        answers: N accepted answers with a truth.
        scale: (N,) scales of the standard deviations.
        factor: (N,) factors of the bound.
    """
    groups = {"all": np.full(len(answers), True)}
    groups |= {str(name): answers.family == name for name in np.unique(answers.family)}
    groups |= {f"round: {name}": answers.rounds == name for name in np.unique(answers.rounds)}
    rows = {}
    for name, of_it in groups.items():
        true, bound = answers.true_mm[of_it], (factor * scale * answers.tre95_mm)[of_it]
        rows[name] = {
            "accepted": int(of_it.sum()),
            "covered": round(float((true <= bound).mean()), 4),
            "bound_over_true": round(float(np.median(bound / true)), 3),
            "true_over_tre": round(float(np.median(true / (scale[of_it] * answers.tre_mm[of_it]))), 3),
            "nees_over_median": round(float(np.median(answers.nees[of_it] / scale[of_it] ** 2) / MEDIAN_NEES), 3),
            "nees_before": round(float(np.median(answers.nees[of_it]) / MEDIAN_NEES), 3),
        }
    return rows
