"""Regions of interest in a cloud."""

import numpy as np
import pytest

from gapr_core.config import SourceConfig
from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_core.geometry import se3
from gapr_core.registration.problem.crop import crop_box, crop_to_pose
from gapr_core.registration.problem.source import without_isolated


def test_a_box_is_read_in_its_own_frame():
    T_box_points = se3.from_rotation_translation([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [100.0, 0.0, 0.0])
    points = np.array([[0.0, 0.0, 0.0], [0.0, 95.0, 0.0], [np.nan, 0.0, 0.0]])
    kept = crop_box(points, T_box_points, [0.0, -10.0, -10.0], [10.0, 10.0, 10.0])
    assert kept == pytest.approx(np.array([[0.0, 95.0, 0.0]]))


def test_the_faces_of_a_box_belong_to_it():
    points = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0], [1.0, 2.0, 3.01]])
    np.testing.assert_array_equal(crop_box(points, np.eye(4), [0.0, 0.0, 0.0], [1.0, 2.0, 3.0]), points[:2])


@pytest.mark.parametrize(("corners", "said"), [
    (([0, 0, 0], [1, 1, 0]), "corners"), (([0, 0], [1, 1]), "corners"),
    ((["left", "low", "near"], [1, 1, 1]), "a corner x y z"),
])  # fmt: skip
def test_a_box_without_volume_is_refused(corners, said):
    with pytest.raises(ConfigError, match=said):
        crop_box(np.zeros((1, 3)), np.eye(4), *corners)


@pytest.mark.parametrize(("points", "pose", "said"), [
    (None, np.eye(3), "shape"), (None, np.full((4, 4), np.nan), "finite"), (None, np.diag([2, 2, 2, 1]), "rigid"),
    *[(points, np.eye(4), r"\(N, 3\)") for points in (np.zeros(3), np.zeros((5, 2)), np.zeros((2, 3, 2)))],
])  # fmt: skip
def test_nothing_is_cropped_by_a_pose_that_is_not_rigid_or_from_other_arrays(points, pose, said, target):
    points = target.points if points is None else points
    with pytest.raises(InvalidPointCloudError, match=said):
        crop_box(points, pose, np.zeros(3), np.ones(3))
    with pytest.raises(InvalidPointCloudError, match=said):
        crop_to_pose(points, pose, target, margin_mm=5.0)


def test_what_is_far_from_the_bone_under_the_last_pose_is_dropped(target):
    T = se3.exp(np.array([20.0, -5.0, 60.0, 0.3, 0.2, -1.0]), np.zeros(3))
    on, off = target.points[:50], target.points[:50] + 25.0 * target.normals[:50]
    source = se3.apply(se3.inverse(T), np.vstack([on, off]))
    kept = crop_to_pose(np.vstack([source, [[np.nan] * 3]]), T, target, margin_mm=8.0)
    assert kept[:50] == pytest.approx(source[:50]) and len(kept) < 75


@pytest.mark.parametrize("margin_mm", [0.0, float("nan"), "5"])
def test_a_margin_that_is_not_positive_is_refused(margin_mm, target):
    with pytest.raises(ConfigError, match="margin"):
        crop_to_pose(target.points, np.eye(4), target, margin_mm=margin_mm)


def test_uniform_far_clutter_is_removed_and_the_bone_stays(femur):
    rng = np.random.default_rng(0)
    points = femur.sample(3000, rng)[0]
    points = points[points[:, 2] < np.quantile(points[:, 2], 0.4)]
    low, high = points.min(axis=0) - 150.0, points.max(axis=0) + 150.0
    clutter = rng.uniform(low, high, (len(points) // 3, 3))
    kept = {tuple(p) for p in without_isolated(np.vstack([points, clutter]), SourceConfig())}
    assert all(tuple(p) in kept for p in points) and len(kept) < len(points) + 0.1 * len(clutter)


@pytest.mark.parametrize("count", [12, 40, 200])
def test_a_few_digitised_points_all_count(count):
    points = np.random.default_rng(0).uniform(0.0, 200.0, (count, 3))
    assert len(without_isolated(points, SourceConfig())) == count


def test_slices_of_ultrasound_stay_whole():
    line = np.stack([np.arange(0.0, 40.0, 0.5), np.zeros(80), np.zeros(80)], axis=1)
    slices = np.vstack([line + [0.0, 30.0 * i, 0.0] for i in range(8)])
    assert len(without_isolated(slices, SourceConfig())) == len(slices)
