"""Errors of a real acquisition: density, noise, smooth bias, outliers. In mm, seeded."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.smooth_bias import SMOOTH_BIASES
from gapr_core.data.specimen import Specimen
from gapr_core.geometry.sampling import random_directions

Array = NDArray[np.float64]
ROUNDS = 6  # balls whose density is changed


def half_edge_mm(points: Array) -> float:
    """Half the longest edge of the axis-aligned box of (N, 3): the paper's normalisation scale."""
    return float(np.ptp(points, axis=0).max() / 2.0)


def vary_density(points: Array, scale: float, rng: np.random.Generator) -> Array:
    """Paper, section III: thin out or fill up balls of 0.10-0.15 x `scale` (`half_edge_mm`) around random points.

    Thinning discards half of a ball. Filling adds half as many points again, each alpha p1 + (1 - alpha) p2 of two
    points of the ball. Either comes with even chance, `ROUNDS` times (the paper says "multiple").
    """
    for _ in range(ROUNDS):
        centre, radius = points[rng.integers(len(points))], scale * rng.uniform(0.10, 0.15)
        inside = np.flatnonzero(((points - centre) ** 2).sum(axis=1) < radius**2)
        if rng.random() < 0.5:
            points = np.delete(points, rng.choice(inside, len(inside) // 2, replace=False), axis=0)
        else:
            first, second = points[rng.choice(inside, (2, (len(inside) + 1) // 2))]
            alpha = rng.random((len(first), 1))
            points = np.vstack([points, alpha * first + (1.0 - alpha) * second])
    return points


def measured(
    specimen: Specimen,
    points: Array,
    normals: Array,
    noise_mm: float,
    bias_mm: float,
    outlier_share: float,
    rng: np.random.Generator,
    smooth_bias: str = "waves-peak",
) -> Array:
    """Add white noise and smooth bias to surface points (N, 3), and throw off a share, the last ones then."""
    outliers = round(outlier_share * len(points))
    dirty = points + rng.normal(0.0, noise_mm, points.shape)
    if bias_mm:
        dirty += bias_along_normals(points, normals, bias_mm, rng, smooth_bias)
    return np.vstack([dirty[outliers:], scatter_outliers(specimen, points[:outliers], normals[:outliers], rng)])


def bias_along_normals(
    points: Array, normals: Array, size_mm: float, rng: np.random.Generator, smooth_bias: str = "waves-peak"
) -> Array:
    """(N, 3) offsets along the normals, mm, from a smooth field of `smooth_bias.SMOOTH_BIASES`.

    With "waves-peak" `size_mm` is the largest absolute offset over exactly these points: "a 1 mm bias" is nowhere more
    than 1 mm. (Taken as a root mean square, refinement from the truth itself would fail on a tenth of L2 and four
    tenths of L3.)
    """
    return normals * SMOOTH_BIASES[smooth_bias](points, size_mm, rng)[:, None]


def scatter_outliers(
    specimen: Specimen,
    points: Array,
    normals: Array,
    rng: np.random.Generator,
    nearest_mm: float = 3.0,
    farthest_mm: float = 15.0,
) -> Array:
    """Surface points (K, 3) thrown U[3, 15] mm outward or inward, askew, again until 3 mm off the whole surface."""
    outliers, pending = points.copy(), np.arange(len(points))
    for _ in range(50):
        if not len(pending):
            break
        reach = rng.uniform(nearest_mm, farthest_mm, (len(pending), 1))
        sign = rng.choice([-1.0, 1.0], (len(pending), 1))
        away = sign * normals[pending] + 0.7 * random_directions(len(pending), rng)
        outliers[pending] = points[pending] + reach * away / np.linalg.norm(away, axis=1, keepdims=True)
        pending = pending[specimen.distance(outliers[pending]) < nearest_mm]
    return np.delete(outliers, pending, axis=0)
