import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gapr_core.geometry import se3

rng = np.random.default_rng(0)
POINTS = rng.normal(size=(20, 3)) * 50.0
T = se3.from_rotation_translation(Rotation.random(random_state=1).as_matrix(), [10.0, -20.0, 30.0])


def test_the_inverse_takes_points_back():
    assert np.allclose(se3.apply(se3.inverse(T), se3.apply(T, POINTS)), POINTS)


def test_kabsch_finds_the_motion_even_when_points_are_mirrored_flat():
    assert np.allclose(se3.kabsch(POINTS, se3.apply(T, POINTS)), T)
    flat = POINTS * [1.0, 1.0, 0.0]
    found = se3.kabsch(flat, se3.apply(T, flat))
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1.0)
    assert np.allclose(se3.apply(found, flat), se3.apply(T, flat))


@pytest.mark.parametrize("seed", range(8))
def test_kabsch_agrees_with_scipy(seed):
    """Random clouds: the singular vectors come with determinants of both signs."""
    draw = np.random.default_rng(seed)
    source, target = draw.normal(size=(2, 7, 3))
    expected, _ = Rotation.align_vectors(target - target.mean(axis=0), source - source.mean(axis=0))
    found = se3.kabsch(source, target)
    np.testing.assert_allclose(found[:3, :3], expected.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(se3.apply(found, source).mean(axis=0), target.mean(axis=0), atol=1e-9)


def test_kabsch_ignores_points_of_no_weight():
    moved = se3.apply(T, POINTS)
    moved[0] += 1000.0
    assert np.allclose(se3.kabsch(POINTS, moved, np.r_[0.0, np.ones(19)]), T)


def test_kabsch_of_a_batch_is_that_of_each_pair_of_clouds_with_its_own_weights():
    source, target = rng.normal(size=(2, 4, 9, 3))
    weights = rng.uniform(0.1, 1.0, (4, 9))
    one_by_one = [se3.kabsch(*each) for each in zip(source, target, weights, strict=True)]
    np.testing.assert_allclose(se3.kabsch(source, target, weights), one_by_one, atol=1e-12)
    np.testing.assert_allclose(se3.kabsch(source, target), se3.kabsch(source, target, np.full((4, 9), 0.3)), atol=1e-12)


def test_kabsch_beats_every_motion_nearby():
    source, target, weights = rng.normal(size=(9, 3)), rng.normal(size=(9, 3)), rng.uniform(0.1, 1.0, 9)

    def cost(motion):
        return weights @ ((se3.apply(motion, source) - target) ** 2).sum(axis=1)

    best = se3.kabsch(source, target, weights)
    nearby = [se3.exp(0.01 * twist) @ best for twist in np.vstack([np.eye(6), -np.eye(6)])]
    assert cost(best) < min(map(cost, nearby))


def test_exp_turns_about_the_centre_that_is_named():
    centre = np.array([5.0, 6.0, 7.0])
    motion = se3.exp([1.0, 2.0, 3.0, 0.1, -0.2, 0.3], centre)
    assert np.allclose(se3.apply(motion, centre[None])[0], centre + [1.0, 2.0, 3.0])


def test_the_nearest_rigid_motion_has_a_proper_rotation():
    bent = T + rng.normal(size=(4, 4)) * 1e-3
    R = se3.nearest_rigid(bent)[:3, :3]
    assert np.array_equal(se3.nearest_rigid(bent)[:, 3], [*bent[:3, 3], 1.0])
    assert np.allclose(R @ R.T, np.eye(3)) and np.linalg.det(R) == pytest.approx(1.0)


def test_poses_are_as_far_apart_as_they_put_points_on_average():
    quarter = se3.exp([0.0, 0.0, 0.0, 0.0, 0.0, np.pi / 2.0])
    points = [[3.0, 0.0, 0.0], [0.0, 0.0, 5.0]]  # moved by 3 sqrt(2) and by nothing: root of (18 + 0) / 2
    assert se3.rms_apart_mm(T @ quarter, T, points) == pytest.approx(3.0)


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize(("size", "said"), [
    (1.0, ""), (1.01, "determinant 1.03"), (1e5, "determinant 1e+15"), (1e200, "an entry of size 1e+200"),
])  # fmt: skip
def test_what_keeps_a_motion_from_being_rigid_is_said_of_numbers_of_any_size(size, said):
    why = se3.why_not_rigid(np.diag([size, size, size, 1.0]))
    assert why == (f"rotation part has {said}" if said else "")


def test_a_matrix_of_few_digits_is_not_said_to_have_a_determinant_of_1():
    sheared = np.eye(4) + 0.1 * np.eye(4, k=1) * [1, 1, 0, 0]
    assert se3.why_not_rigid(sheared) == (
        "rotation part has axes that are off right angles and length 1 by 0.1: sheared, or of few digits"
    )
