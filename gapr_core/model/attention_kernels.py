"""Compiled loops of attention with geometry: softmax and sums of every query over its own neighbours.

Keys, values, the geometry's hidden layer and all gradients of a pair stay in the processor's cache. Missing neighbours
cost nothing. The hidden layer is made again on the way back.

Shapes: N queries with up to K neighbours among M keys; H heads of D channels; G geometry channels, E hidden ones.
"""

# mypy: ignore-errors
from __future__ import annotations

import numba
import numpy as np

from gapr_core.model.pgf import EMBEDDED

FAST = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}
ZERO, LOWEST = np.float32(0.0), np.float32(-3e38)  # fast mathematics knows no infinity


@numba.njit(**FAST)
def forward(q, k, v, folded, first, bias, index, valid, geometry, scale, out, mixed, weights):
    """Fill out (N, H, D), mixed (N, H, E) and weights (N, H, K), all zero before.

    Args:
        q: (N, H, D). k, v: (M, H, D). folded: (N, H, E), factors of the hidden layer in the logits. first, bias: (G,
        E), (E,) of the hidden layer. index, valid: (N, K) rows of the keys, and bool, which exist. geometry: (N, K, G).
        scale: multiplies the logits.
    """
    hidden = np.empty((index.shape[1], len(bias)), np.float32)
    columns = np.empty(index.shape[1], np.int64)
    for n in range(len(index)):
        count = existing(valid, n, columns)
        for j in range(count):
            column = columns[j]
            m = index[n, column]
            fill_hidden(geometry, n, column, first, bias, hidden, j)
            for h in range(q.shape[1]):
                weights[n, h, column] = scale * (inner(q, n, k, m, h) + inner_hidden(folded, n, h, hidden, j))
        softmax(weights, n, columns, count)
        for j in range(count):
            m = index[n, columns[j]]
            for h in range(q.shape[1]):
                w = weights[n, h, columns[j]]
                for d in range(q.shape[2]):
                    out[n, h, d] += w * v[m, h, d]
                for e in range(len(bias)):
                    mixed[n, h, e] += w * hidden[j, e]


@numba.njit(**FAST)
def backward(
    q, k, v, folded, first, bias, index, valid, geometry, scale, weights, g_out, g_mixed,
    g_q, g_k, g_v, g_folded, g_first, g_bias,
):  # fmt: skip
    """Add to the gradients `g_*`, of the shapes of their arrays, the share of `g_out` and `g_mixed`."""
    hidden = np.empty((index.shape[1], len(bias)), np.float32)
    g_logit = np.empty((index.shape[1], q.shape[1]), np.float32)
    g_hidden = np.empty(len(bias), np.float32)
    columns = np.empty(index.shape[1], np.int64)
    for n in range(len(index)):
        count = existing(valid, n, columns)
        for j in range(count):
            m = index[n, columns[j]]
            fill_hidden(geometry, n, columns[j], first, bias, hidden, j)
            for h in range(q.shape[1]):
                g_logit[j, h] = inner(g_out, n, v, m, h) + inner_hidden(g_mixed, n, h, hidden, j)
        softmax_backward(weights, n, columns, count, scale, g_logit)
        for j in range(count):
            column = columns[j]
            m = index[n, column]
            g_hidden[:] = ZERO
            for h in range(q.shape[1]):
                w, g = weights[n, h, column], g_logit[j, h]
                for d in range(q.shape[2]):
                    g_q[n, h, d] += g * k[m, h, d]
                for d in range(q.shape[2]):
                    g_k[m, h, d] += g * q[n, h, d]
                for d in range(q.shape[2]):
                    g_v[m, h, d] += w * g_out[n, h, d]
                for e in range(len(bias)):
                    g_folded[n, h, e] += g * hidden[j, e]
                for e in range(len(bias)):
                    g_hidden[e] += g * folded[n, h, e] + w * g_mixed[n, h, e]
            hidden_backward(geometry, n, column, hidden, j, g_hidden, g_first, g_bias)


@numba.njit(inline="always", **FAST)
def existing(valid, n, columns):
    """List the columns of query n's real neighbours; returns their number."""
    count = np.int64(0)
    for column in range(valid.shape[1]):
        if valid[n, column]:
            columns[count] = column
            count += 1
    return count


@numba.njit(inline="always", **FAST)
def inner(a, n, b, m, h):
    """Inner product of head h."""
    total = ZERO
    for d in range(a.shape[2]):
        total += a[n, h, d] * b[m, h, d]
    return total


@numba.njit(inline="always", **FAST)
def inner_hidden(a, n, h, hidden, j):
    """Inner product with the hidden layer of neighbour j."""
    total = ZERO
    for e in range(hidden.shape[1]):
        total += a[n, h, e] * hidden[j, e]
    return total


@numba.njit(inline="always", **FAST)
def fill_hidden(geometry, n, column, first, bias, hidden, j):
    """Row j becomes ReLU(geometry @ first + bias) of one pair."""
    for e in range(len(bias)):
        total = bias[e]
        for i in range(EMBEDDED):  # a constant, so that the loop is written out
            total += geometry[n, column, i] * first[i, e]
        hidden[j, e] = max(total, ZERO)


@numba.njit(inline="always", **FAST)
def hidden_backward(geometry, n, column, hidden, j, g_hidden, g_first, g_bias):
    """Gradients of the hidden layer of one pair; g_hidden is overwritten."""
    for e in range(len(g_bias)):
        g_hidden[e] = g_hidden[e] if hidden[j, e] > ZERO else ZERO
        g_bias[e] += g_hidden[e]
    for i in range(EMBEDDED):
        for e in range(len(g_bias)):
            g_first[i, e] += geometry[n, column, i] * g_hidden[e]


@numba.njit(inline="always", **FAST)
def softmax(weights, n, columns, count):
    """Logits of query n, at some columns, to weights."""
    for h in range(weights.shape[1]):
        top, total = LOWEST, ZERO
        for j in range(count):
            top = max(top, weights[n, h, columns[j]])
        for j in range(count):
            weights[n, h, columns[j]] = np.exp(weights[n, h, columns[j]] - top)
            total += weights[n, h, columns[j]]
        for j in range(count):
            weights[n, h, columns[j]] /= total


@numba.njit(inline="always", **FAST)
def softmax_backward(weights, n, columns, count, scale, g):
    """Gradients g (K, H) of the weights of query n to those of its logits, in place."""
    for h in range(weights.shape[1]):
        mean = ZERO
        for j in range(count):
            mean += weights[n, h, columns[j]] * g[j, h]
        for j in range(count):
            g[j, h] = (g[j, h] - mean) * weights[n, h, columns[j]] * scale
