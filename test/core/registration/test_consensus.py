from __future__ import annotations

import numpy as np
import pytest

from gapr_core.benchmark.ransac import ransac, sharpened
from gapr_core.geometry import se3
from gapr_core.registration.proposals import consensus
from gapr_core.registration.proposals.consensus import Correspondences, distinct, local_to_global


def scene(share_right: float, second_share: float = 0.0, seed: int = 0):
    """Patches of eight correspondences: some under one motion, some under another, the rest at random."""
    rng = np.random.default_rng(seed)
    T, other = (se3.from_rotation_translation(se3.random_rotation(rng), rng.uniform(-100, 100, 3)) for _ in range(2))
    source = rng.uniform(-60, 60, (60, 1, 3)) + rng.uniform(-8, 8, (60, 8, 3))
    target = rng.uniform(-60, 60, (60, 1, 3)) + rng.uniform(-8, 8, (60, 8, 3))
    right, second = int(60 * share_right), int(60 * (share_right + second_share))
    target[:right] = se3.apply(T, source[:right].reshape(-1, 3)).reshape(-1, 8, 3)
    target[right:second] = se3.apply(other, source[right:second].reshape(-1, 3)).reshape(-1, 8, 3)
    target += rng.normal(0, 0.5, target.shape)
    found = Correspondences(
        source.reshape(-1, 3), target.reshape(-1, 3), rng.uniform(0.2, 1, 480), np.repeat(np.arange(60), 8)
    )
    return found, T, other


@pytest.mark.parametrize("method", ["local_to_global", "ransac"])
def test_the_true_motion_is_the_first_pose_although_most_patches_are_wrong(method):
    found, T, _ = scene(0.25)
    rng = np.random.default_rng(1)
    poses = local_to_global(found, 4.0) if method == "local_to_global" else ransac(found, 4.0, rng, draws=4000)
    mm, deg = se3.pose_error(poses[0], T, found.source)
    scores = consensus._support(poses, found, 4.0).sum(axis=1)
    assert mm < 0.5 and deg < 1.0 and (np.diff(scores) <= 0).all()


def test_two_motions_that_both_have_support_are_both_proposed():
    found, T, other = scene(0.3, 0.2)
    poses = local_to_global(found, 4.0)
    for truth, pose in ((T, poses[0]), (other, poses[1])):
        assert se3.pose_error(pose, truth, found.source)[0] < 0.5


def test_proposed_poses_are_rigid_and_distinct():
    found, _, _ = scene(0.2)
    poses = local_to_global(found, 4.0, count=10)
    np.testing.assert_allclose(
        poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (len(poses), 1, 1)), atol=1e-9
    )
    assert np.allclose(np.linalg.det(poses[:, :3, :3]), 1.0) and 1 < len(poses) <= 10
    again = distinct(poses, np.arange(len(poses), 0, -1.0), found.source.mean(0), 10)
    assert len(again) == len(poses)


def test_poses_are_the_same_only_where_both_place_and_attitude_are():
    turned, shifted, near = (
        se3.exp(twist) for twist in ([0, 0, 0, 1.0, 0, 0], [100.0, 0, 0, 0, 0, 0], [3.0, 0, 0, 0.05, 0, 0])
    )
    poses = np.array([np.eye(4), near, turned, shifted])
    assert distinct(poses, np.array([4.0, 3.0, 2.0, 1.0]), np.zeros(3), 9).tolist() == [0, 2, 3]


def test_a_triple_of_points_too_near_each_other_says_nothing_of_an_attitude():
    near = np.random.default_rng(0).uniform(-2.0, 2.0, (30, 3))
    found = Correspondences(near, near, np.ones(30), np.arange(30))
    assert len(ransac(found, 4.0, np.random.default_rng(0))) == 0
    assert len(ransac(found, 0.2, np.random.default_rng(0))) > 0


def test_a_pose_that_two_correspondences_agree_with_is_not_fitted_to_them():
    source = np.array([[0.0, 0, 0], [50.0, 0, 0], [0, 50.0, 0], [0, 0, 50.0]])
    far = np.array([[0.0, 0, 0], [1.0, 0, 0], [900.0, 0, 0], [0, 900.0, 0]])
    found = Correspondences(source, source + far, np.ones(4), np.zeros(4, dtype=int))
    poses = consensus.converge(np.eye(4)[None], found, 4.0, 5)
    np.testing.assert_array_equal(poses, np.eye(4)[None])
    np.testing.assert_array_equal(consensus._support(poses, found, 4.0), [[1.0, 1.0, 0.0, 0.0]])


def test_without_correspondences_there_are_no_poses():
    none = Correspondences(np.empty((0, 3)), np.empty((0, 3)), np.empty(0), np.empty(0, dtype=int))
    for poses in (local_to_global(none, 4.0), ransac(none, 4.0, np.random.default_rng(0))):
        assert poses.shape == (0, 4, 4)


def test_two_correspondences_make_no_pose():
    found, _, _ = scene(0.5)
    two = Correspondences(found.source[:2], found.target[:2], found.score[:2], found.patch[:2])
    assert len(local_to_global(two, 4.0)) == 0


def lifted(share: float, far_mm: float = 4.0):
    """400 correspondences under one motion, good to 0.2 mm, but for a share that lies `far_mm` off to one side."""
    rng = np.random.default_rng(4)
    T = se3.from_rotation_translation(se3.random_rotation(rng), rng.uniform(-100, 100, 3))
    source = rng.uniform(-60, 60, (400, 3))
    target = se3.apply(T, source) + rng.normal(0.0, 0.2, source.shape)
    target[: round(400 * share), 0] += far_mm
    return Correspondences(source, target, np.ones(400), np.arange(400) // 8), T


def test_a_sharpened_pose_leaves_out_what_is_a_little_off():
    found, T = lifted(0.3)
    pose = ransac(found, 7.5, np.random.default_rng(0))[0]
    assert se3.pose_error(pose, T, found.source)[0] > 0.8  # of 30 % at 4 mm
    assert se3.pose_error(sharpened(pose, found, 5.0), T, found.source)[0] < 0.1


def test_a_sharpened_pose_counts_correspondences_by_their_score():
    found, T = lifted(0.5)
    pose = ransac(found, 7.5, np.random.default_rng(0))[0]
    sure = np.where(np.arange(400) < 200, 0.1, 1.0)
    weighed = Correspondences(found.source, found.target, sure, found.patch)
    assert se3.pose_error(sharpened(pose, weighed, 5.0), T, found.source)[0] < 0.1
    weighed = Correspondences(found.source, found.target, sure[::-1].copy(), found.patch)
    assert se3.pose_error(sharpened(pose, weighed, 5.0), T, found.source)[0] > 3.5


def test_a_pose_that_nothing_agrees_with_stays_as_it_is():
    found, T = lifted(0.0)
    far = T.copy()
    far[0, 3] += 500.0
    np.testing.assert_array_equal(sharpened(far, found, 5.0), far)


def test_a_sharpened_pose_rests_where_tukeys_weights_balance():
    """At the last radius, .7 of 5 mm: the weighted residuals have no mean, and no moment about their centre."""
    found, T = lifted(0.3, 2.0)
    pose = sharpened(T, found, 5.0)
    moved = se3.apply(pose, found.source)
    off = moved - found.target
    weights = np.maximum(1.0 - (off**2).sum(axis=1) / 3.5**2, 0.0) ** 2
    np.testing.assert_allclose(weights @ off / weights.sum(), 0.0, atol=2e-3)
    np.testing.assert_allclose(weights @ np.cross(moved - moved.mean(axis=0), off) / weights.sum(), 0.0, atol=0.2)
    assert np.abs(np.sqrt(weights) @ off / weights.sum()).max() > 0.05
