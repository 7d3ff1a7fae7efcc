"""The error at targets: against poses drawn from the covariance."""

import numpy as np
import pytest
from scipy.stats import chi2

from gapr_core.geometry.twists import bound_mm, predicted_rmse_mm


def random_covariance(rng):
    root = rng.normal(size=(6, 6)) * np.array([1.0] * 3 + [0.01] * 3)[:, None]
    return root @ root.T


def test_the_expected_error_and_its_bound_are_those_of_drawn_poses():
    rng = np.random.default_rng(4)
    covariance, points, centre = random_covariance(rng), rng.normal(0.0, 80.0, (60, 3)), np.array([5.0, -20.0, 60.0])
    twists = rng.multivariate_normal(np.zeros(6), covariance, 10_000)
    moves = twists[:, None, :3] + np.cross(twists[:, None, 3:], (points - centre)[None])
    errors = np.sqrt((moves**2).sum(axis=2).mean(axis=1))
    assert predicted_rmse_mm(covariance, points, centre) == pytest.approx(np.sqrt((errors**2).mean()), rel=0.03)
    assert bound_mm(covariance, points, centre) == pytest.approx(np.quantile(errors, 0.95), rel=0.05)


def test_the_bound_at_one_target_of_an_isotropic_error_is_that_of_three_degrees_of_freedom():
    covariance = np.diag([0.25] * 3 + [1e-12] * 3)
    for quantile in (0.5, 0.95):
        bound = bound_mm(covariance, np.zeros((1, 3)), np.zeros(3), quantile)
        assert bound == pytest.approx(0.5 * np.sqrt(chi2.ppf(quantile, 3)), rel=1e-6)
