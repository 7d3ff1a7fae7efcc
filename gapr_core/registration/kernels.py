"""Compiled inner loops of the refinement: nearest surface element, residual, normal equations, one step.

A residual is the signed distance of a moved source point to the quadric that stands for the surface near it. Isotropic
noise of variance s^2 lifts the expected distance to a curved surface by -s^2 tr(shape) / 2 (outwards where it is
convex); given that variance, the offset is taken away. Without it the pose of a one-sided cloud is pushed along the
direction of view.
"""

# mypy: ignore-errors
from __future__ import annotations

import numba
import numpy as np

ELEMENT_RADIUS = 2.0  # of a surface element, in point spacings; beyond it the quadric is not extrapolated
LARGEST_TURN_RAD = 0.35  # of one step
FAST = {"cache": True, "nogil": True, "fastmath": True}


@numba.njit(inline="always", **FAST)
def moved(T, p):
    """Point p (3,) moved by T (4, 4)."""
    return (
        T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3],
        T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3],
        T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3],
    )


@numba.njit(inline="always", **FAST)
def element_near(x, y, z, nearest, origin, per_cell):
    """Index of the target point near (x, y, z), -1 where there is none."""
    i = int(np.floor((x - origin[0]) * per_cell + 0.5))
    j = int(np.floor((y - origin[1]) * per_cell + 0.5))
    k = int(np.floor((z - origin[2]) * per_cell + 0.5))
    if i < 0 or j < 0 or k < 0 or i >= nearest.shape[0] or j >= nearest.shape[1] or k >= nearest.shape[2]:
        return -1
    return nearest[i, j, k]


@numba.njit(inline="always", **FAST)
def residual(x, y, z, q, elements, spacing, variance):
    """Signed distance to element q, its gradient, and how far aside of the element's disc the point lies.

    A row of `elements` is point (3), normal (3), shape xx xy xz yy yz zz, variance.
    """
    e = elements[q]
    dx, dy, dz = x - e[0], y - e[1], z - e[2]
    nx, ny, nz = e[3], e[4], e[5]
    height = nx * dx + ny * dy + nz * dz
    tx, ty, tz = dx - height * nx, dy - height * ny, dz - height * nz
    aside, reach = np.sqrt(tx * tx + ty * ty + tz * tz), ELEMENT_RADIUS * spacing
    if aside > reach:
        tx, ty, tz = tx * reach / aside, ty * reach / aside, tz * reach / aside
    sx = e[6] * tx + e[7] * ty + e[8] * tz
    sy = e[7] * tx + e[9] * ty + e[10] * tz
    sz = e[8] * tx + e[10] * ty + e[11] * tz
    nx, ny, nz = nx - sx, ny - sy, nz - sz
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    lift = 0.5 * variance * (e[6] + e[9] + e[11])
    most = 0.5 * np.sqrt(variance)  # the expansion ends at sharp edges
    signed = (height - 0.5 * (sx * tx + sy * ty + sz * tz)) / length + min(max(lift, -most), most)
    return signed, nx / length, ny / length, nz / length, max(aside - reach, 0.0)


@numba.njit(**FAST)
def refine_batch(poses, points, trust, elements, nearest, origin, per_cell, spacing, limits, variances):
    """Gauss-Newton from every pose (K, 4, 4); one iteration per entry of `limits` (Tukey scale) and `variances`.

    `trust` (N,) are weights of the points as well as Tukey's. Where the variance of the noise is given, a residual also
    weighs as much as the noise's share in its variance; the rest is the element's. Returns the poses and their mean
    squared distances, truncated at the last limit.
    """
    out, scores = poses.copy(), np.empty(len(poses))
    surface = elements, nearest, origin, per_cell, spacing
    rows, H, g = np.empty((7, rows_for(len(points)))), np.empty((6, 6)), np.empty(6)
    middle = np.array([points[:, 0].mean(), points[:, 1].mean(), points[:, 2].mean()])
    for k in range(len(poses)):
        T, total = out[k], 0.0
        for i in range(len(limits)):
            accumulate(T, points, trust, middle, *surface, limits[i], variances[i], rows, H, g)
            step(T, middle, H, g, len(points))
        for p in range(len(points)):
            total += squared_distance(T, points[p], *surface, limits[-1])
        scores[k] = total / len(points)
    return out, scores


@numba.njit(**FAST)
def squared_distance(T, point, elements, nearest, origin, per_cell, spacing, limit):
    """Squared distance of one moved point to the surface, truncated."""
    x, y, z = moved(T, point)
    q = element_near(x, y, z, nearest, origin, per_cell)
    if q < 0:
        return limit * limit
    r, _, _, _, aside = residual(x, y, z, q, elements, spacing, 0.0)
    return min(limit * limit, r * r + aside * aside)


@numba.njit(**FAST)
def accumulate(T, points, trust, middle, elements, nearest, origin, per_cell, spacing, limit, variance, rows, H, g):
    """Normal equations H twist = g, weighted; twist = x y z rx ry rz about the moved middle of the source."""
    middle = moved(T, middle)
    count = 0
    for p in range(len(points)):
        x, y, z = moved(T, points[p])
        q = element_near(x, y, z, nearest, origin, per_cell)
        if q < 0:
            continue
        r, nx, ny, nz, aside = residual(x, y, z, q, elements, spacing, variance)
        w = trust[p] * tukey(r * r + aside * aside, limit)
        if variance > 0.0:
            w *= variance / (variance + elements[q, 12])
        put_row(rows, count, w, x, y, z, middle, r, nx, ny, nz)
        count += 1
    add_up(rows, count, H, g)


@numba.njit(inline="always", **FAST)
def tukey(square, limit):
    """Tukey's biweight of a squared residual; without a branch, which a processor would often guess wrong."""
    inside = max(1.0 - square / (limit * limit), 0.0)
    return inside * inside


@numba.njit(inline="always", **FAST)
def put_row(rows, i, w, x, y, z, middle, r, nx, ny, nz):
    """Column i of `rows`: derivatives of a residual r by the twist about `middle` (3), and r, times the root of w."""
    root = np.sqrt(w)
    nx, ny, nz = root * nx, root * ny, root * nz
    x, y, z = x - middle[0], y - middle[1], z - middle[2]
    rows[0, i], rows[1, i], rows[2, i] = nx, ny, nz
    rows[3, i], rows[4, i], rows[5, i] = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx
    rows[6, i] = root * r


@numba.njit(**FAST)
def add_up(rows, count, H, g):
    """Normal equations (6, 6) and (6,) of the first `count` columns of `rows` (7, N), filled in place.

    One product of whole rows after the other, and padded, so that the compiler takes several columns at a time.
    """
    padded = rows_for(count)
    rows[:, count:padded] = 0.0
    for a in range(6):
        total = 0.0
        for p in range(padded):
            total -= rows[a, p] * rows[6, p]
        g[a] = total
        for b in range(a + 1):
            total = 0.0
            for p in range(padded):
                total += rows[a, p] * rows[b, p]
            H[a, b] = H[b, a] = total


@numba.njit(inline="always", **FAST)
def rows_for(count):
    """Columns that `add_up` needs for `count` residuals."""
    return (count + 15) // 16 * 16


@numba.njit(**FAST)
def step(T, middle, H, g, count):
    """Solve, limit the turn, move T in place; H is overwritten, g becomes the twist about the moved `middle`."""
    for a in range(3):
        H[a, a] += 1e-4 * count
        H[a + 3, a + 3] += 1e-4 * H[a + 3, a + 3] + 1.0
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
    """Solve A x = b in place, A symmetric and positive definite: Cholesky on its lower triangle, x stands in b.

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
    """Rodrigues' formula for a rotation vector of known length."""
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
    """(N,) signed distances (NaN beyond the field), (N, 3) gradients, (N,) distances aside, (N,) elements."""
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
    """Indices of at most `most` poses, in `order`, each farther than `tolerance` (rms) from those before it.

    `moved_points` (K, P, 3) are the same few source points under every pose.
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
