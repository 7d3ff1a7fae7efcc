"""Confidence intervals of means and shares; by subject, where it is known who the bones belong to."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

Array = NDArray[Any]
RESAMPLES = 2000
DRAWN_AT_ONCE = 4_000_000  # labels, 32 MB
NONE = (float("nan"), float("nan"))


def interval(values: ArrayLike, groups: Sequence[str] | None = None) -> tuple[float, float]:
    """Compute the 95 % percentile bootstrap interval of a mean (Efron and Tibshirani 1993, ch. 13).

    Args:
        values: (K,) one value per pair.
        groups: (K,) whose pair it is; whole groups are drawn, as pairs of one subject are not independent.

    Returns:
        (low, high); NaN where the resamples do not differ, as of one subject, or of subjects that agree.
    """
    values = np.asarray(values, dtype=np.float64)
    if not len(values):
        return NONE
    labels = _labels(values, groups)
    sums, counts = np.bincount(labels, weights=values), np.bincount(labels)
    if np.ptp(sums / counts) < 1e-12:
        return NONE
    found = stats.bootstrap(
        (sums, counts), _mean, paired=True, vectorized=True, n_resamples=RESAMPLES,
        batch=max(1, DRAWN_AT_ONCE // len(counts)), method="percentile", random_state=0,
    ).confidence_interval  # fmt: skip
    return float(found.low), float(found.high)


def share_interval(hits: ArrayLike, groups: Sequence[str] | None = None) -> tuple[float, float]:
    """Compute the 95 % interval of a share: as `interval`, and Wilson's where all subjects agree.

    A subject counts once in it. So does one subject alone, of whom nothing can be resampled.

    Args:
        hits: (K,) bool, one per pair.
        groups: (K,) whose pair it is.
    """
    hits = np.asarray(hits, dtype=np.float64)
    low, high = interval(hits, groups)
    if not len(hits) or np.isfinite(low):
        return low, high
    subjects = len(np.unique(_labels(hits, groups)))
    share, z = float(hits.mean()), float(stats.norm.ppf(0.975))  # SciPy's own needs a count, and a share is none
    middle = share + z**2 / (2.0 * subjects)
    half = z * np.sqrt(share * (1.0 - share) / subjects + (z / (2.0 * subjects)) ** 2)
    return tuple(np.clip((middle + np.array([-half, half])) / (1.0 + z**2 / subjects), 0.0, 1.0).tolist())


def _labels(values: Array, groups: Sequence[str] | None) -> Array:
    """Number the group of each value from 0; each value is a group of its own where none is named."""
    return np.arange(len(values)) if groups is None else np.unique(np.asarray(groups), return_inverse=True)[1]


def _mean(sums: Array, counts: Array, axis: int) -> Array:
    """Compute the mean of the values of the groups that were drawn."""
    return np.asarray(sums.sum(axis=axis) / counts.sum(axis=axis))
