"""Compiled loops of the geometry of pairs: point-wise features, and places and influences of KPConv.

They say what `pgf.embed`, `backbone.kpconv.surface_places` and `influences` say, to rounding. Neighbours are taken in
chunks of one scratch array with distances known to the compiler, so that it can work on several at a time.
"""

# mypy: ignore-errors
from __future__ import annotations

import numba
import numpy as np

FAST = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}
CHUNK = 16
ZERO, ONE, TWO, HALF = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(0.5)
TINY, FADE, FADE_SINE, POINT = np.float32(1e-12), np.float32(1e-10), np.float32(1e-8), np.float32(2e-4)
X, Y, Z = 11 * CHUNK, 12 * CHUNK, 13 * CHUNK  # where the neighbours lie in the scratch array, behind the features


@numba.njit(**FAST)
def embed(p_i, p_j, c_h, c_k, radius, out):
    """Fill out (N, K, 11).

    Args:
        p_i, c_h, c_k: (N, 3), of the queries. radius: (N,).
        p_j: (N or B, K, 3), neighbours of every query, or of all N / B queries of each of B clouds.
    """
    s = np.zeros(14 * CHUNK, np.float32)
    each, keys = len(p_i) // max(len(p_j), 1), p_j.shape[1]
    for n in range(len(p_i)):
        own = p_j[n // each]
        by = ONE / radius[n]
        x, y, z = p_i[n, 0], p_i[n, 1], p_i[n, 2]
        h = (c_h[n, 0] - x) * by, (c_h[n, 1] - y) * by, (c_h[n, 2] - z) * by
        k = (c_k[n, 0] - x) * by, (c_k[n, 1] - y) * by, (c_k[n, 2] - z) * by
        for begin in range(0, keys, CHUNK):
            some = min(CHUNK, keys - begin)
            for j in range(some):
                s[X + j] = (own[begin + j, 0] - x) * by
                s[Y + j] = (own[begin + j, 1] - y) * by
                s[Z + j] = (own[begin + j, 2] - z) * by
            chunk(s, h, k)
            for j in range(some):
                for i in range(11):
                    out[n, begin + j, i] = s[i * CHUNK + j]


@numba.njit(**FAST)
def chunk(s, h, k):
    """The features of one chunk of neighbours, seen from the query in radii."""
    hx, hy, hz = h
    kx, ky, kz = k
    ax, ay, az = ky * hz - kz * hy, kz * hx - kx * hz, kx * hy - ky * hx  # k x h
    aa, axis = ax * ax + ay * ay + az * az, kx * kx + ky * ky + kz * kz
    length, side = np.sqrt(axis + TINY), axis + hx * hx + hy * hy + hz * hz + POINT
    for j in range(CHUNK):
        x, y, z = s[X + j], s[Y + j], s[Z + j]
        ux, uy, uz = hx - x, hy - y, hz - z
        vx, vy, vz = kx - x, ky - y, kz - z
        ii, hh, kk = x * x + y * y + z * z, ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz
        s[j], s[CHUNK + j], s[2 * CHUNK + j] = np.sqrt(ii + TINY), np.sqrt(hh + TINY), np.sqrt(kk + TINY)
        nx, ny, nz = y * vz - z * vy, z * vx - x * vz, x * vy - y * vx
        sides = ii + kk + POINT
        faded = FADE * sides * sides
        scale = ONE / np.sqrt(ii * kk + faded)
        s[3 * CHUNK + j] = np.sqrt(nx * nx + ny * ny + nz * nz + FADE_SINE * faded) * scale
        s[4 * CHUNK + j] = -(x * vx + y * vy + z * vz) * scale
        nx, ny, nz = y * uz - z * uy, z * ux - x * uz, x * uy - y * ux
        sides = ii + hh + POINT
        faded = FADE * sides * sides
        scale = ONE / np.sqrt(ii * hh + faded)
        s[5 * CHUNK + j] = np.sqrt(nx * nx + ny * ny + nz * nz + FADE_SINE * faded) * scale
        s[6 * CHUNK + j] = -(x * ux + y * uy + z * uz) * scale
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        sides = hh + kk + POINT
        faded = FADE * sides * sides
        scale = ONE / np.sqrt(hh * kk + faded)
        s[7 * CHUNK + j] = np.sqrt(nx * nx + ny * ny + nz * nz + FADE_SINE * faded) * scale
        s[8 * CHUNK + j] = (ux * vx + uy * vy + uz * vz) * scale
        nx, ny, nz = ky * z - kz * y, kz * x - kx * z, kx * y - ky * x  # k x j
        sides = side * (axis + ii + POINT)
        scale = ONE / np.sqrt(aa * (nx * nx + ny * ny + nz * nz) + FADE * sides * sides)
        s[9 * CHUNK + j] = length * (ax * x + ay * y + az * z) * scale
        s[10 * CHUNK + j] = (ax * nx + ay * ny + az * nz) * scale


@numba.njit(**FAST)
def surface_influences(points, normals, certainty, support, facing, index, valid, reach, kernel, sigma, out):
    """Fill out (N, P, K), influences of P kernel points on the neighbours' places in the frame of the surface.

    Args:
        points, normals: (N, 3) of the centres. certainty, reach: (N,).
        support, facing: (M, 3) points and normals that `index` (N, K) points to. valid: (N, K).
        kernel: (P, 3). sigma: reach of a kernel point, in `reach`.
    """
    s = np.zeros(6 * CHUNK, np.float32)
    for n in range(len(points)):
        nx, ny, nz, unit = normals[n, 0], normals[n, 1], normals[n, 2], ONE / reach[n]
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        for begin in range(0, index.shape[1], CHUNK):
            some = min(CHUNK, index.shape[1] - begin)
            for j in range(some):
                m = index[n, begin + j]
                s[j] = (support[m, 0] - x) * unit
                s[CHUNK + j] = (support[m, 1] - y) * unit
                s[2 * CHUNK + j] = (support[m, 2] - z) * unit
                s[3 * CHUNK + j] = nx * facing[m, 0] + ny * facing[m, 1] + nz * facing[m, 2]
                s[4 * CHUNK + j] = ONE if valid[n, begin + j] else ZERO
            surface_places(s, nx, ny, nz, certainty[n])
            for k in range(len(kernel)):
                influence(s, kernel[k, 0], kernel[k, 1], kernel[k, 2], ONE / sigma)
                for j in range(some):
                    out[n, k, begin + j] = s[5 * CHUNK + j]


@numba.njit(**FAST)
def surface_places(s, nx, ny, nz, certainty):
    """Offsets of a chunk of neighbours to their places in the frame of the surface, in place; see `kpconv`."""
    for j in range(CHUNK):
        x, y, z = s[j], s[CHUNK + j], s[2 * CHUNK + j]
        height = x * nx + y * ny + z * nz
        s[j] = TWO * height * certainty
        s[CHUNK + j] = TWO * np.sqrt(max(x * x + y * y + z * z - height * height, TINY)) - ONE
        s[2 * CHUNK + j] = TWO * np.abs(height) + HALF - np.abs(s[3 * CHUNK + j])


@numba.njit(**FAST)
def influence(s, a, b, c, by):
    """The influence of the kernel point (a, b, c) on a chunk of places, behind them."""
    for j in range(CHUNK):
        x, y, z = s[j] - a, s[CHUNK + j] - b, s[2 * CHUNK + j] - c
        s[5 * CHUNK + j] = s[4 * CHUNK + j] * max(ONE - np.sqrt(x * x + y * y + z * z) * by, ZERO)
