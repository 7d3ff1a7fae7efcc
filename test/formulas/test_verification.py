"""From many hypotheses to few: what survives each stage, and how the survivors are described."""

import numpy as np
import pytest
import tiny

from gapr_core.config import SourceConfig, VerificationConfig
from gapr_core.geometry import se3
from gapr_core.registration.fit import verification
from gapr_core.registration.fit.refinement import refine_many
from gapr_core.registration.problem import source as sources

CONFIG = VerificationConfig(
    coarse_points=20, coarse_limits_mm=(6.0, 5.0, 2), middle_points=24, middle_poses=5, middle_limits_mm=(5.0, 4.0, 2),
    final_poses=3, final_limits_mm=(4.0, 4.0, 2),
)  # fmt: skip
RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def source():
    return sources.prepare(tiny.on_ellipsoid(80), SourceConfig(fewest_points=10, normal_neighbours=10))


@pytest.fixture(scope="module")
def hypotheses():
    near = [se3.exp(RNG.normal(size=6) * [0.5, 0.5, 0.5, 0.02, 0.02, 0.02]) for _ in range(4)]
    far = [se3.exp(RNG.normal(size=6) * [4.0, 4.0, 4.0, 0.5, 0.5, 0.5]) for _ in range(6)]
    return np.array([*far, *near])


def test_the_best_pose_comes_first_and_the_others_are_distinct(source, hypotheses):
    target = tiny.ellipsoid(count=500)
    found = verification.verify(hypotheses, source, target, CONFIG, num_threads=1)
    assert 1 <= len(found.poses) <= CONFIG.final_poses
    assert (np.diff(found.scores) >= 0.0).all()
    some = source.subset(16)
    for i in range(len(found.poses)):
        for j in range(i):
            gap = se3.apply(found.poses[i], some) - se3.apply(found.poses[j], some)
            assert np.sqrt((gap**2).sum(axis=1).mean()) >= CONFIG.same_pose_mm
    assert np.abs(se3.apply(found.poses[0], source.points) - source.points).max() < 1.0


def test_every_stage_refines_on_its_points_and_keeps_its_number(source, hypotheses, monkeypatch):
    target, calls = tiny.ellipsoid(count=500), []

    def noted(poses, points, target, limits, threads):
        calls.append((len(poses), len(points), limits))
        return refine_many(poses, points, target, limits, threads)

    monkeypatch.setattr(verification, "refine_many", noted)
    found = verification.verify(hypotheses, source, target, CONFIG, num_threads=1)
    (first, second, third) = calls
    assert (first[0], first[1], len(first[2])) == (10, 20, 2) and tuple(first[2]) == (6.0, 5.0)
    assert second[0] <= 5 and second[1] == 24 and tuple(second[2]) == (5.0, 4.0)
    assert third[0] <= 3 and third[1] == len(source.points) and tuple(third[2]) == (4.0, 4.0)
    assert len(found.support) == len(found.scores) == len(found.poses)


def test_support_is_the_share_of_the_hypotheses_that_ended_at_the_pose(source, monkeypatch):
    """Refinement stands still here: three hypotheses of five are at the best pose, within 4 mm."""
    at = [0.0, 6.0, 20.0, 25.0, 40.0]
    poses = np.array([se3.exp([x, 0.0, 0.0, 0.0, 0.0, 0.0]) for x in at])
    scores = {x: 1.0 + x for x in at}
    calls = []

    def still(poses, points, target, limits, threads):
        calls.append(poses)
        return poses, np.array([scores[float(T[0, 3])] for T in poses])

    monkeypatch.setattr(verification, "refine_many", still)
    config = VerificationConfig(same_pose_mm=5.5, final_poses=8, middle_poses=8)
    found = verification.verify(poses, source, None, config)
    assert [float(T[0, 3]) for T in found.poses] == [0.0, 6.0, 20.0, 40.0]
    assert found.scores.tolist() == [1.0, 7.0, 21.0, 41.0]
    assert found.support.tolist() == [0.25, 0.25, 0.25, 0.25]  # of the four that went halfway
    lower = VerificationConfig(same_pose_mm=5.0, final_poses=2, middle_poses=8)
    supported = verification.verify(poses, source, None, lower)  # 20 and 25 are 5 mm apart: not within
    assert supported.support.tolist() == [0.2, 0.2]
    assert [len(c) for c in calls[:3]] == [5, 4, 4]
    crowded = verification.verify(
        poses, source, None, VerificationConfig(same_pose_mm=6.0, final_poses=2, middle_poses=8)
    )
    assert [float(T[0, 3]) for T in crowded.poses] == [0.0, 6.0]


@pytest.mark.parametrize(("apart_mm", "support"), [(1.24, 0.5), (1.26, 0.25)])
def test_support_counts_the_poses_that_the_middle_stage_brought_within_the_distance(
    source, monkeypatch, apart_mm, support
):
    """Root mean square over the markers: the second stage moves two of four poses close together."""
    poses = np.array([se3.exp([x, 0.0, 0.0, 0.0, 0.0, 0.0]) for x in (0.0, 20.0, 40.0, 60.0)])
    stage = []

    def moved(poses, points, target, limits, threads):
        stage.append(len(poses))
        if len(stage) == 2:
            poses = poses.copy()
            poses[1] = se3.exp([0.0, apart_mm, 0.0, 0.0, 0.0, 0.0])
        return poses, np.arange(1.0, len(poses) + 1.0)

    monkeypatch.setattr(verification, "refine_many", moved)
    config = VerificationConfig(same_pose_mm=1.25, final_poses=2, middle_poses=8)
    assert verification.verify(poses, source, None, config).support[0] == support


def test_a_pose_is_compared_by_the_same_spread_points(source):
    T = se3.exp([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    markers = verification.markers(np.array([np.eye(4), T]), source, 16)
    some = source.subset(16)
    assert markers[0] == pytest.approx(some) and markers[1] == pytest.approx(se3.apply(T, some))


def test_the_distinct_best_are_kept_with_their_scores(source):
    poses = np.array([se3.exp([x, 0.0, 0.0, 0.0, 0.0, 0.0]) for x in (0.0, 1.0, 9.0)])
    kept, scores = verification._distinct(poses, np.array([2.0, 1.0, 3.0]), source, CONFIG, 5)
    assert [float(T[0, 3]) for T in kept] == [1.0, 9.0] and scores.tolist() == [1.0, 3.0]
