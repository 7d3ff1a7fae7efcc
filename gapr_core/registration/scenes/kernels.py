"""Compiled inner loops for clouds that are mostly not bone: lines of sight, and refinement where normals agree."""

# mypy: ignore-errors
from __future__ import annotations

import numba
import numpy as np

from gapr_core.registration.fit.kernels import step
from gapr_core.registration.fit.surface_kernels import FAST, element_near, moved, padded, residual, tukey

OFFSET, DEPTH, FRONT = 3, 4, 5  # columns of a pixel after its normal, as in `free_space.DepthImage`


@numba.njit(**FAST)
def compare_with_image(
    poses, cloud, pixels, left, top, per_pixel, on_mm, front_mm, facing_cos, hidden_mm, slant_mm, same_surface_cos
):
    """Compute shares of a target (M, 6) explained, violating, compared, under poses (K, 3, 4) T_camera_target.

    All float32. A point is explained when it faces the camera, lies within `on_mm` of the plane measured on its line of
    sight and has its normal. It violates when it lies `front_mm` in front of every measurement around there.
    """
    rows, columns = pixels.shape[0], pixels.shape[1]
    out = np.zeros((len(poses), 3), dtype=np.float32)
    for k in range(len(poses)):
        T = poses[k]
        explained, violating, compared = np.float32(0.0), 0, 0
        for m in range(len(cloud)):
            x, y, z = cloud[m, 0], cloud[m, 1], cloud[m, 2]
            depth = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            if depth < np.float32(1.0):
                continue
            ahead = np.float32(1.0) / depth
            right = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
            j = int(np.floor((right * ahead - left) * per_pixel + np.float32(0.5)))
            if j < 0 or j >= columns:
                continue
            down = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
            i = int(np.floor((down * ahead - top) * per_pixel + np.float32(0.5)))
            if i < 0 or i >= rows:
                continue
            seen = pixels[i, j]
            if seen[DEPTH] == np.float32(0.0):
                continue
            if depth < seen[FRONT] - front_mm:
                violating += 1
            x, y, z = cloud[m, 3], cloud[m, 4], cloud[m, 5]
            nx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z
            ny = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z
            nz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z
            towards = nx * right + ny * down + nz * depth
            if towards > -facing_cos * depth:
                continue
            off = seen[0] * right + seen[1] * down + seen[2] * depth - seen[OFFSET]
            if depth < seen[DEPTH] + hidden_mm and depth > seen[FRONT] - front_mm:
                compared += 1
            if abs(off) < on_mm and abs(depth - seen[DEPTH]) < slant_mm:
                same = nx * seen[0] + ny * seen[1] + nz * seen[2]
                if same > same_surface_cos:
                    off /= on_mm
                    explained += np.float32(1.0) - off * off
        out[k, 0], out[k, 1], out[k, 2] = explained, violating, compared
    return out / np.float32(len(cloud))


@numba.njit(**FAST)
def refine_agreeing(poses, points, normals, signed, elements, nearest, origin, per_cell, spacing, limits, same):
    """Iterate Gauss-Newton from every pose (K, 4, 4) on the points (N, 3) whose normals agree with the surface.

    One iteration per row of `limits` (I, 2), the Tukey scales of points inside and outside of the surface. Normals (N,
    3) agree from the cosine `same`.
    """
    out = poses.copy()
    surface = elements, nearest, origin, per_cell, spacing
    rows, H, g = np.empty((7, padded(len(points)))), np.empty((6, 6)), np.empty(6)
    middle = np.array([points[:, 0].mean(), points[:, 1].mean(), points[:, 2].mean()])
    for k in range(len(poses)):
        T = out[k]
        for i in range(len(limits)):
            weight = accumulate_agreeing(T, points, normals, signed, *surface, limits[i], same, middle, rows, H, g)
            if weight > 0.0:
                step(T, middle, H, g, weight)
    return out


@numba.njit(**FAST)
def accumulate_agreeing(
    T, points, normals, signed, elements, nearest, origin, per_cell, spacing, limits, same, middle, rows, H, g
):
    """Fill the normal equations H twist = g about the moved `middle` (3,); returns the sum of the weights."""
    middle = moved(T, middle)
    count, total = 0, 0.0
    for p in range(len(points)):
        x, y, z = moved(T, points[p])
        q = element_near(x, y, z, nearest, origin, per_cell)
        if q < 0:
            continue
        n = normals[p]
        ux = T[0, 0] * n[0] + T[0, 1] * n[1] + T[0, 2] * n[2]
        uy = T[1, 0] * n[0] + T[1, 1] * n[1] + T[1, 2] * n[2]
        uz = T[2, 0] * n[0] + T[2, 1] * n[1] + T[2, 2] * n[2]
        cosine = ux * elements[q, 3] + uy * elements[q, 4] + uz * elements[q, 5]
        if cosine < same and (signed or cosine > -same):
            continue
        r, nx, ny, nz, aside = residual(x, y, z, q, elements, spacing, 0.0)
        w = tukey(r * r + aside * aside, limits[1] if r > 0.0 else limits[0])
        total += w
        put_row(rows, count, w, x, y, z, middle, r, nx, ny, nz)
        count += 1
    normal_equations(rows, count, H, g)
    return total


@numba.njit(inline="always", **FAST)
def put_row(rows, i, w, x, y, z, middle, r, nx, ny, nz):
    """Fill column i of `rows`: derivatives of a residual r by the twist about `middle` (3), and r, times root w."""
    root = np.sqrt(w)
    nx, ny, nz = root * nx, root * ny, root * nz
    x, y, z = x - middle[0], y - middle[1], z - middle[2]
    rows[0, i], rows[1, i], rows[2, i] = nx, ny, nz
    rows[3, i], rows[4, i], rows[5, i] = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx
    rows[6, i] = root * r


@numba.njit(**FAST)
def normal_equations(rows, count, H, g):
    """Compute the normal equations (6, 6) and (6,) of the first `count` columns of `rows` (7, N), in place.

    One product of whole, padded rows after the other, so that the compiler takes several columns at a time.
    """
    columns = padded(count)
    rows[:, count:columns] = 0.0
    for a in range(6):
        total = 0.0
        for p in range(columns):
            total -= rows[a, p] * rows[6, p]
        g[a] = total
        for b in range(a + 1):
            total = 0.0
            for p in range(columns):
                total += rows[a, p] * rows[b, p]
            H[a, b] = H[b, a] = total
