"""Compiled loop that draws triangles: which face each pixel shows, and where on it."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def rasterised(corners, height, width):  # type: ignore[no-untyped-def]
    """Find the face that each pixel shows, nearest to the eye; -1 where there is none.

    Args:
        corners: (F, 3, 3) column, row and height towards the eye of each corner of each face, in pixels.
        height, width: size of the picture.

    Returns:
        (height, width) faces, and (height, width, 3) weights of their corners.
    """
    faces = np.full((height, width), -1, np.int64)
    weights, top = np.zeros((height, width, 3)), np.full((height, width), -np.inf)
    for f in range(len(corners)):
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = corners[f, 0], corners[f, 1], corners[f, 2]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0:
            continue
        for y in range(max(0, int(np.ceil(min(ay, by, cy)))), min(height - 1, int(max(ay, by, cy))) + 1):
            for x in range(max(0, int(np.ceil(min(ax, bx, cx)))), min(width - 1, int(max(ax, bx, cx))) + 1):
                v = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / area
                w = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / area
                z = az + v * (bz - az) + w * (cz - az)
                if v >= 0.0 and w >= 0.0 and v + w <= 1.0 and z > top[y, x]:
                    top[y, x], faces[y, x] = z, f
                    weights[y, x, 0], weights[y, x, 1], weights[y, x, 2] = 1.0 - v - w, v, w
    return faces, weights
