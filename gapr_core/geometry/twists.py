"""Small motions of a pose: error twists, their distance under a covariance, and their effect on points.

A twist is x y z (mm) rx ry rz (rad) in fixed axes of the target frame, rotation about a named centre: the coordinates
of `RegistrationResult.covariance`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation
from scipy.special import gammaincinv

from gapr_core.geometry import se3

Array = NDArray[np.float64]


def error_twist(T_estimate: ArrayLike, T_true: ArrayLike, source: ArrayLike) -> Array:
    """(6,) x y z (mm) rx ry rz (rad): how the estimate has moved the source, target frame, about its true centroid.

    `se3.exp(twist, centre) @ T_true == T_estimate` with the centre at T_true x centroid.
    """
    centroid = np.mean(np.asarray(source, dtype=np.float64), axis=0, keepdims=True)
    shift = se3.apply(T_estimate, centroid)[0] - se3.apply(T_true, centroid)[0]
    rotation = np.asarray(T_estimate)[:3, :3] @ np.asarray(T_true)[:3, :3].T
    return np.r_[shift, Rotation.from_matrix(rotation).as_rotvec()]


def nees(twist: ArrayLike, covariance: ArrayLike) -> float:
    """Normalised estimation error squared, e^T C^-1 e; its expectation is 6 for an honest covariance (6, 6).

    Solved in coordinates of unit variance, so that mm and rad do not spoil the conditioning.
    """
    covariance = np.asarray(covariance, dtype=np.float64)
    scale = np.sqrt(np.diag(covariance))
    error = np.asarray(twist, dtype=np.float64) / scale
    return float(error @ np.linalg.solve(covariance / np.outer(scale, scale), error))


def covariance_about(offset: ArrayLike, covariance: ArrayLike) -> Array:
    """Move the centre of a (6, 6) covariance of a pose by `offset` (3,), mm.

    A turn r about c shifts c + d by r x d: the shift of the new centre is v - d x r.
    """
    x, y, z = np.asarray(offset, dtype=np.float64)
    move = np.eye(6)
    move[:3, 3:] = -np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(move @ np.asarray(covariance) @ move.T)


def motion_jacobians(points: ArrayLike, centre: ArrayLike) -> Array:
    """(N, 3, 6) derivative of each moved point (target frame) by the twist about `centre`: [I, -[p - c]x]."""
    x, y, z = (np.asarray(points, dtype=np.float64) - np.asarray(centre)).T
    jacobian = np.zeros((len(x), 3, 6))
    jacobian[:, :, :3] = np.eye(3)
    jacobian[:, 0, 4], jacobian[:, 0, 5] = z, -y
    jacobian[:, 1, 3], jacobian[:, 1, 5] = -z, x
    jacobian[:, 2, 3], jacobian[:, 2, 4] = y, -x
    return jacobian


def distance_jacobian(points: Array, normals: Array, centre: Array) -> Array:
    """(N, 6) derivative of the signed distances of points (N, 3) by the twist about `centre`: [n, (p - c) x n].

    Args:
        points: in the target frame, mm.
        normals: (N, 3) unit normals of the surface at their foot points.
        centre: (3,) mm.
    """
    return np.hstack([normals, np.cross(points - centre, normals)])


def mean_square(points: Array, centre: Array) -> Array:
    """(6, 6) A with TRE^2 = e^T A e over points (M, 3): of their mean m and second moments S about the centre.

    With [m]x the matrix of a cross product, A = [I, -[m]x; [m]x, tr(S) I - S].
    """
    offsets = points - centre
    x, y, z = offsets.mean(axis=0)
    S = offsets.T @ offsets / len(points)
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.block([[np.eye(3), -across], [across, np.trace(S) * np.eye(3) - S]])


def predicted_rmse_mm(covariance: Array, points: Array, centre: Array) -> float:
    """Root-mean-square error over points (M, 3), mm, under a pose covariance (6, 6) about `centre` (3,)."""
    return float(np.sqrt(np.trace(mean_square(points, centre) @ covariance)))


def bound_mm(covariance: Array, points: Array, centre: Array, quantile: float = 0.95) -> float:
    """Bound the error over points (M, 3), mm, with probability `quantile`; one point for a single target.

    With A of `mean_square` and a normal error of covariance C, TRE^2 is a weighted sum of chi-square variables. Its
    mean is tr(A C) (Fitzpatrick 1998). The quantile is that of the scaled chi-square with the same mean and variance
    (Satterthwaite 1946).
    """
    product = mean_square(points, centre) @ covariance
    mean, variance = np.trace(product), 2.0 * np.trace(product @ product)
    scale, freedom = variance / (2.0 * mean), 2.0 * mean**2 / variance
    chi_square = 2.0 * gammaincinv(freedom / 2.0, quantile)  # as `scipy.stats.chi2.ppf`, which takes long to import
    return float(np.sqrt(scale * chi_square))
