"""Does the confidence tell right from wrong? Ranking, calibration, risk, and the worst bug there is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
SURE = 0.9  # an accepted wrong pose at this confidence is the worst bug there is


class Reliability(NamedTuple):
    """One row per non-empty confidence bin."""

    confidence: Array
    accuracy: Array
    pairs: NDArray[np.int64]


def auroc(confidence: ArrayLike, correct: ArrayLike) -> float:
    """Probability that a right pose has a higher confidence than a wrong one, ties half; NaN without both kinds.

    A confidence that is NaN is the lowest of all.
    """
    correct = np.asarray(correct, dtype=bool)
    right, wrong = int(correct.sum()), int((~correct).sum())
    if right == 0 or wrong == 0:
        return float("nan")
    known = np.nan_to_num(np.asarray(confidence, dtype=np.float64), nan=-np.inf, posinf=np.inf)
    _, place, ties = np.unique(known, return_inverse=True, return_counts=True)
    ranks = (np.cumsum(ties) - (ties - 1) / 2)[place]  # equal scores share their mean rank
    return float((ranks[correct].sum() - right * (right + 1) / 2) / (right * wrong))


def reliability(confidence: ArrayLike, correct: ArrayLike, bins: int = 10) -> Reliability:
    """Mean confidence and share of right poses in equally wide bins of confidence, 0 to 1."""
    confidence, correct = np.asarray(confidence, dtype=np.float64), np.asarray(correct, dtype=np.float64)
    index = np.clip((confidence * bins).astype(int), 0, bins - 1)
    count = np.bincount(index, minlength=bins)
    used = count > 0
    mean = [np.bincount(index, weights=w, minlength=bins)[used] / count[used] for w in (confidence, correct)]
    return Reliability(mean[0], mean[1], count[used])


def expected_calibration_error(confidence: ArrayLike, correct: ArrayLike, bins: int = 10) -> float:
    """ECE (Guo et al. 2017): |confidence - accuracy| of the bins, weighted by how full they are; NaN of nothing."""
    rows = reliability(confidence, correct, bins)
    total = rows.pairs.sum()
    return float((rows.pairs * np.abs(rows.confidence - rows.accuracy)).sum() / total) if total else float("nan")


def risk_coverage(confidence: ArrayLike, correct: ArrayLike, total: int | None = None) -> tuple[Array, Array]:
    """Risk against coverage when only the most confident answers are used (El-Yaniv and Wiener 2010).

    Args:
        confidence: (K,) of the accepted answers.
        correct: (K,) whether each is right.
        total: pairs that were asked, refusals included; K when None.

    Returns:
        coverage (L,), share of all pairs answered, and risk (L,), share of those answers that are wrong, one row per
        distinct confidence, highest first (answers of equal confidence come together).
    """
    confidence, correct = np.asarray(confidence, dtype=np.float64), np.asarray(correct, dtype=bool)
    order = np.argsort(-confidence, kind="stable")
    answered = np.arange(1, len(order) + 1)
    risk = np.cumsum(~correct[order]) / answered
    last_of_ties = np.r_[np.diff(confidence[order]) != 0, True][: len(order)]
    return (answered / (total or max(len(order), 1)))[last_of_ties], risk[last_of_ties]


def false_accepts(accepted: ArrayLike, correct: ArrayLike, confidence: ArrayLike, least: float = 0.0) -> int:
    """Accepted answers that are wrong and at least this confident."""
    wrong = np.asarray(accepted, dtype=bool) & ~np.asarray(correct, dtype=bool)
    return int((wrong & (np.asarray(confidence, dtype=np.float64) >= least)).sum())


def false_accept_rate(accepted: ArrayLike, correct: ArrayLike) -> float:
    """False accepts among all pairs asked; NaN of nothing."""
    accepted = np.asarray(accepted, dtype=bool)
    return false_accepts(accepted, correct, np.ones(len(accepted))) / len(accepted) if len(accepted) else float("nan")
