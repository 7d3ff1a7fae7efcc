"""Rigid motions as (4, 4) float64 matrices; `T_b_a` takes coordinates in frame a to frame b."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


def from_rotation_translation(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """(3, 3) rotation and (3,) translation as one (4, 4) matrix."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation
    return T


def apply(T: ArrayLike, points: ArrayLike) -> Array:
    """(N, 3) points moved by T (4, 4)."""
    T = np.asarray(T, dtype=np.float64)
    return np.asarray(points, dtype=np.float64) @ T[:3, :3].T + T[:3, 3]


def inverse(T: ArrayLike) -> Array:
    """The inverse motion; exact for rigid T, cheaper and safer than a matrix inverse."""
    T = np.asarray(T, dtype=np.float64)
    return from_rotation_translation(T[:3, :3].T, -T[:3, :3].T @ T[:3, 3])


def rotation_angle_deg(T: ArrayLike) -> float:
    """Geodesic angle of T's rotation, degrees, 0 to 180."""
    return float(np.degrees(Rotation.from_matrix(np.asarray(T)[:3, :3]).magnitude()))


def nearest_rigid(T: ArrayLike) -> Array:
    """T with its rotation projected on SO(3) (removes rounding, keeps the translation)."""
    T = np.asarray(T, dtype=np.float64)
    u, _, vt = np.linalg.svd(T[:3, :3])
    return from_rotation_translation(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt, T[:3, 3])


def kabsch(source: ArrayLike, target: ArrayLike, weights: ArrayLike | None = None) -> Array:
    """Rigid T (4, 4) minimising sum_i w_i |T source_i - target_i|^2 (Kabsch 1976, Arun 1987); inputs (N, 3), N >= 3."""
    source, target = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    w = np.ones(len(source)) if weights is None else np.asarray(weights, dtype=np.float64)
    w = w / w.sum()
    source_mean, target_mean = w @ source, w @ target
    u, _, vt = np.linalg.svd((source - source_mean).T @ ((target - target_mean) * w[:, None]))
    rotation = vt.T @ np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
    return from_rotation_translation(rotation, target_mean - rotation @ source_mean)


def exp(twist: ArrayLike, centre: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
    """Small motion x y z (mm) rx ry rz (rad): rotate about `centre`, then translate."""
    twist, centre = np.asarray(twist, dtype=np.float64), np.asarray(centre, dtype=np.float64)
    rotation = Rotation.from_rotvec(twist[3:]).as_matrix()
    return from_rotation_translation(rotation, twist[:3] + centre - rotation @ centre)


def pose_error(T_estimate: ArrayLike, T_true: ArrayLike, source: ArrayLike) -> tuple[float, float]:
    """Translation error at the source's centroid (RTE, mm) and geodesic rotation error (RRE, deg)."""
    centroid = np.asarray(source, dtype=np.float64).mean(axis=0, keepdims=True)
    shift = apply(T_estimate, centroid) - apply(T_true, centroid)
    return float(np.linalg.norm(shift)), rotation_angle_deg(inverse(T_true) @ np.asarray(T_estimate))


def random_rotation(rng: np.random.Generator) -> Array:
    """(3, 3) rotation, uniform on SO(3)."""
    return Rotation.random(random_state=rng).as_matrix()
