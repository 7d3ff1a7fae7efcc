"""Compiled loops of optimal transport: every patch pair by itself, in the processor's cache.

The same iteration as `point_matching.log_optimal_transport`. With P_ij = exp(C_ij) / sum_j exp(C_ij) and s_j = sum_i
P_ij mu_i, the plan after the round in log space is K_ij = P_ij mu_i nu_j / s_j: no second exponential is needed.

Shapes: P patch pairs; a rows and b columns, the last of each a dustbin that always exists.
"""

# mypy: ignore-errors
from __future__ import annotations

import numba
import numpy as np

FAST = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}
ZERO, ONE, TINY, NEVER = np.float32(0.0), np.float32(1.0), np.float32(1e-30), np.float32(-1e6)


@numba.njit(**FAST)
def transport(scores, dustbin, rows, columns, rounds, log_z, plan, shares, left, right):
    """Fill log_z (P, a, b), and for the way back plan (P, a, b), shares (P, b), left (P, rounds, a), right alike.

    Args:
        scores: (P, a - 1, b - 1).
        rows, columns: (P, a), (P, b) float32, 1 for those that exist.
        rounds: further rounds after the first.
    """
    for p in range(len(scores)):
        mu, nu, total = masses(rows[p], columns[p])
        first_round(scores[p], dustbin, mu, nu, log_z[p], plan[p], shares[p])
        for t in range(rounds):
            for i in range(len(mu)):
                added = ZERO
                for j in range(len(nu)):
                    added += plan[p, i, j] * (right[p, t - 1, j] if t > 0 else ONE)
                left[p, t, i] = mu[i] / max(added, TINY)
            for j in range(len(nu)):
                right[p, t, j] = ZERO
            for i in range(len(mu)):
                for j in range(len(nu)):
                    right[p, t, j] += plan[p, i, j] * left[p, t, i]
            for j in range(len(nu)):
                right[p, t, j] = nu[j] / max(right[p, t, j], TINY)
        scaled(log_z[p], mu, nu, left[p], right[p], rounds, np.log(total))


@numba.njit(**FAST)
def masses(rows, columns):
    """Masses of rows and columns, 0 where there is none, and their sum before it was divided out."""
    count_p, count_q = ZERO, ZERO
    for i in range(len(rows) - 1):
        count_p += rows[i]
    for j in range(len(columns) - 1):
        count_q += columns[j]
    total = count_p + count_q
    mu, nu = rows / total, columns / total
    mu[-1], nu[-1] = count_q / total, count_p / total
    return mu, nu, total


@numba.njit(**FAST)
def first_round(scores, dustbin, mu, nu, log_z, plan, shares):
    """The round in log space: log_z, plan and shares of one patch pair."""
    a, b = log_z.shape
    shares[:] = ZERO
    for i in range(a):
        top, added = NEVER, ZERO
        for j in range(b):
            log_z[i, j] = NEVER
            if mu[i] > ZERO and nu[j] > ZERO:
                log_z[i, j] = scores[i, j] if i < a - 1 and j < b - 1 else dustbin
            top = max(top, log_z[i, j])
        for j in range(b):
            plan[i, j] = np.exp(log_z[i, j] - top) if mu[i] > ZERO and nu[j] > ZERO else ZERO
            added += plan[i, j]
        share = mu[i] / max(added, TINY)
        for j in range(b):
            plan[i, j] *= share
            shares[j] += plan[i, j]
        shift = np.log(max(share, TINY)) - top if mu[i] > ZERO else ZERO
        for j in range(b):
            log_z[i, j] += shift
    for j in range(b):
        shares[j] = nu[j] / max(shares[j], TINY)
        shift = np.log(max(shares[j], TINY))
        for i in range(a):
            plan[i, j] *= shares[j]
            log_z[i, j] += shift


@numba.njit(**FAST)
def scaled(log_z, mu, nu, left, right, rounds, log_total):
    """The logs of the last scalings and of the total mass, added."""
    for i in range(len(mu)):
        own = log_total
        if rounds > 0:
            own += np.log(max(left[rounds - 1, i], TINY))
        for j in range(len(nu)):
            log_z[i, j] += own
    if rounds > 0:
        for j in range(len(nu)):
            other = np.log(max(right[rounds - 1, j], TINY))
            for i in range(len(mu)):
                log_z[i, j] += other


@numba.njit(**FAST)
def transport_back(g, rows, columns, rounds, plan, shares, left, right, g_scores):
    """Fill g_scores (P, a - 1, b - 1) from the gradient g (P, a, b) of log_z; returns the dustbin's."""
    g_dustbin = 0.0
    for p in range(len(g)):
        mu, nu, _ = masses(rows[p], columns[p])
        back = np.zeros(plan[p].shape, np.float32)  # of the plan
        scalings_back(g[p], mu, nu, rounds, plan[p], left[p], right[p], back)
        for i in range(len(mu)):
            for j in range(len(nu)):
                exists = mu[i] > ZERO and nu[j] > ZERO
                back[i, j] = back[i, j] * plan[p, i, j] + g[p, i, j] if exists else ZERO  # of its log
        first_round_back(back, mu, nu, plan[p], shares[p])
        for i in range(len(mu) - 1):
            for j in range(len(nu) - 1):
                g_scores[p, i, j] = back[i, j]
        for i in range(len(mu)):
            g_dustbin += back[i, -1]
        for j in range(len(nu) - 1):
            g_dustbin += back[-1, j]
    return g_dustbin


@numba.njit(**FAST)
def scalings_back(g, mu, nu, rounds, plan, left, right, back):
    """Add to `back` what the scalings' gradients say of the plan, last round first."""
    g_left, g_right = np.zeros(len(mu), np.float32), np.zeros(len(nu), np.float32)
    if rounds > 0:
        for i in range(len(mu)):
            for j in range(len(nu)):
                if mu[i] > ZERO and nu[j] > ZERO:
                    g_left[i] += g[i, j]
                    g_right[j] += g[i, j]
        for i in range(len(mu)):
            g_left[i] /= max(left[rounds - 1, i], TINY)
        for j in range(len(nu)):
            g_right[j] /= max(right[rounds - 1, j], TINY)
    for step in range(rounds):
        t = rounds - 1 - step
        for j in range(len(nu)):
            g_right[j] *= -right[t, j] * right[t, j] / nu[j] if nu[j] > ZERO else ZERO
        for i in range(len(mu)):
            added = ZERO
            for j in range(len(nu)):
                added += plan[i, j] * g_right[j]
                back[i, j] += left[t, i] * g_right[j]
            g_left[i] = -(g_left[i] + added) * left[t, i] * left[t, i] / mu[i] if mu[i] > ZERO else ZERO
        for j in range(len(nu)):
            g_right[j] = ZERO
        for i in range(len(mu)):
            for j in range(len(nu)):
                g_right[j] += plan[i, j] * g_left[i]
                back[i, j] += g_left[i] * (right[t - 1, j] if t > 0 else ONE)
        g_left[:] = ZERO


@numba.njit(**FAST)
def first_round_back(back, mu, nu, plan, shares):
    """The gradient of the first round's log to that of the couplings, in place."""
    of_column = np.zeros(len(nu), np.float32)
    for i in range(len(mu)):
        for j in range(len(nu)):
            of_column[j] += back[i, j]
    for j in range(len(nu)):
        of_column[j] = of_column[j] / nu[j] if nu[j] > ZERO else ZERO
    for i in range(len(mu)):
        of_row = ZERO
        for j in range(len(nu)):
            back[i, j] -= of_column[j] * plan[i, j]
            of_row += back[i, j]
        of_row = of_row / mu[i] if mu[i] > ZERO else ZERO
        for j in range(len(nu)):
            back[i, j] -= of_row * (plan[i, j] / shares[j] if nu[j] > ZERO else ZERO)
