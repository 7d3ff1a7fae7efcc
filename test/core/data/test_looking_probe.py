"""Looks of a probe that goes where it is asked to."""

import numpy as np
import open3d as o3d
import pytest

from gapr_core.data.looking_probe import LookingProbe, LookSize
from gapr_core.data.pool import parametric_specimen
from gapr_core.data.specimen import Specimen
from gapr_core.geometry import se3
from gapr_core.surface import Surface

EXACT = LookSize(noise_mm=0.0, bias_mm=0.0)


@pytest.fixture(scope="module")
def tibia():
    return parametric_specimen("tibia", 3)


def seen(probe, centre, number=0):
    return se3.apply(probe.T_target_source, probe.look(centre, number))


def test_an_exact_look_lies_on_the_bone_about_the_place_asked_for(tibia):
    probe, centre = LookingProbe(tibia, 1, EXACT), tibia.surface.points[100]
    points = seen(probe, centre)
    assert len(points) == 60 and tibia.distance(points).max() < 1e-2
    assert np.linalg.norm(points - centre, axis=1).max() < 15.0 + 2.0
    assert np.linalg.norm(points - centre, axis=1).max() > 8.0, "a patch, not a dot"


def test_a_look_shows_one_side_of_a_thin_bone():
    plate = Surface.from_open3d(o3d.geometry.TriangleMesh.create_box(80.0, 80.0, 3.0))
    points = seen(LookingProbe(Specimen(plate, "plate", "nobody"), 1, EXACT), np.array([40.0, 40.0, 3.0]))
    assert len(points) == 60 and (points[:, 2] > 2.9).all()


def test_noise_is_white_and_bias_is_shared_by_a_look(tibia):
    centre = tibia.surface.points[100]
    noisy = seen(LookingProbe(tibia, 1, LookSize(points=200, bias_mm=0.0)), centre)
    assert 0.8 < tibia.distance(noisy).mean() < 1.6  # mean of |N(0, 1.5)| is 1.2
    probe = LookingProbe(tibia, 1, LookSize(noise_mm=0.0))
    biases = [tibia.distance(seen(probe, centre, number)) for number in range(12)]
    assert all(np.ptp(bias) < 0.35 for bias in biases), "one bias for all points"
    assert 0.25 < np.sqrt(np.mean([bias.mean() ** 2 for bias in biases])) < 1.2


def test_the_same_look_is_the_same_and_the_next_one_is_not(tibia):
    one, two = LookingProbe(tibia, 1), LookingProbe(tibia, 1)
    np.testing.assert_array_equal(one.look(one.anywhere, 4), two.look(two.anywhere, 4))
    assert not np.array_equal(one.look(one.anywhere, 4), one.look(one.anywhere, 5))
