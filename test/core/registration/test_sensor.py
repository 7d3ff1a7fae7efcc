"""What is known of a sensor: the stand-off that is subtracted, and what widens the covariance."""

import numpy as np
import pytest

from gapr_core import RegistrarConfig
from gapr_core.config import SENSOR_KINDS, SensorConfig
from gapr_core.errors import ConfigError
from gapr_core.geometry.sampling import fibonacci_directions
from gapr_core.registration.fit import refinement
from gapr_core.registration.problem import sensor
from gapr_core.registration.problem import target as targets


@pytest.fixture(scope="module")
def egg():
    return targets.prepare(fibonacci_directions(4000) * [25.0, 30.0, 45.0])


def lifted(egg, standoff_mm, count=400):
    """Surface points of one side, moved outwards."""
    seen = np.flatnonzero(egg.normals @ [0.6, 0.0, 0.8] > 0.3)[:: max(1, len(egg.points) // count // 3)]
    return egg.points[seen] + standoff_mm * egg.normals[seen]


def test_a_known_standoff_is_taken_away_and_with_its_sign(egg):
    source = lifted(egg, 0.8)
    shifts = {}
    for stated in (None, 0.8, -0.8):
        config = SensorConfig(standoff_mm=stated)
        fit = refinement.refine_fully(
            np.eye(4), source, sensor.offset_surface(egg, config), refinement.RefinementConfig()
        )
        shifts[stated] = np.linalg.norm((fit.moved - source).mean(axis=0))
    assert shifts[0.8] < 0.1
    assert shifts[None] > 0.4
    assert shifts[-0.8] > 1.5 * shifts[None]


def test_the_residuals_are_distances_less_the_standoff(egg):
    config = refinement.RefinementConfig(smallest_sigma_mm=1e-3, largest_sigma_mm=1e-2)
    plain = refinement.evaluate(np.eye(4), lifted(egg, 1.0), egg, config)
    offset = refinement.evaluate(
        np.eye(4), lifted(egg, 1.0), sensor.offset_surface(egg, SensorConfig(standoff_mm=1.0)), config
    )
    assert np.median(plain.signed_mm) == pytest.approx(1.0, abs=0.02)
    assert np.median(offset.signed_mm) == pytest.approx(0.0, abs=0.02)


def test_without_a_standoff_the_target_is_the_same_object(egg):
    assert sensor.offset_surface(egg, SensorConfig()) is egg
    assert sensor.offset_surface(egg, SensorConfig("pointer", standoff_mm=0.0)) is egg
    moved = sensor.offset_surface(egg, SensorConfig("pointer"))
    assert moved is not egg
    assert moved.points is egg.points  # where the bone is, and its targets are, does not change


def test_a_standoff_is_added_to_that_of_a_target_that_lies_farther_out_already(egg):
    twice = sensor.offset_surface(sensor.offset_surface(egg, SensorConfig(standoff_mm=2.0)), SensorConfig("pointer"))
    assert twice.offset_mm == 2.0 + sensor.KINDS["pointer"].offset_mm == 2.5
    moved_mm = np.einsum("ni,ni->n", twice.elements[:, :3] - egg.elements[:, :3], egg.elements[:, 3:6])
    np.testing.assert_allclose(moved_mm, twice.offset_mm)


@pytest.mark.parametrize("kind", SENSOR_KINDS)
def test_what_is_stated_replaces_what_is_usual(kind):
    usual = sensor.errors(SensorConfig(kind), 100)
    stated = sensor.errors(SensorConfig(kind, standoff_mm=0.3, noise_mm=0.9, bias_mm=0.8, scale=0.05), 100)
    assert (stated.offset_mm, stated.noise_mm, stated.bias_mm, stated.scale) == (0.3, 0.9, 0.8, 0.05)
    assert stated.standoff_mm == 0.15
    known = SensorConfig(kind, standoff_mm=0.3, known_standoff_mm=0.4)
    assert sensor.errors(known, 100).standoff_mm == 0.4
    assert usual.standoff_mm > 0.0


def test_a_dense_cloud_of_an_unknown_sensor_has_less_of_a_standoff():
    few, many = (sensor.errors(SensorConfig(), count).standoff_mm for count in (50, 20_000))
    assert few == sensor.KINDS["unknown"].standoff_mm > 4.0 * many
    assert sensor.errors(SensorConfig("pointer"), 50) == sensor.errors(SensorConfig("pointer"), 5000)


@pytest.mark.parametrize(
    "wrong", [{"kind": "sonar"}, {"standoff_mm": 50.0}, {"noise_mm": -1.0}, {"scale": 0.5}, {"bias_mm": np.nan}]
)
def test_an_impossible_sensor_is_refused(wrong):
    with pytest.raises(ConfigError):
        SensorConfig(**wrong)


def test_a_sensor_can_be_read_from_a_mapping():
    config = RegistrarConfig.from_dict({"sensor": {"kind": "pointer", "standoff_mm": 1}})
    assert config.sensor == SensorConfig("pointer", 1.0)
    assert RegistrarConfig().sensor.standoff_mm is None
