"""Compiled loops over the residuals of a pose: weights, and means of patches.

No fast mathematics here: a residual is NaN where no surface is near, and counts as infinitely large.
"""

# mypy: ignore-errors
from __future__ import annotations

import numba
import numpy as np

from gapr_core.geometry.quadric_kernels import EXACT


@numba.njit(**EXACT)
def share_beyond(residuals, limit):
    """Compute the share of (N,) residuals that are larger than `limit`."""
    count = 0
    for p in range(len(residuals)):
        count += not abs(residuals[p]) <= limit
    return count / len(residuals)


@numba.njit(**EXACT)
def weights(residuals, aside, nearest, elements, variance, limit):
    """Compute (N,) Tukey's weights, times the share of the noise's variance in that of a residual.

    `nearest` (N,) are rows of `elements`, whose last column is a variance; -1 without a near one.
    """
    out = np.zeros(len(residuals))
    for p in range(len(residuals)):
        if nearest[p] >= 0:
            square = (residuals[p] * residuals[p] + aside[p] * aside[p]) / (limit * limit)
            inside = min(max(1.0 - square, 0.0), 1.0)
            out[p] = inside * inside * variance / (variance + elements[nearest[p], -1])
    return out


@numba.njit(**EXACT)
def patch_means(residuals, weights, neighbours):
    """Compute (N,) weighted means of the residuals of each point's neighbours (N, k) that have a weight."""
    out = np.empty(len(neighbours))
    for p in range(len(neighbours)):
        total, weight = 0.0, 1e-9
        for q in neighbours[p]:
            if weights[q] > 0.0:
                total += weights[q] * residuals[q]
                weight += weights[q]
        out[p] = total / weight
    return out


@numba.njit(**EXACT)
def leading_means(values, counts, neighbours, count):
    """Average `values` over the first `count` of each point's neighbours (N, k) that count.

    Returns (N,), NaN where too few count; `counts` (N,) marks the points that count.
    """
    out = np.full(len(neighbours), np.nan)
    for p in range(len(neighbours)):
        total, found = 0.0, 0
        for q in neighbours[p]:
            if counts[q]:
                total += values[q]
                found += 1
                if found == count:
                    out[p] = total / count
                    break
    return out


@numba.njit(**EXACT)
def shared_out(values, patches, count):
    """Average the `values` (N,) of the patches (N, k) of each point; (count,), 0 for a point in none."""
    total, found = np.zeros(count), np.zeros(count)
    for p in range(len(patches)):
        for q in patches[p]:
            total[q] += values[p]
            found[q] += 1.0
    return total / np.maximum(found, 1.0)
