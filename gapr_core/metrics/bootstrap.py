"""Confidence intervals by resampling; by subject, where it is known who the bones belong to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[Any]


def interval(
    values: ArrayLike,
    groups: Sequence[str] | None = None,
    statistic: Callable[[Array], float] | None = None,
    level: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> tuple[float, float]:
    """Percentile bootstrap interval of a statistic (Efron and Tibshirani 1993, ch. 13).

    Args:
        values: (K,) one value per pair.
        groups: (K,) whose pair it is; whole groups are drawn, as pairs of one subject are not independent.
        statistic: of a 1-D array; the mean when None.
        level: share of the resamples between the two ends.
        resamples: how many.
        seed: the same seed gives the same interval.

    Returns:
        (low, high); NaN of nothing.
    """
    values = np.asarray(values, dtype=np.float64)
    if values.size == 0:
        return float("nan"), float("nan")
    labels = np.arange(len(values)) if groups is None else np.unique(np.asarray(groups), return_inverse=True)[1]
    draws = np.random.default_rng(seed).integers(labels.max() + 1, size=(resamples, labels.max() + 1))
    estimates = _means(values, labels, draws) if statistic is None else _each(values, labels, draws, statistic)
    low, high = np.percentile(estimates, [50 * (1 - level), 50 * (1 + level)])
    return float(low), float(high)


def _means(values: Array, labels: Array, draws: Array) -> Array:
    sums, counts = np.bincount(labels, weights=values), np.bincount(labels)
    return np.asarray(sums[draws].sum(axis=1) / counts[draws].sum(axis=1))


def _each(values: Array, labels: Array, draws: Array, statistic: Callable[[Array], float]) -> Array:
    members = [values[labels == label] for label in range(labels.max() + 1)]
    return np.array([statistic(np.concatenate([members[k] for k in draw])) for draw in draws])
