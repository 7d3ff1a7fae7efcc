"""Confidence intervals by resampling; by subject, where it is known who the bones belong to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[Any]
DRAWN_AT_ONCE = 4_000_000  # labels, 32 MB


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
    estimate = _mean(values, labels) if statistic is None else _each(values, labels, statistic)
    rng, count = np.random.default_rng(seed), int(labels.max()) + 1
    rows = max(1, DRAWN_AT_ONCE // count)  # the numbers are those drawn all at once, which takes GB for many groups
    pieces = [min(rows, resamples - first) for first in range(0, resamples, rows)]
    estimates = np.concatenate([estimate(rng.integers(count, size=(piece, count))) for piece in pieces])
    low, high = np.percentile(estimates, [50 * (1 - level), 50 * (1 + level)])
    return float(low), float(high)


def _mean(values: Array, labels: Array) -> Callable[[Array], Array]:
    """(resamples,) means of (resamples, groups) labels."""
    sums, counts = np.bincount(labels, weights=values), np.bincount(labels)
    return lambda draws: np.asarray(sums[draws].sum(axis=1) / counts[draws].sum(axis=1))


def _each(values: Array, labels: Array, statistic: Callable[[Array], float]) -> Callable[[Array], Array]:
    """Apply another statistic in the same way."""
    members = np.split(values[np.argsort(labels, kind="stable")], np.cumsum(np.bincount(labels))[:-1])
    return lambda draws: np.array([statistic(np.concatenate([members[k] for k in draw])) for draw in draws])
