import numpy as np
import pytest

from gapr_core.errors import InvalidPointCloudError
from gapr_core.geometry import se3
from gapr_core.geometry.landmarks import paired_pose

POINTS = np.array([[0.0, 0.0, 0.0], [80.0, 0.0, 0.0], [0.0, 60.0, 0.0], [20.0, 20.0, 40.0]])


def test_landmarks_give_the_pose_that_moved_them():
    rng = np.random.default_rng(0)
    T = se3.from_rotation_translation(se3.random_rotation(rng), [100.0, -20.0, 7.0])
    found = paired_pose(POINTS, se3.apply(T, POINTS))
    np.testing.assert_allclose(found.T_target_source, T, atol=1e-9)
    assert found.rms_mm == pytest.approx(0.0, abs=1e-9)


def test_three_landmarks_are_enough_and_their_misfit_is_reported():
    target = POINTS[:3] + [[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    found = paired_pose(POINTS[:3], target)
    moved = se3.apply(found.T_target_source, POINTS[:3])
    assert found.rms_mm == pytest.approx(np.sqrt(((moved - target) ** 2).sum(axis=1).mean()))
    assert 0.5 < found.rms_mm < 3.0
    assert np.linalg.det(found.T_target_source[:3, :3]) == pytest.approx(1.0)


def test_the_misfit_is_the_root_mean_square_of_the_distances_of_the_pairs():
    square = np.array([[30.0, 30.0, 0.0], [-30.0, 30.0, 0.0], [-30.0, -30.0, 0.0], [30.0, -30.0, 0.0]])
    assert paired_pose(square, 1.1 * square).rms_mm == pytest.approx(3.0 * np.sqrt(2.0))  # 3 mm along x and along y


def test_mirrored_landmarks_give_a_rotation_and_a_large_misfit():
    found = paired_pose(POINTS, POINTS * [1.0, 1.0, -1.0])
    assert np.linalg.det(found.T_target_source[:3, :3]) == pytest.approx(1.0)
    assert found.rms_mm > 5.0


@pytest.mark.parametrize(
    ("source", "target"),
    [
        (POINTS[:2], POINTS[:2]),
        (POINTS, POINTS[:3]),
        (POINTS[:3], POINTS),
        (POINTS[None], POINTS[None]),
        (np.tile(POINTS, 2)[:, :4], POINTS),
        (POINTS * [1.0, 0.02, 0.02] + [900.0, -400.0, 70.0], POINTS),
        (POINTS[:, :2], POINTS[:, :2]),
        (np.outer(np.arange(4.0), [1.0, 2.0, 3.0]), POINTS),
        (np.full((4, 3), np.nan), POINTS),
        (POINTS * 1e155, POINTS),  # their squares are infinite, and NumPy's decomposition does not return
    ],
)
def test_landmarks_that_fix_no_pose_are_refused(source, target):
    with pytest.raises(InvalidPointCloudError):
        paired_pose(source, target)


def test_landmarks_with_a_gradient_are_refused():
    torch = pytest.importorskip("torch", reason="tensors: pip install torch")
    with pytest.raises(InvalidPointCloudError, match="grad"):
        paired_pose(torch.tensor(POINTS, requires_grad=True), POINTS)
