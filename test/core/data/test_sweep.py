"""The simulated probe."""

import numpy as np
import pytest

from gapr_core.data import sweep
from gapr_core.data.parametric import make_bone
from gapr_core.data.specimen import Specimen
from gapr_core.geometry import se3


@pytest.fixture(scope="module")
def femur():
    return Specimen(make_bone("femur", 3), "femur", "3")


@pytest.fixture(scope="module")
def swept(femur):
    return sweep.simulate(femur, seed=5)


def test_the_cloud_grows_and_keeps_what_it_had(swept):
    for before, after in zip(swept.clouds, swept.clouds[1:], strict=False):
        assert len(after) >= len(before)
        np.testing.assert_array_equal(after[: len(before)], before)
    assert len(swept.clouds[0]) < 300 and len(swept.clouds[-1]) > 3000


def test_the_truth_lays_the_points_on_the_bone(femur, swept):
    distances = femur.distance(se3.apply(swept.T_target_source, swept.clouds[-1]))
    assert np.median(distances) < 1.0
    assert 0.02 < (distances > 3.0).mean() < 0.08  # the outliers asked for, and no others


def test_without_errors_every_point_lies_on_the_bone(femur):
    clean = sweep.simulate(femur, 5, sweep.Acquisition(noise_mm=0.0, bias_mm=0.0, outlier_share=0.0))
    assert femur.distance(se3.apply(clean.T_target_source, clean.clouds[-1])).max() < 0.01


def test_the_probe_sees_one_side_only(femur, swept):
    aligned = se3.apply(swept.T_target_source, swept.clouds[-1])
    shaft = femur.surface.points[:, 2]
    middle = lambda z: np.abs(z - shaft.mean()) < 60.0  # noqa: E731
    front, whole = aligned[middle(aligned[:, 2]), 1], femur.surface.points[middle(shaft), 1]
    assert (front > whole.mean() + 0.25 * np.ptp(whole)).mean() < 0.1  # y runs backwards


def test_the_sweep_goes_from_one_end_to_the_other(femur, swept):
    first, last = (se3.apply(swept.T_target_source, c)[:, 2] for c in (swept.clouds[0], swept.clouds[-1]))
    low, high = femur.surface.points[:, 2].min(), femur.surface.points[:, 2].max()
    assert np.median(first) > high - 0.1 * (high - low)
    assert np.percentile(last, 2) < low + 0.1 * (high - low)


def test_the_same_seed_gives_the_same_sweep_and_another_one_another(femur, swept):
    np.testing.assert_array_equal(sweep.simulate(femur, 5).clouds[-1], swept.clouds[-1])
    assert not np.allclose(sweep.simulate(femur, 6).T_target_source, swept.T_target_source)
