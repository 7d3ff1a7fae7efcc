"""Between the core (mm, T_target_source) and ROS (metres, T_cloud_model): the only place that converts.

The target is the model (pre-operative bone), the source is the cloud: T_cloud_model is the inverse of T_target_source.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from gapr_core.clouds import MM_PER_UNIT
from gapr_core.geometry import se3

Array = NDArray[np.float64]
Length = TypeVar("Length", Array, float)
MM_PER_M = MM_PER_UNIT["m"]


def to_mm(points: Array, unit: str) -> Array:
    """Points in `unit` (m, cm or mm) as mm."""
    return points * MM_PER_UNIT[unit]


def to_metres(lengths_mm: Length) -> Length:
    """Points, or one length, in mm as metres."""
    return lengths_mm / MM_PER_M


def moved_mm(T: Array, points_mm: Array) -> Array:
    """Points in mm moved by a ROS transform (4, 4), metres."""
    return se3.apply(in_mm(T), points_mm)


def in_mm(T: Array) -> Array:
    """Turn a ROS transform (4, 4), metres, into one of points in mm."""
    scaled = T.copy()
    scaled[:3, 3] *= MM_PER_M
    return scaled


def ros_pose(T_target_source: Array) -> Array:
    """Turn the core's answer (4, 4), mm, into T_cloud_model in metres."""
    T = se3.inverse(se3.nearest_rigid(T_target_source))
    T[:3, 3] /= MM_PER_M
    return T


def core_pose(T_cloud_model: Array) -> Array:
    """Turn a pose from ROS (4, 4), metres, into T_target_source in mm."""
    return in_mm(se3.inverse(T_cloud_model))


def ros_covariance(covariance: Array, T_target_source: Array, centre_mm: Array, floors: tuple[float, float]) -> Array:
    """Turn the core's covariance into that of T_cloud_model in the cloud's frame.

    The core's error xi = (v, w) is a twist in the target's frame. It acts on the left of T_target_source, about the
    source's middle c. To first order exp(xi)^-1 p = p - w x (p - c) - v. Seen from the cloud, with R = R_cloud_target,
    the model's origin p = 0 and its axes move by
        dt = -R (v + [c]x w),   dr = -R w.
    Both signs cancel in J C J^T.

    Args:
        covariance: (6, 6), x y z (mm) rx ry rz (rad), fixed axes of the target frame, about `centre_mm`.
        T_target_source: (4, 4), mm.
        centre_mm: (3,) about which the rotation turns, in the target frame: the middle of the source.
        floors: smallest standard deviation of a translation (m) and of a rotation (rad), applied there, where the two
            are least correlated.

    Returns:
        (6, 6) symmetric positive definite, x y z (m) rx ry rz (rad), fixed axes of the cloud's frame, of the model's
        origin: what PoseWithCovariance means.
    """
    metres = np.diag([1.0 / MM_PER_M] * 3 + [1.0] * 3)
    floored = floor_covariance(metres @ covariance @ metres, *floors)
    centre = centre_mm / MM_PER_M
    R = T_target_source[:3, :3].T
    J = np.block([[R, R @ skew(centre)], [np.zeros((3, 3)), R]])
    return symmetric(J @ floored @ J.T)


def floor_covariance(covariance: Array, translation: float, rotation: float) -> Array:
    """Make no direction surer than the floors (standard deviations): eigenvalues in their unit >= 1."""
    scale = np.diag([translation] * 3 + [rotation] * 3)
    inverse = np.diag(1.0 / scale.diagonal())
    values, vectors = np.linalg.eigh(symmetric(inverse @ covariance @ inverse))
    return symmetric(scale @ (vectors * np.maximum(values, 1.0)) @ vectors.T @ scale)


def skew(v: Array) -> Array:
    """(3, 3) matrix of the cross product with v."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def symmetric(matrix: Array) -> Array:
    """Take off the asymmetry of rounding."""
    return 0.5 * (matrix + matrix.T)
