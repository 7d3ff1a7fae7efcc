"""What is expected of a sensor, and where a stand-off puts the surface."""

from dataclasses import replace

import numpy as np
import pytest
import tiny

from gapr_core.config import SENSOR_KINDS, SensorConfig
from gapr_core.registration.fit import kernels
from gapr_core.registration.problem import sensor


@pytest.mark.parametrize(("points", "share"), [(1, 1.0), (2000, 1.0), (2001, 2000 / 2001), (4000, 0.5), (8000, 0.25)])
def test_the_standoff_of_an_unknown_sensor_falls_with_the_number_of_points(points, share):
    usual = sensor.KINDS["unknown"].standoff_mm
    assert sensor.errors(SensorConfig(), points).standoff_mm == pytest.approx(usual * share)
    few = SensorConfig(sparse_points=50)
    assert sensor.errors(few, 200).standoff_mm == pytest.approx(usual / 4)


def test_an_unknown_sensor_is_no_surer_of_its_standoff_than_the_surest_that_is_named():
    surest = min(known.standoff_mm for known in sensor.KINDS.values())
    assert sensor.errors(SensorConfig(), 10**6).standoff_mm == surest > 0.0


def test_no_points_at_all_are_sparse():
    assert sensor.errors(SensorConfig(), 0) == sensor.KINDS["unknown"]


@pytest.mark.parametrize("kind", SENSOR_KINDS[1:])
def test_a_known_sensor_has_its_usual_errors_however_many_points_come(kind):
    for points in (10, 100_000):
        assert sensor.errors(SensorConfig(kind), points) == sensor.KINDS[kind]


@pytest.mark.parametrize("name", ["noise_mm", "bias_mm", "scale", "tracking_mm", "tracking_deg"])
def test_each_stated_error_replaces_the_usual_one_alone(name):
    usual, stated = sensor.KINDS["laser"], sensor.errors(SensorConfig("laser", **{name: 0.123}), 10)
    assert {key for key in vars(usual) if getattr(usual, key) != getattr(stated, key)} == {name}
    assert getattr(stated, name) == 0.123


@pytest.mark.parametrize("standoff_mm", [0.0, 0.7, -0.2])
def test_a_stated_standoff_is_subtracted_and_nearly_sure(standoff_mm):
    stated = sensor.errors(SensorConfig("pointer", standoff_mm=standoff_mm, known_standoff_mm=0.2), 10)
    assert (stated.offset_mm, stated.standoff_mm) == (standoff_mm, 0.2)
    assert stated.noise_mm == sensor.KINDS["pointer"].noise_mm


def residuals(target, points):
    return kernels.residuals_at(np.eye(4), points, *target.kernel_view, 0.0)[0]


@pytest.mark.parametrize("standoff_mm", [0.6, -0.4])
def test_residuals_are_distances_less_the_standoff(standoff_mm):
    egg = tiny.ellipsoid()
    points, before = egg.points[::7] + 0.3 * egg.normals[::7], egg.elements.copy()
    moved = sensor.offset_surface(egg, SensorConfig(standoff_mm=standoff_mm))
    assert residuals(moved, points) == pytest.approx(residuals(egg, points) - standoff_mm, abs=1e-9)
    assert np.array_equal(egg.elements, before) and moved.points is egg.points
    assert np.array_equal(moved.elements[:, 3:], before[:, 3:])


def test_without_a_standoff_the_target_stays_itself():
    egg = tiny.ellipsoid()
    assert sensor.offset_surface(egg, SensorConfig("pointer", standoff_mm=0.0)) is egg
    assert sensor.offset_surface(egg, SensorConfig()) is egg


def test_a_standoff_is_added_to_that_of_a_target_that_lies_farther_out_already():
    egg = tiny.ellipsoid()
    twice = sensor.offset_surface(sensor.offset_surface(egg, SensorConfig(standoff_mm=2.0)), SensorConfig("pointer"))
    assert twice.offset_mm == 2.0 + sensor.KINDS["pointer"].offset_mm == 2.5
    moved_mm = np.einsum("ni,ni->n", twice.elements[:, :3] - egg.elements[:, :3], egg.elements[:, 3:6])
    np.testing.assert_allclose(moved_mm, twice.offset_mm)


def test_the_inner_cortex_is_moved_as_well():
    hollow = replace(tiny.plane(), both_cortices=tiny.ellipsoid())
    moved = sensor.offset_surface(hollow, SensorConfig(standoff_mm=0.5)).both_cortices
    assert moved.elements[:, :3] - hollow.both_cortices.elements[:, :3] == pytest.approx(
        0.5 * hollow.both_cortices.normals
    )
