"""Compiled loops of the norm: what torch does in dozens of passes over memory, there and back.

They say what the tensors of `layers.GroupNorm` say, to rounding.

Shapes: N points of B clouds one after the other, cloud b from starts[b] to starts[b + 1]; C channels.
"""

# mypy: ignore-errors
from __future__ import annotations

import numba
import numpy as np

FAST = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}
ZERO, ONE = np.float32(0.0), np.float32(1.0)


@numba.njit(**FAST)
def norm(x, starts, groups, weight, bias, slope, epsilon, y, mean, rate):
    """Fill y (N, C), leaky ReLU (`slope`, 1: none) of the norm of x, and (B, C) means and 1 / deviations."""
    width, each = x.shape[1], x.shape[1] // groups
    total = np.empty(width, np.float32)
    for b in range(len(starts) - 1):
        begin, end = starts[b], starts[b + 1]
        count = np.float32(max(1, (end - begin) * each))
        total[:] = ZERO
        for n in range(begin, end):
            for c in range(width):
                total[c] += x[n, c]
        of_groups(total, groups, each, count, mean[b])
        total[:] = ZERO
        for n in range(begin, end):
            for c in range(width):
                total[c] += (x[n, c] - mean[b, c]) * (x[n, c] - mean[b, c])
        of_groups(total, groups, each, count, rate[b])
        for c in range(width):
            rate[b, c] = ONE / np.sqrt(rate[b, c] + epsilon)
            total[c] = rate[b, c] * weight[c]
        for n in range(begin, end):
            for c in range(width):
                value = (x[n, c] - mean[b, c]) * total[c] + bias[c]
                y[n, c] = max(value, slope * value)


@numba.njit(**FAST)
def norm_back(g, x, y, starts, groups, weight, mean, rate, slope, g_x, g_weight, g_bias):
    """Fill g_x and add to g_weight and g_bias what the gradient g of y says."""
    width, each = x.shape[1], x.shape[1] // groups
    plain, along = np.empty(width, np.float32), np.empty(width, np.float32)
    for b in range(len(starts) - 1):
        begin, end = starts[b], starts[b + 1]
        count = np.float32(max(1, (end - begin) * each))
        plain[:], along[:] = ZERO, ZERO
        for n in range(begin, end):
            for c in range(width):
                came = g[n, c] if y[n, c] > ZERO else slope * g[n, c]
                plain[c] += came
                along[c] += came * (x[n, c] - mean[b, c]) * rate[b, c]
        for c in range(width):
            g_weight[c] += along[c]
            g_bias[c] += plain[c]
            plain[c] *= weight[c]
            along[c] *= weight[c]
        of_groups(plain, groups, each, count, plain)
        of_groups(along, groups, each, count, along)
        for n in range(begin, end):
            for c in range(width):
                came = g[n, c] if y[n, c] > ZERO else slope * g[n, c]
                seen = (x[n, c] - mean[b, c]) * rate[b, c]
                g_x[n, c] = rate[b, c] * (weight[c] * came - plain[c] - seen * along[c])


@numba.njit(inline="always", **FAST)
def of_groups(total, groups, each, count, means):
    """Sums of channels to the means of their groups, at every channel; `means` may be `total`."""
    for group in range(groups):
        added = ZERO
        for c in range(group * each, (group + 1) * each):
            added += total[c]
        for c in range(group * each, (group + 1) * each):
            means[c] = added / count
