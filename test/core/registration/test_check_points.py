"""Check points: what a point is expected to err by, for every kind of sensor."""

import numpy as np
import pytest

from gapr_core import RegistrarConfig, check_points
from gapr_core.config import SensorConfig
from gapr_core.registration.problem import sensor
from gapr_core.results import RegistrationResult, RegistrationStatus


@pytest.mark.parametrize("kind", sensor.KINDS)
def test_one_point_under_an_exact_pose_errs_by_all_that_its_sensor_and_the_model_do(target, kind):
    config = RegistrarConfig(sensor=SensorConfig(kind=kind))
    exact = RegistrationResult(RegistrationStatus.OK, np.eye(4), 1e-12 * np.eye(6), 0.95, centre_mm=target.centre_mm)
    found = check_points(target.points[:1], target, exact, config)
    errors, model_mm = sensor.errors(config.sensor, 1), config.covariance.model_mm
    own_mm = [errors.noise_mm, errors.local_mm, errors.bias_mm, errors.standoff_mm, errors.tracking_mm, model_mm]
    assert found.expected_mm == pytest.approx([np.linalg.norm(own_mm)], rel=1e-6)
