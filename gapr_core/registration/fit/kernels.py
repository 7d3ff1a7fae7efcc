"""Compiled inner loops of the refinement: nearest surface element, residual, normal equations, one step.

A residual is the signed distance of a moved source point to the quadric of the surface near it. Isotropic noise of
variance s^2 lifts the expected distance to a curved surface by -s^2 tr(shape) / 2 (outwards where it is convex). Given
that variance, the offset is subtracted. Without it the pose of a one-sided cloud is pushed along the direction of view.
Means take no fast mathematics: a residual is NaN where no surface is near.
"""

# mypy: ignore-errors
from __future__ import annotations

import numba
import numpy as np

from gapr_core.geometry.quadric_kernels import EXACT
from gapr_core.registration.fit.block_kernels import accumulate, mean_square
from gapr_core.registration.fit.surface_kernels import FAST, element_near, moved, residual

LARGEST_TURN_RAD = 0.35  # of one step
DAMPING = 1e-4  # of a point's weight in a shift and of the information on a turn: unobserved motions stay 0
TURN_DAMPING_MM2 = 1.0  # added to that of a turn


@numba.njit(**FAST)
def refine_batch(poses, points, trust, elements, nearest, origin, per_cell, spacing, limits, variances, scored=True):
    """Iterate Gauss-Newton from every pose (K, 4, 4), once per entry of `limits` (Tukey scale) and `variances`.

    `trust` (N,) are weights of the points, on top of Tukey's. With a variance of the noise, a residual also weighs as
    much as the noise's share in its variance; the rest is the element's. Returns the poses and their mean squared
    distances, truncated at the last limit; zeros unless `scored`.
    """
    out, scores = poses.copy(), np.zeros(len(poses))
    surface = elements, nearest, origin, per_cell, spacing
    H, g = np.empty((6, 6)), np.empty(6)
    middle = np.array([points[:, 0].mean(), points[:, 1].mean(), points[:, 2].mean()])
    for k in range(len(poses)):
        T = out[k]
        for i in range(len(limits)):
            accumulate(T, points, trust, middle, *surface, limits[i], variances[i], H, g)
            step(T, middle, H, g, len(points))
        if scored:
            scores[k] = mean_square(T, points, trust, *surface, limits[-1])
    return out, scores


@numba.njit(**FAST)
def step(T, middle, H, g, count):
    """Solve, limit the turn and move T in place; H is overwritten, g becomes the twist about the moved `middle`."""
    for a in range(3):
        H[a, a] += DAMPING * count
        H[a + 3, a + 3] += DAMPING * H[a + 3, a + 3] + TURN_DAMPING_MM2
    solve(H, g)
    angle = np.sqrt(g[3] ** 2 + g[4] ** 2 + g[5] ** 2)
    if angle > LARGEST_TURN_RAD:
        for a in range(6):
            g[a] *= LARGEST_TURN_RAD / angle
        angle = LARGEST_TURN_RAD
    R = rotation(g[3:], angle)
    centre = moved(T, middle)
    for a in range(3):
        T[a, 3] -= centre[a]
    for j in range(4):
        x, y, z = T[0, j], T[1, j], T[2, j]
        for a in range(3):
            T[a, j] = R[a, 0] * x + R[a, 1] * y + R[a, 2] * z
    for a in range(3):
        T[a, 3] += centre[a] + g[a]


@numba.njit(**FAST)
def solve(A, b):
    """Solve A x = b in place, A symmetric and positive definite: Cholesky on its lower triangle, x replaces b.

    By hand, since Numba compiles a call of LAPACK for 13 s.
    """
    for i in range(len(b)):
        for j in range(i + 1):
            for k in range(j):
                A[i, j] -= A[i, k] * A[j, k]
            A[i, j] = np.sqrt(A[i, i]) if i == j else A[i, j] / A[j, j]
    for i in range(len(b)):
        for k in range(i):
            b[i] -= A[i, k] * b[k]
        b[i] /= A[i, i]
    for i in range(len(b) - 1, -1, -1):
        for k in range(i + 1, len(b)):
            b[i] -= A[k, i] * b[k]
        b[i] /= A[i, i]


@numba.njit(**FAST)
def rotation(vector, angle):
    """Apply Rodrigues' formula to a rotation vector of known length."""
    R = np.eye(3)
    if angle < 1e-12:
        return R
    x, y, z = vector[0] / angle, vector[1] / angle, vector[2] / angle
    s, c = np.sin(angle), 1.0 - np.cos(angle)
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y
    R[1, 0], R[1, 1], R[1, 2] = c * x * y + s * z, 1.0 - c * (x * x + z * z), c * y * z - s * x
    R[2, 0], R[2, 1], R[2, 2] = c * x * z - s * y, c * y * z + s * x, 1.0 - c * (x * x + y * y)
    return R


@numba.njit(**FAST)
def residuals_at(T, points, elements, nearest, origin, per_cell, spacing, variance):
    """Measure (N,) signed distances (NaN beyond the field), (N, 3) gradients, (N,) distances aside, (N,) elements."""
    n = len(points)
    signed, gradient = np.full(n, np.nan), np.zeros((n, 3))
    aside, element = np.zeros(n), np.full(n, -1)
    for p in range(n):
        x, y, z = moved(T, points[p])
        q = element_near(x, y, z, nearest, origin, per_cell)
        element[p] = q
        if q >= 0:
            signed[p], gradient[p, 0], gradient[p, 1], gradient[p, 2], aside[p] = residual(
                x, y, z, q, elements, spacing, variance
            )
    return signed, gradient, aside, element


@numba.njit(**FAST)
def distinct(moved_points, order, tolerance, most):
    """Select at most `most` poses, in `order`, each farther than `tolerance` (rms) from those before it.

    `moved_points` (K, P, 3) are the same few source points under every pose. Returns indices.
    """
    kept = np.empty(most, dtype=np.int64)
    count, points = 0, moved_points.shape[1]
    same = tolerance * tolerance * points
    for i in order:
        fresh = True
        for j in kept[:count]:
            total = 0.0
            for p in range(points):
                for axis in range(3):
                    total += (moved_points[i, p, axis] - moved_points[j, p, axis]) ** 2
                if total >= same:
                    break
            if total < same:
                fresh = False
                break
        if fresh:
            kept[count] = i
            count += 1
            if count == most:
                break
    return kept[:count]


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
