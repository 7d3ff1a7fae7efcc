"""Direction, units and covariance between core and messages, against sampled poses."""

from __future__ import annotations

import numpy as np
import pytest
from harness import pose_mm
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gapr_core.geometry import se3
from gapr_ros.node import units

T_TARGET_SOURCE = pose_mm([0.3, -1.1, 0.7], [120.0, -40.0, 300.0])
FLOORS = (1e-9, 1e-9)


def test_the_message_carries_the_inverse_in_metres():
    T_cloud_model = units.ros_pose(T_TARGET_SOURCE)
    source_mm = np.array([[10.0, 20.0, 30.0], [-5.0, 0.0, 80.0]])
    model_m = se3.apply(T_TARGET_SOURCE, source_mm) / 1000.0
    np.testing.assert_allclose(se3.apply(T_cloud_model, model_m), source_mm / 1000.0, atol=1e-12)
    np.testing.assert_allclose(units.core_pose(T_cloud_model), T_TARGET_SOURCE, atol=1e-9)


def test_points_are_converted_by_their_unit():
    np.testing.assert_array_equal(units.to_mm(np.ones((1, 3)), "m"), np.full((1, 3), 1000.0))
    np.testing.assert_array_equal(units.to_mm(np.ones((1, 3)), "mm"), np.ones((1, 3)))


def test_lengths_and_points_are_converted_to_metres():
    assert units.to_metres(2500.0) == 2.5
    np.testing.assert_array_equal(units.to_metres(np.full((1, 3), 10.0)), np.full((1, 3), 0.01))


def random_covariance(rng, translation_mm=0.5, rotation=2e-3):
    root = rng.normal(size=(6, 6)) * np.array([translation_mm] * 3 + [rotation] * 3)[:, None]
    return root @ root.T


@pytest.mark.parametrize("seed", range(4))
def test_the_covariance_is_that_of_sampled_poses(seed):
    """Errors drawn as the core means them, composed, inverted and read as ROS means them."""
    rng = np.random.default_rng(seed)
    T = se3.from_rotation_translation(se3.random_rotation(rng), rng.uniform(-400.0, 400.0, 3))
    centre, covariance = rng.uniform(-200.0, 200.0, 3), random_covariance(rng)
    expected = units.ros_covariance(covariance, T, centre, FLOORS)

    estimate = units.ros_pose(T)
    errors = []
    for xi in rng.multivariate_normal(np.zeros(6), covariance, 4000):
        truth = units.ros_pose(se3.exp(xi, centre) @ T)
        turn = Rotation.from_matrix(truth[:3, :3] @ estimate[:3, :3].T).as_rotvec()
        errors.append(np.concatenate([truth[:3, 3] - estimate[:3, 3], turn]))
    sampled = np.cov(np.array(errors).T)
    scale = np.sqrt(expected.diagonal())
    np.testing.assert_allclose(sampled / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.1)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 6))
def test_the_sent_covariance_is_symmetric_and_positive_definite_with_its_floors(seed, rank):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6, rank)) * np.array([1e-3] * 3 + [1e-7] * 3)[:, None] if rank else np.zeros((6, 1))
    T = se3.from_rotation_translation(se3.random_rotation(rng), rng.uniform(-1000.0, 1000.0, 3))
    sent = units.ros_covariance(root @ root.T, T, rng.uniform(-200.0, 200.0, 3), (1e-4, 1e-3))
    np.testing.assert_array_equal(sent, sent.T)
    np.linalg.cholesky(sent)
    assert (sent.diagonal()[:3] >= 0.999e-8).all() and (sent.diagonal()[3:] >= 0.999e-6).all()


def test_points_in_mm_are_moved_by_a_transform_in_metres():
    T = se3.from_rotation_translation(Rotation.from_euler("z", 90, degrees=True).as_matrix(), [1.0, 0.0, -0.5])
    np.testing.assert_allclose(units.moved_mm(T, np.array([[10.0, 20.0, 30.0]])), [[980.0, 10.0, -470.0]], atol=1e-12)


def test_no_error_at_all_becomes_the_floors():
    floored = units.floor_covariance(np.zeros((6, 6)), 1e-4, 1e-3)
    np.testing.assert_allclose(floored, np.diag([1e-8] * 3 + [1e-6] * 3), rtol=1e-12)


def test_a_covariance_above_its_floors_is_not_touched():
    covariance = random_covariance(np.random.default_rng(1), 1.0, 1.0) + np.eye(6)
    np.testing.assert_allclose(units.floor_covariance(covariance, 1e-3, 1e-3), covariance, rtol=1e-9, atol=1e-12)
