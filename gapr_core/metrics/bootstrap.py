"""Confidence intervals by resampling; by person, where it is known who the bones belong to."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike


def interval(
    values: ArrayLike,
    groups: Sequence[str] | None = None,
    statistic: Callable[..., float] = np.mean,
    level: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> tuple[float, float]:
    """Percentile bootstrap interval of a statistic (Efron and Tibshirani 1993, ch. 13).

    Args:
        values: (K,) one value per pair.
        groups: (K,) whose pair it is; whole groups are drawn, as pairs of one person are not independent.
        statistic: of a 1-D array.
        level: share of the resamples between the two ends.

    Returns:
        (low, high); NaN of nothing.
    """
    values = np.asarray(values, dtype=np.float64)
    if values.size == 0:
        return float("nan"), float("nan")
    labels = np.arange(len(values)) if groups is None else np.unique(np.asarray(groups), return_inverse=True)[1]
    members = [values[labels == label] for label in range(labels.max() + 1)]
    rng = np.random.default_rng(seed)
    draws = rng.integers(len(members), size=(resamples, len(members)))
    estimates = [statistic(np.concatenate([members[k] for k in draw])) for draw in draws]
    low, high = np.percentile(estimates, [50 * (1 - level), 50 * (1 + level)])
    return float(low), float(high)
