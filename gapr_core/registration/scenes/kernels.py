"""Compiled inner loops for clouds that are mostly not bone: lines of sight, and refinement where normals agree."""

# mypy: ignore-errors
from __future__ import annotations

import numba
import numpy as np

from gapr_core.registration.fit.block_kernels import accumulate
from gapr_core.registration.fit.kernels import step
from gapr_core.registration.fit.surface_kernels import FAST, element_near, moved

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
    trust, H, g = np.empty(len(points)), np.empty((6, 6)), np.empty(6)
    middle = np.array([points[:, 0].mean(), points[:, 1].mean(), points[:, 2].mean()])
    for k in range(len(poses)):
        T = out[k]
        for i in range(len(limits)):
            agreeing(T, points, normals, signed, elements, nearest, origin, per_cell, same, trust)
            surface = elements, nearest, origin, per_cell, spacing
            accumulate(T, points, trust, middle, *surface, limits[i, 0], 0.0, H, g, limits[i, 1])
            weight = H[0, 0] + H[1, 1] + H[2, 2]  # their sum, as gradients have unit length
            if weight > 0.0:
                step(T, middle, H, g, weight)
    return out


@numba.njit(**FAST)
def agreeing(T, points, normals, signed, elements, nearest, origin, per_cell, same, trust):
    """Set `trust` (N,) to 1 where a normal agrees with that of the element near its point, else to 0."""
    for p in range(len(points)):
        x, y, z = moved(T, points[p])
        q = element_near(x, y, z, nearest, origin, per_cell)
        n = normals[p]
        ux = T[0, 0] * n[0] + T[0, 1] * n[1] + T[0, 2] * n[2]
        uy = T[1, 0] * n[0] + T[1, 1] * n[1] + T[1, 2] * n[2]
        uz = T[2, 0] * n[0] + T[2, 1] * n[1] + T[2, 2] * n[2]
        cosine = ux * elements[q, 3] + uy * elements[q, 4] + uz * elements[q, 5]
        trust[p] = 1.0 if cosine >= same or (not signed and cosine <= -same) else 0.0
