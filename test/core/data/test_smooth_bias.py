import numpy as np
import pytest

from gapr_core.data import degradation
from gapr_core.data.protocols import LEVELS
from gapr_core.data.smooth_bias import SMOOTH_BIASES, process

SHEET = np.stack(np.meshgrid(np.arange(0.0, 300.0, 5.0), np.arange(0.0, 300.0, 5.0), [0.0]), axis=-1).reshape(-1, 3)


def draws(name, size_mm, count=20, points=SHEET):
    return np.array([SMOOTH_BIASES[name](points, size_mm, np.random.default_rng(seed)) for seed in range(count)])


@pytest.mark.parametrize("shape", ["wave", "waves", "gp"])
def test_a_size_is_the_root_mean_square_or_the_peak_over_the_points(shape):
    assert np.sqrt((draws(f"{shape}-rms", 0.7) ** 2).mean(axis=1)) == pytest.approx(np.full(20, 0.7))
    assert np.abs(draws(f"{shape}-peak", 0.7)).max(axis=1) == pytest.approx(np.full(20, 0.7))


def test_one_plane_wave_of_1_mm_is_07_mm_as_a_root_mean_square():
    assert np.sqrt((draws("wave", 1.0, count=200) ** 2).mean()) == pytest.approx(np.sqrt(0.5), rel=0.05)
    assert np.abs(draws("wave", 1.0)).max() <= 1.0


@pytest.mark.parametrize("name", list(SMOOTH_BIASES))
def test_a_bias_is_smooth(name):
    row = np.zeros((300, 3))
    row[:, 0] = np.arange(300.0)
    fields = draws(name, 1.0, points=row)
    assert np.abs(np.diff(fields, axis=1)).max() < 0.35
    assert np.std(fields, axis=1).max() > 0.3


def test_a_gaussian_process_forgets_within_a_hundred_millimetres():
    pair = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [120.0, 0.0, 0.0]])
    fields = np.array([SMOOTH_BIASES["gp-peak"](pair, 1.0, np.random.default_rng(seed)) for seed in range(400)])
    near, far = (np.corrcoef(fields[:, 0], fields[:, other])[0, 1] for other in (1, 2))
    assert near > 0.8 > 0.2 > abs(far)


def test_a_gaussian_process_has_a_variance_of_1():
    values = np.concatenate([process(np.eye(3) * 300.0, np.random.default_rng(seed)) for seed in range(600)])
    assert values.std() == pytest.approx(1.0, abs=0.07)


def test_the_bias_of_the_levels_is_as_it_always_was():
    """Sum of four waves, whose peak over the points is the size: the lists made before stay what they were."""
    rng, twin = np.random.default_rng(5), np.random.default_rng(5)
    vectors = degradation.random_directions(4, twin) * (2.0 * np.pi / twin.uniform(60.0, 120.0, (4, 1)))
    phases, weights = twin.uniform(0.0, 2.0 * np.pi, 4), twin.normal(size=4)
    field = np.sin(SHEET @ vectors.T + phases) @ weights
    up = np.tile([0.0, 0.0, 1.0], (len(SHEET), 1))
    expected = up * (1.0 * field / np.abs(field).max())[:, None]
    np.testing.assert_array_equal(degradation.bias_along_normals(SHEET, up, 1.0, rng), expected)


def test_levels_with_another_bias_differ_in_nothing_else():
    for level in ("L2", "L3"):
        for shape in ("wave", "waves", "gp"):
            other = LEVELS[f"{level}-{shape}"]
            assert (other.share, other.noise_mm, other.max_points) == (
                LEVELS[level].share,
                LEVELS[level].noise_mm,
                LEVELS[level].max_points,
            )
    assert LEVELS["L2-wave"].bias_mm == 1.0
    assert LEVELS["L2-gp"].bias_mm == pytest.approx(np.sqrt(0.5), abs=0.01)
