"""Where a model ends in a plane: the border of a scan, a planned cut, a scanner's table. No bone is as flat."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, cKDTree

from gapr_core.geometry import extent

Array = NDArray[np.float64]

THIN_MM = 0.05  # a layer as thin as what a smoothed or a binary segmentation leaves of a plane
THICK_MM = 0.25  # another; a sphere has five times as many points in it, a cylinder more than twice
LEAST_SHARE = 0.67  # of the points of the thick layer that the thin one of a plane holds
RIM_MM = 2.0  # depth to which the rounded edge of an end goes with it
LEAST_COS = 0.8  # of the angle between the normals of this edge and that of the plane
STAIRS_MM = 4.0  # depth in which a step of voxels is followed by others that face the same way
MOST_STAIRS = 1.5  # times the points of an end may face the same way in this depth
OF_POINT = 2.0  # area of an evenly thinned point over the square of the median distance to the nearest
FEWEST = 10  # points of an end
HIGHEST = 0.95  # share of an end's points that its plane is above
STEPS = 100  # normals of facets are those of one plane where they agree to 1 / STEPS
SPLIT = 0.25  # share of its area that the facets of an end have at least, should rounding split them
MOST_ENDS = 24  # a table has six


def flat_ends(points: Array, normals: Array, spacing_mm: float, least_mm2: float) -> NDArray[np.bool_]:
    """Find the points that lie on a flat end, or on its rounded edge.

    A flat end is a facet of the convex hull with points of the model all over an area of `least_mm2` or more. The rest
    is looked at again: behind the outer face of a table is the inner.

    Args:
        points: (N, 3) mm, evenly spread.
        normals: (N, 3) unit, outward.
        spacing_mm: median distance of a point to the nearest.
        least_mm2: smallest area of an end; smaller ones are as flat by chance.

    Returns:
        (N,) bool.
    """
    on_end = np.zeros(len(points), dtype=bool)
    for _ in range(MOST_ENDS):
        left = np.flatnonzero(~on_end)
        if len(left) < FEWEST or np.linalg.eigvalsh(np.cov(points[left].T))[0] < THIN_MM**2:
            break  # no body is left
        found = _end_of(points[left], normals[left], spacing_mm, least_mm2)
        if found is None:
            break
        on_end[left[found]] = True
    return on_end


def _end_of(points: Array, normals: Array, spacing_mm: float, least_mm2: float) -> NDArray[np.bool_] | None:
    """Find the points of one flat end; None without one."""
    fewest = max(FEWEST, least_mm2 / (OF_POINT * spacing_mm**2))
    for outward in _supported(points, spacing_mm, SPLIT * least_mm2):
        height = points @ outward
        near = height > height.max() - THICK_MM
        if np.count_nonzero(near) < fewest:
            continue
        normal = extent.principal(points[near]).axes[2]
        height = points @ (normal if normal @ outward > 0.0 else -normal)
        depth = np.quantile(height[near], HIGHEST) - height
        thin, thick = (np.count_nonzero(depth < limit) for limit in (THIN_MM, THICK_MM))
        faces_it = normals @ outward > LEAST_COS
        stairs = np.count_nonzero(faces_it & (depth < STAIRS_MM))
        if thin >= max(fewest, LEAST_SHARE * thick, stairs / MOST_STAIRS):
            return (depth < THIN_MM) | (faces_it & (depth < RIM_MM))
    return None


def _supported(points: Array, spacing_mm: float, least_mm2: float) -> Array:
    """(K, 3) outward normals of facets of the convex hull that lie on points; of this area together, largest first."""
    hull = ConvexHull(points)
    corners = points[hull.simplices]
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    lies_on = cKDTree(points).query(corners.mean(axis=1))[0] < 1.5 * spacing_mm
    outward, areas = hull.equations[lies_on, :3], areas[lies_on]
    kind = np.unique((STEPS * outward).round(), axis=0, return_inverse=True)[1].reshape(-1)
    total = np.bincount(kind, areas)
    normals = np.column_stack([np.bincount(kind, areas * each) for each in outward.T])
    order = np.argsort(-total)[: np.count_nonzero(total >= least_mm2)]
    return np.asarray(normals[order] / np.linalg.norm(normals[order], axis=1, keepdims=True))
