"""The physical limit: no unbiased registration of these points can be better (Cramer-Rao bound of the pose).

A source point with white noise of sigma per axis says only how far it is off the surface (Censi 2007; Simon's
constraint analysis). Its information on the pose is J^T J / sigma^2 with rows J = [n, (p - c) x n].
Smooth bias and outliers are not noise of this kind: with them the limit is out of reach.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from gapr_core.geometry import se3
from gapr_core.geometry.twists import distance_jacobian, predicted_rmse_mm

Array = NDArray[np.float64]
NEIGHBOURS = 12  # target points that give a normal


class PoseBound(NamedTuple):
    """Smallest covariance (6, 6) of the error twist about `centre` (target frame), and its RMSE over the source."""

    covariance: Array
    centre: Array
    rmse_mm: float


def pose_bound(
    source: ArrayLike, target: ArrayLike, T_true: ArrayLike, sigma_mm: float, normals: ArrayLike | None = None
) -> PoseBound | None:
    """Cramer-Rao bound of one pair, from its truth.

    Args:
        source: (N, 3) noisy points, mm. Those farther than 4 sigma + 0.5 mm from the surface are outliers and left out.
        target: (M, 3) points of the surface, mm.
        T_true: (4, 4) T_target_source.
        sigma_mm: standard deviation of the noise per axis.
        normals: (M, 3) of the target; estimated from its neighbours when None.

    Returns:
        None when no bound exists: no noise, too few points, or a motion that the points cannot see (a sphere, a shaft).
    """
    moved, target = se3.apply(T_true, source), np.asarray(target, dtype=np.float64)
    tree = cKDTree(target)
    nearest = tree.query(moved)[1]
    normals = local_normals(target, target[nearest], tree) if normals is None else np.asarray(normals)[nearest]
    off_surface = np.abs(((moved - target[nearest]) * normals).sum(axis=1))
    usable = off_surface < 4.0 * sigma_mm + 0.5
    if sigma_mm <= 0.0 or usable.sum() < 6:
        return None
    return _bound(moved, normals, usable, sigma_mm)


def local_normals(points: ArrayLike, queries: ArrayLike, tree: cKDTree | None = None) -> Array:
    """(K, 3) unit normals (either sign) of a cloud (M, 3) at queries (K, 3): least axis of the nearest 12 points."""
    points = np.asarray(points, dtype=np.float64)
    neighbours = points[(tree or cKDTree(points)).query(np.asarray(queries), k=min(NEIGHBOURS, len(points)))[1]]
    centred = neighbours - neighbours.mean(axis=1, keepdims=True)
    return np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))[1][:, :, 0]


def _bound(moved: Array, normals: Array, usable: NDArray[np.bool_], sigma_mm: float) -> PoseBound | None:
    centre = moved.mean(axis=0)
    # rotations in units that weigh like translations
    size = np.sqrt(((moved[usable] - centre) ** 2).sum(axis=1).mean())
    rows = distance_jacobian(moved[usable], normals[usable], centre) / np.repeat([1.0, size], 3)
    information = rows.T @ rows / sigma_mm**2
    if np.linalg.cond(information) > 1e10:
        return None
    unit = np.r_[np.ones(3), np.full(3, 1.0 / size)]
    covariance = np.linalg.inv(information) * np.outer(unit, unit)
    return PoseBound(covariance, centre, predicted_rmse_mm(covariance, moved, centre))
