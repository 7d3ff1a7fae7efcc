"""Rigid motions as (4, 4) float64 matrices; `T_b_a` takes coordinates in frame a to frame b."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

RIGHT_MM, RIGHT_DEG = 4.0, 5.0  # a pose farther off at the source's centroid, or turned farther, is wrong
LAST_ROW = 1e-6  # how far an entry of the last row may be from 0 0 0 1
LARGEST_ENTRY = 1e6  # of a rotation part; larger is a damaged number, and no scale
FARTHEST_FROM_RIGID = 1e-2  # of an entry of R^T R from the identity: poses are often written with few digits


class PoseError(NamedTuple):
    """Translation error at the source's centroid (RTE) and geodesic rotation error (RRE)."""

    rte_mm: float
    rre_deg: float

    def within(self, limit_mm: float, limit_deg: float) -> bool:
        """Neither error is larger than its limit."""
        return self.rte_mm <= limit_mm and self.rre_deg <= limit_deg

    @property
    def is_right(self) -> bool:
        """Check the limits of a right pose: 4 mm and 5 deg. A confidence is the probability of that."""
        return self.within(RIGHT_MM, RIGHT_DEG)


def from_rotation_translation(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """(..., 3, 3) rotations and (..., 3) translations as (..., 4, 4) matrices."""
    rotation = np.asarray(rotation, dtype=np.float64)
    T = np.zeros((*rotation.shape[:-2], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = rotation, translation, 1.0
    return T


def apply(T: ArrayLike, points: ArrayLike) -> Array:
    """(N, 3) points moved by T (4, 4)."""
    T = np.asarray(T, dtype=np.float64)
    return np.asarray(points, dtype=np.float64) @ T[:3, :3].T + T[:3, 3]


def inverse(T: ArrayLike) -> Array:
    """Invert a rigid motion exactly; cheaper and safer than a matrix inverse."""
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


def why_not_rigid(T: Array) -> str:
    """Say in words why a finite T (4, 4) is not rigid; empty if it is."""
    R, last = T[:3, :3], T[3]
    if np.abs(last - [0.0, 0.0, 0.0, 1.0]).max() > LAST_ROW:
        return "last row is {:g} {:g} {:g} {:g}, not 0 0 0 1".format(*last)
    if (largest := np.abs(R).max()) > LARGEST_ENTRY:  # whose square may be infinite
        return f"rotation part has an entry of size {largest:.3g}"
    off, determinant = np.abs(R.T @ R - np.eye(3)).max(), np.linalg.det(R)
    if off <= FARTHEST_FROM_RIGID and determinant > 0.0:
        return ""
    if f"{determinant:.3g}" != "1":
        return f"rotation part has determinant {determinant:.3g}"
    return f"rotation part has axes that are off right angles and length 1 by {off:.2g}: sheared, or of few digits"


def kabsch(source: ArrayLike, target: ArrayLike, weights: ArrayLike | None = None) -> Array:
    """Rigid T (..., 4, 4) minimising sum_i w_i |T source_i - target_i|^2 (Kabsch 1976, Arun 1987).

    Args:
        source: (..., N, 3), N >= 3.
        target: (..., N, 3), the same number of points.
        weights: (..., N), not negative; all equal when None.
    """
    source, target = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    w = np.ones(source.shape[:-1]) if weights is None else np.asarray(weights, dtype=np.float64)
    w = (w / w.sum(axis=-1, keepdims=True))[..., None]
    source_mean, target_mean = (w * source).sum(axis=-2), (w * target).sum(axis=-2)
    centred = source - source_mean[..., None, :], target - target_mean[..., None, :]
    return fitting((w * centred[0]).swapaxes(-1, -2) @ centred[1], source_mean, target_mean)


def fitting(covariance: Array, source_mean: Array, target_mean: Array) -> Array:
    """Rigid T (..., 4, 4) of weighted sums: the last step of `kabsch`.

    Args:
        covariance: (..., 3, 3) sum of w_i (source_i - mean) (target_i - mean)^T.
        source_mean: (..., 3) weighted mean.
        target_mean: (..., 3) weighted mean.
    """
    u, _, vt = np.linalg.svd(covariance)
    v = vt.swapaxes(-1, -2).copy()
    v[..., 2] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))[..., None]  # a rotation, no mirror image
    rotation = v @ u.swapaxes(-1, -2)
    return from_rotation_translation(rotation, target_mean - (rotation @ source_mean[..., None])[..., 0])


def exp(twist: ArrayLike, centre: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
    """Small motion x y z (mm) rx ry rz (rad): rotate about `centre`, then translate."""
    twist, centre = np.asarray(twist, dtype=np.float64), np.asarray(centre, dtype=np.float64)
    rotation = Rotation.from_rotvec(twist[3:]).as_matrix()
    return from_rotation_translation(rotation, twist[:3] + centre - rotation @ centre)


def rms_apart_mm(T: ArrayLike, T_other: ArrayLike, points: ArrayLike) -> float:
    """sqrt(mean_i |T p_i - T_other p_i|^2) over points (N, 3), mm: how far apart two poses (4, 4) put them."""
    shift = apply(T, points) - apply(T_other, points)
    return float(np.sqrt((shift**2).sum(axis=1).mean()))


def pose_error(T_estimate: ArrayLike, T_true: ArrayLike, source: ArrayLike) -> PoseError:
    """RTE at the centroid of `source` (N, 3) and RRE of T_estimate against T_true, both T_target_source (4, 4)."""
    centroid = np.asarray(source, dtype=np.float64).mean(axis=0, keepdims=True)
    shift = apply(T_estimate, centroid) - apply(T_true, centroid)
    return PoseError(float(np.linalg.norm(shift)), rotation_angle_deg(inverse(T_true) @ np.asarray(T_estimate)))


def random_rotation(rng: np.random.Generator) -> Array:
    """(3, 3) rotation, uniform on SO(3)."""
    return Rotation.random(random_state=rng).as_matrix()
