"""Where a source or a bone lies, and in which order its points come, changes no answer but its pose."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gapr_core import Accumulator, Registrar, RegistrarConfig, Tracker, check_points
from gapr_core.config import SourceConfig
from gapr_core.errors import InvalidPointCloudError
from gapr_core.geometry import landmarks, se3
from gapr_core.registration.problem import source as sources
from gapr_core.results import Refusal


@pytest.fixture(scope="module")
def seen(femur):
    """(2000, 3) one side of the femur's lower part with 0.5 mm of noise, mm: more points than are fitted."""
    rng = np.random.default_rng(3)
    points, normals = femur.sample(16_000, rng)
    low = points[(normals[:, 1] < -0.2) & (points[:, 2] < np.quantile(points[:, 2], 0.4))][:2000]
    return low + rng.normal(0.0, 0.5, low.shape)


def same(answer, other, apart=1e-6):
    return answer.confidence == pytest.approx(other.confidence, abs=apart) and answer.tre95_mm == pytest.approx(
        other.tre95_mm, rel=1e-6
    )


def test_a_source_may_be_turned_moved_and_mixed(registrar, seen, target):
    """Which of many poor poses are compared with the best one may depend on the last bit, and so on the processor."""
    found = registrar.register(seen, target)
    rng = np.random.default_rng(0)
    for turn in Rotation.random(3, random_state=1):
        M = se3.from_rotation_translation(turn.as_matrix(), rng.uniform(-500.0, 500.0, 3))
        moved = registrar.register(rng.permutation(se3.apply(M, seen)), target)
        assert same(found, moved, apart=1e-3)
        assert se3.rms_apart_mm(moved.T_target_source @ M, found.T_target_source, seen) < 1e-6


@pytest.mark.parametrize("shift_mm", [[0.37, 0.81, -0.4], [1234.5, -777.7, 3000.1]])
def test_a_bone_may_lie_anywhere_in_its_frame(femur, seen, shift_mm):
    """The network computes in single precision, so that this holds for it but for rounding."""
    registrar = Registrar(RegistrarConfig(num_threads=1))
    cloud = femur.sample(9000, np.random.default_rng(4))[0]
    found = registrar.register(seen, registrar.prepare(cloud))
    moved = registrar.register(seen, registrar.prepare(cloud + shift_mm))
    assert found.ok and same(found, moved)
    np.testing.assert_allclose(moved.T_target_source[:3, 3] - shift_mm, found.T_target_source[:3, 3], atol=1e-5)


def test_of_a_large_cloud_the_same_points_are_used_in_any_order(femur):
    points = femur.sample(30_000, np.random.default_rng(5))[0]
    config = SourceConfig(most_raw_points=10_000)
    used = [
        sources.prepare(each, config) for each in (points, points[::-1], np.random.default_rng(6).permutation(points))
    ]
    assert not any(isinstance(each, Refusal) for each in used)
    np.testing.assert_array_equal(used[0].points, used[1].points)
    np.testing.assert_array_equal(used[0].points, used[2].points)


def test_a_large_source_that_comes_again_in_another_order_is_collected_once(registrar, femur):
    points = femur.sample(9000, np.random.default_rng(7))[0]
    collection = Accumulator(registrar, most=20)
    collection.collect(points)
    once = len(collection.collected)
    collection.collect(np.random.default_rng(8).permutation(points))
    assert len(collection.collected) == once < len(points)


def test_more_companions_than_points_are_no_error(femur):
    points = femur.sample(150, np.random.default_rng(9))[0]
    config = SourceConfig(fitted_points=100, companions=200, dense_points=20)
    assert len(sources.prepare(points, config).points) == 100


@pytest.mark.parametrize("rows", [[[1.0, 2.0, 3.0], [4.0, 5.0], [6.0, 7.0, 8.0]], ["left", "right", "top"]])
def test_landmarks_that_are_no_points_are_named(rows):
    with pytest.raises(InvalidPointCloudError, match="expected source landmarks .K, 3., mm"):
        landmarks.paired_pose(rows, np.eye(3))


def test_who_changes_an_answer_changes_nothing_that_comes(registrar, seen, target):
    """Such as the pose in place, to metres."""
    rng = np.random.default_rng(10)
    frames = [seen + rng.normal(0.0, 0.2, seen.shape) for _ in range(3)]
    answers = []
    for spoils in (False, True):
        tracker, of_these = Tracker(registrar), []
        for frame in frames:
            result = tracker.register(frame, target)
            of_these.append((result.confidence, result.tre95_mm, result.T_target_source.copy()))
            if spoils:
                touched = check_points(target.points[::2000], target, result)
                for array in (result.T_target_source[:3], result.covariance, result.centre_mm, touched.next_point,
                              result.residuals.points, result.residuals.distance_mm,
                              *(each.T_target_source for each in result.hypotheses)):  # fmt: skip
                    array /= 1000.0
        answers.append(of_these)
    for (confidence, tre95_mm, T), spoiled in zip(*answers, strict=True):
        assert (confidence, tre95_mm) == spoiled[:2]
        np.testing.assert_array_equal(T, spoiled[2])
