"""Poses and (4, 4) matrices, both ways, against scipy's rotations."""

from __future__ import annotations

import numpy as np
import pytest
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseStamped,
    PoseWithCovarianceStamped,
    Quaternion,
    Transform,
    TransformStamped,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from msg_adapters import (
    InvalidMessageError,
    covariance_to_list,
    list_to_covariance,
    matrix_to_pose,
    matrix_to_transform,
    pose_to_matrix,
    transform_to_matrix,
)

numbers = st.floats(-1e3, 1e3)
rotation_vectors = st.tuples(*[st.floats(-np.pi, np.pi)] * 3)
half_turns = st.sampled_from([(np.pi, 0, 0), (0, np.pi, 0), (0, 0, np.pi), (0, 0, 0), (np.pi / np.sqrt(2),) * 2 + (0,)])


def rigid(rotation_vector, translation):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotation_vector).as_matrix()
    T[:3, 3] = translation
    return T


@settings(max_examples=200, deadline=None)
@given(rotation_vectors | half_turns, st.tuples(numbers, numbers, numbers))
def test_a_matrix_survives_pose_and_transform(rotation_vector, translation):
    T = rigid(rotation_vector, translation)
    np.testing.assert_allclose(pose_to_matrix(matrix_to_pose(T)), T, atol=1e-12)
    np.testing.assert_allclose(transform_to_matrix(matrix_to_transform(T)), T, atol=1e-12)


@settings(max_examples=200, deadline=None)
@given(rotation_vectors | half_turns)
def test_quaternions_are_those_of_scipy(rotation_vector):
    q = matrix_to_pose(rigid(rotation_vector, (0, 0, 0))).orientation
    expected = Rotation.from_rotvec(rotation_vector).as_quat()
    assert abs(np.dot([q.x, q.y, q.z, q.w], expected)) == pytest.approx(1.0, abs=1e-12)
    assert q.w >= 0.0


def test_stamped_and_covariance_messages_are_opened():
    T = rigid((0.1, -0.2, 0.3), (1, 2, 3))
    stamped = PoseStamped(pose=matrix_to_pose(T))
    with_covariance = PoseWithCovarianceStamped()
    with_covariance.pose.pose = matrix_to_pose(T)
    for message in (stamped, with_covariance, with_covariance.pose):
        np.testing.assert_allclose(pose_to_matrix(message), T, atol=1e-12)
    np.testing.assert_allclose(transform_to_matrix(TransformStamped(transform=matrix_to_transform(T))), T, atol=1e-12)


def test_the_transform_takes_child_coordinates_into_the_parent():
    T = rigid((0, 0, np.pi / 2), (10, 0, 0))
    np.testing.assert_allclose(transform_to_matrix(matrix_to_transform(T)) @ [1, 0, 0, 1], [10, 1, 0, 1], atol=1e-12)


def test_a_quaternion_rounded_to_float32_is_normalised():
    q = np.array([0.1, 0.2, 0.3, 0.9274], dtype=np.float32).astype(float)
    T = pose_to_matrix(Pose(orientation=Quaternion(x=q[0], y=q[1], z=q[2], w=q[3])))
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)


NO_ROTATIONS = [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 2.0), (0.0, 0.612, 0.0, 0.816), (float("nan"), 0.0, 0.0, 1.0)]


@pytest.mark.parametrize("q", NO_ROTATIONS)
def test_a_quaternion_that_is_no_rotation_raises(q):
    orientation = Quaternion(x=q[0], y=q[1], z=q[2], w=q[3])
    with pytest.raises(InvalidMessageError, match="unit length"):
        pose_to_matrix(Pose(orientation=orientation))
    with pytest.raises(InvalidMessageError, match="unit length"):
        transform_to_matrix(Transform(rotation=orientation))


def test_a_position_that_is_not_finite_raises():
    with pytest.raises(InvalidMessageError, match="finite"):
        pose_to_matrix(Pose(position=Point(x=float("inf"))))


@pytest.mark.parametrize(
    "T",
    [np.eye(3), np.full((4, 4), np.nan), np.diag([2.0, 2, 2, 1]), np.diag([1.01, 1.01, 1.01, 1]),
     np.diag([-1.0, 1, 1, 1]), np.diag([1.0, 1, 1, 2])],
    ids=["shape", "nan", "scaled", "scaled by a hundredth", "mirrored", "projective"],
)  # fmt: skip
def test_a_matrix_that_is_no_rigid_motion_is_not_written(T):
    with pytest.raises(InvalidMessageError):
        matrix_to_pose(T)


def test_covariance_is_row_major_both_ways():
    covariance = np.arange(36.0).reshape(6, 6)
    assert covariance_to_list(covariance)[6:12] == [6.0, 7.0, 8.0, 9.0, 10.0, 11.0]
    np.testing.assert_array_equal(list_to_covariance(covariance_to_list(covariance)), covariance)
    with pytest.raises(InvalidMessageError):
        covariance_to_list(np.full((6, 6), np.nan))
