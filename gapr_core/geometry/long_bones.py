"""Find several long bones in one mesh, which a rigid registration takes for one body."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapr_core.geometry import extent

Array = NDArray[np.float64]

LEAST_AREA = 0.25  # of the largest part's; below it is a fibula, a patella or debris
MOST_BONES = 4  # more are a rib cage, a hand or a foot
LEAST_SLENDERNESS = 3.0  # spread along the long axis over that across; hip bones, sacra and vertebrae have less


def separate_long_bones(points: Array, faces: NDArray[np.int64], areas: Array) -> list[float]:
    """Lengths, mm, of the long bones in a mesh where these are several; empty where it is of one body.

    A pelvis in three parts, a rib cage, both cortices of a hollow bone and debris are of one body. Two bones whose
    surfaces share a vertex count as one.

    Args:
        points: (N, 3) vertices, mm.
        faces: (F, 3) vertex indices.
        areas: (F,) of the triangles, mm^2.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges = faces[:, [0, 1]], faces[:, [1, 2]]
    first, second = (np.concatenate([edge[:, end] for edge in edges]) for end in (0, 1))
    linked = coo_array((np.ones(len(first), dtype=np.int8), (first, second)), shape=(len(points), len(points)))
    part = connected_components(linked, directed=False)[1]
    area = np.bincount(part[faces[:, 0]], areas)
    large = np.flatnonzero(area >= LEAST_AREA * area.max())
    if not 2 <= len(large) <= MOST_BONES:
        return []
    bones = [points[part == each] for each in large]
    if any(_slenderness(bone) < LEAST_SLENDERNESS for bone in bones) or _some_nested(bones):
        return []
    return [float(np.ptp(bone @ extent.principal(bone).axes[0])) for bone in bones]


def _slenderness(points: Array) -> float:
    variances = extent.principal(points).variances
    return float(np.sqrt(variances[0] / max(variances[1], 1e-12)))


def _some_nested(bones: list[Array]) -> bool:
    """Check whether the mean of one lies in the box of another, as that of an inner cortex does."""
    return any(_holds(bone, other.mean(axis=0)) for bone in bones for other in bones if other is not bone)


def _holds(bone: Array, point: Array) -> bool:
    axes = extent.principal(bone).axes
    along = bone @ axes.T
    return bool(((along.min(axis=0) <= axes @ point) & (axes @ point <= along.max(axis=0))).all())
