"""Who is like whom: near-duplicates among subjects, and the most similar bones of others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gapr_core.data import scans
from gapr_core.data.anatomy import Corresponded
from gapr_core.data.specimen import Specimen

Array = NDArray[np.float64]
SUSPICIOUS = 0.5  # of the median distance to the most similar other subject of the cohort
COMPARED = 500  # vertices of each mesh that are compared


class Twins(NamedTuple):
    """Two subjects whose bones differ by `rms_mm` only; `typical_mm` is usual between most similar subjects."""

    first: str
    second: str
    rms_mm: float
    typical_mm: float


def near_duplicates(subjects: Corresponded) -> list[Twins]:
    """Pairs of subjects who may be one and the same, scanned twice or mirrored, the most similar first."""
    if len(subjects.points) < 3:
        return []
    points = subjects.points[:, :: max(1, subjects.points.shape[1] // COMPARED)]
    points = points - points.mean(axis=1, keepdims=True)
    apart = np.full((len(points),) * 2, np.inf)
    for i, j in combinations(range(len(points)), 2):
        apart[i, j] = apart[j, i] = min(_rms(points[i], points[j] * side) for side in ([1, 1, 1], [-1, 1, 1]))
    typical = float(np.median(apart.min(axis=1)))
    found = [
        Twins(subjects.person[i], subjects.person[j], float(apart[i, j]), typical)
        for i, j in combinations(range(len(points)), 2) if apart[i, j] < SUSPICIOUS * typical
    ]  # fmt: skip
    return sorted(found, key=lambda twins: twins.rms_mm)


def most_similar(specimen: Specimen, others: Sequence[Specimen], count: int) -> list[Specimen]:
    """Rank the same bones of others by shape, grown to the specimen's size; the nearest first.

    Only bones of its cohort whose vertices correspond to its own are compared, so there may be fewer than `count`.
    """
    own = specimen.surface.points
    alike = [o for o in others if (o.bone, o.cohort) == (specimen.bone, specimen.cohort)
             and o.person != specimen.person and len(o.surface.points) == len(own)]  # fmt: skip
    fits = [without_size(o.surface.points, own) for o in alike]
    nearest = sorted(range(len(alike)), key=lambda i: fits[i][0])[:count]
    return [replace(alike[i], surface=scans.of_size(fits[i][1])(alike[i].surface)) for i in nearest]


def without_size(points: Array, others: Array) -> tuple[float, float]:
    """Measure how far corresponding points (N, 3) stay apart after the best similarity, and its factor.

    The distance is a share of the others' size (Procrustes; Umeyama 1991).
    """
    p, q = (each - each.mean(axis=0) for each in (points, others))
    along = _along(p, q)
    size = along / float((p * p).sum())
    return float(np.sqrt(max(1.0 - size * along / float((q * q).sum()), 0.0))), size


def _rms(p: Array, q: Array) -> float:
    """Root mean square distance of corresponding points (N, 3), centred, after the best rotation of one of them."""
    return float(np.sqrt(max((p * p).sum() + (q * q).sum() - 2.0 * _along(p, q), 0.0) / len(p)))


def _along(p: Array, q: Array) -> float:
    """Sum of the products of corresponding points (N, 3), centred, after the rotation that makes it largest."""
    u, s, vt = np.linalg.svd(p.T @ q)
    return float(s[0] + s[1] + np.sign(np.linalg.det(u @ vt)) * s[2])
