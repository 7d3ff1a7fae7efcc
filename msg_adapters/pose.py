"""Poses and transforms to (4, 4) matrices and back; the unit of the translation stays as it is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, Pose, Quaternion, Transform, Vector3
from numpy.typing import ArrayLike, NDArray

from msg_adapters.errors import InvalidMessageError

Array = NDArray[np.float64]
NORM_TOLERANCE = 1e-2  # a quaternion further from unit length was not meant as a rotation


def pose_to_matrix(message: Any) -> Array:
    """(4, 4) from a Pose, or from a message that holds one (PoseStamped, PoseWithCovariance[Stamped]).

    Raises:
        InvalidMessageError: for a position that is not finite or a quaternion that is not of unit length.
    """
    while hasattr(message, "pose"):
        message = message.pose
    return _matrix(message.position, message.orientation)


def transform_to_matrix(message: Any) -> Array:
    """(4, 4) from a Transform or TransformStamped; takes the child's coordinates into the parent's.

    Raises:
        InvalidMessageError: for a translation that is not finite or a quaternion that is not of unit length.
    """
    message = getattr(message, "transform", message)
    return _matrix(message.translation, message.rotation)


def matrix_to_pose(T: ArrayLike) -> Pose:
    """Pose of a rigid (4, 4).

    Raises:
        InvalidMessageError: when T is not a rigid motion.
    """
    T = _rigid(T)
    x, y, z = T[:3, 3].tolist()
    return Pose(position=Point(x=x, y=y, z=z), orientation=_quaternion(T[:3, :3]))


def matrix_to_transform(T: ArrayLike) -> Transform:
    """Transform of a rigid (4, 4).

    Raises:
        InvalidMessageError: when T is not a rigid motion.
    """
    T = _rigid(T)
    x, y, z = T[:3, 3].tolist()
    return Transform(translation=Vector3(x=x, y=y, z=z), rotation=_quaternion(T[:3, :3]))


def covariance_to_list(covariance: ArrayLike) -> list[float]:
    """Write (6, 6) as the 36 numbers of PoseWithCovariance, row-major x y z rx ry rz.

    Raises:
        InvalidMessageError: for another shape or entries that are not finite.
    """
    matrix = np.asarray(covariance, dtype=np.float64)
    if matrix.shape != (6, 6) or not np.isfinite(matrix).all():
        raise InvalidMessageError(f"a covariance is (6, 6) and finite, got shape {matrix.shape}")
    return list(matrix.ravel().tolist())


def list_to_covariance(values: Sequence[float]) -> Array:
    """(6, 6) from the 36 numbers of PoseWithCovariance."""
    return np.asarray(values, dtype=np.float64).reshape(6, 6)


def _matrix(position: Any, orientation: Any) -> Array:
    T = np.eye(4)
    T[:3, 3] = position.x, position.y, position.z
    T[:3, :3] = _rotation(np.array([orientation.x, orientation.y, orientation.z, orientation.w], dtype=np.float64))
    if not np.isfinite(T).all():
        raise InvalidMessageError(f"a position must be finite, got {T[:3, 3].tolist()}")
    return T


def _rotation(xyzw: Array) -> Array:
    """(3, 3) of a unit quaternion x y z w (Shoemake 1985)."""
    norm = float(np.linalg.norm(xyzw))
    if not abs(norm - 1.0) < NORM_TOLERANCE:
        raise InvalidMessageError(f"a quaternion must have unit length, got {norm:.3g}: {xyzw.tolist()}")
    x, y, z, w = xyzw / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _quaternion(R: Array) -> Quaternion:
    """Unit quaternion with w >= 0: the row of the 4x4 outer product q q^T with the largest diagonal (Shepperd 1978)."""
    trace = np.trace(R)
    outer = np.empty((4, 4))  # 4 q q^T, order x y z w
    outer[:3, :3] = R + R.T + (1.0 - trace) * np.eye(3)
    outer[3, :3] = outer[:3, 3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    outer[3, 3] = 1.0 + trace
    row = outer[np.argmax(outer.diagonal())]
    q = row / np.linalg.norm(row) * (1.0 if row[3] >= 0.0 else -1.0)
    x, y, z, w = q.tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def _rigid(T: ArrayLike) -> Array:
    T = np.asarray(T, dtype=np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise InvalidMessageError(f"a pose is a finite (4, 4) matrix, got shape {T.shape}")
    R = T[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-4) or np.linalg.det(R) < 0 or not np.allclose(T[3], [0, 0, 0, 1]):
        raise InvalidMessageError("a pose is a rotation and a translation; this matrix shears, scales or mirrors")
    return T
