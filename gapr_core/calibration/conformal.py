"""Fit the precision: how predicted errors at the whole bone compare with true ones, and a bound that holds.

The scale of a predicted standard deviation is an additive model of a few features, of the logarithm of what the true
errors and NEES ask for. The factor of the bound is the conformal quantile of true errors over bounds: large enough for
all answers together, of models that had seen neither the subject nor the sensor family, and for each family alone, of
models that had not seen the subject.
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
MEDIAN_RATIO = 0.8  # of a true error to its expected root mean square: of two to three directions that matter
OVERALL, IN_EACH = 0.955, 0.91  # coverage: a little above what is asked for, 95 % over all and 90 % in each
FEWEST = 30  # accepted answers of a family that has a say of its own


def fit_scale(answers: Answers) -> Additive:
    """Of the logarithm of the scale that a predicted standard deviation needs."""
    by_error = np.log(answers.true_mm / (MEDIAN_RATIO * answers.tre_mm))
    by_nees = 0.5 * np.log(answers.nees / MEDIAN_NEES)  # a variance over a variance
    return fit_centre(precision_table(answers), 0.5 * (by_error + by_nees), PRECISION_FEATURES)


def scales(model: Additive, answers: Answers) -> Array:
    """(N,) as `Precision.scale` gives them."""
    return np.clip(np.exp(model.values(precision_table(answers))), *SCALE_LIMITS)


def precision_table(answers: Answers) -> Array:
    """(N, P) in the order of `PRECISION_FEATURES`."""
    columns = {"log_tre": np.log(np.maximum(answers.tre_mm, 1e-6))}
    columns |= {name: answers.features[:, number] for number, name in enumerate(answers.feature_names)}
    return np.column_stack([columns[name] for name in PRECISION_FEATURES])


def scales_of_unseen_families(answers: Answers, known: NDArray[np.bool_]) -> Array:
    """(N,) scales by models of the known families that have seen neither the subject nor the sensor family."""
    return of_models_that_saw_neither(answers, known, fit_scale, scales)


def scales_of_unseen_people(answers: Answers, known: NDArray[np.bool_]) -> Array:
    """(N,) scales by models of the known families that have not seen the subject."""
    return of_models_that_saw_no_subject(answers, known, fit_scale, scales)


def factor_overall(scores: Array) -> float:
    """The smallest factor with which bounds cover their share of all scores (N,), true errors over bounds."""
    return conformal_quantile(scores, OVERALL)


def factor_in_each(scores: Array, *groupings: NDArray[np.str_]) -> float:
    """The smallest factor with which bounds cover their share of the scores (N,) of each group.

    Args:
        scores: true errors over their bounds.
        groupings: (N,) each: sensor families, rounds.
    """
    groups = [grouping == name for grouping in groupings for name in np.unique(grouping)]
    return max((conformal_quantile(scores[of_it], IN_EACH) for of_it in groups if of_it.sum() >= FEWEST), default=0.0)


def conformal_quantile(scores: Array, share: float) -> float:
    """What the next score of the same kind stays below with at least this probability (Vovk et al. 2005).

    The k-th smallest of n scores, k = ceil((n + 1) share): one more than the plain quantile has. Where k > n, as of 5
    scores for .95, it is the largest one, which the next score stays below with n / (n + 1) only.
    """
    k = int(np.ceil((len(scores) + 1) * share))
    return float(np.sort(scores)[min(k, len(scores)) - 1])


def coverage(answers: Answers, scale: Array, factor: float) -> dict[str, dict[str, Any]]:
    """How often the bound holds, how wide it is, and what the NEES is: all, by family, by round, by size."""
    rows = {}
    edges_mm = np.quantile(factor * scale * answers.tre95_mm, [0.0, 0.25, 0.5, 0.75, 1.0])
    quarter = np.clip(np.searchsorted(edges_mm, factor * scale * answers.tre95_mm, side="right"), 1, 4)
    groups = {"all": np.full(len(answers), True)}
    groups |= {str(name): answers.family == name for name in np.unique(answers.family)}
    groups |= {f"round: {name}": answers.rounds == name for name in np.unique(answers.rounds)}
    for k in range(1, 5):
        name = f"tre95 {edges_mm[k - 1]:.1f} to {edges_mm[k]:.1f} mm"  # two that read alike are one
        groups[name] = groups.get(name, False) | (quarter == k)
    for name, of_it in groups.items():
        if not of_it.any():
            continue
        true, bound = answers.true_mm[of_it], factor * scale[of_it] * answers.tre95_mm[of_it]
        rows[name] = {
            "accepted": int(of_it.sum()),
            "covered": round(float((true <= bound).mean()), 4),
            "bound_over_true": round(float(np.median(bound / true)), 3),
            "true_over_tre": round(float(np.median(true / (scale[of_it] * answers.tre_mm[of_it]))), 3),
            "nees_over_median": round(float(np.median(answers.nees[of_it] / scale[of_it] ** 2) / MEDIAN_NEES), 3),
            "nees_before": round(float(np.median(answers.nees[of_it]) / MEDIAN_NEES), 3),
        }
    return rows
