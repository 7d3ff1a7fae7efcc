"""Half extent and principal axes against closed forms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gapr_core.geometry import extent


def test_the_half_extent_is_the_largest_distance_to_the_mean_and_not_to_the_origin():
    points = np.array([[100.0, 0.0, 0.0], [102.0, 0.0, 0.0], [104.0, 0.0, 0.0], [102.0, 7.0, 0.0], [102.0, -7.0, 0.0]])
    assert extent.half_extent_mm(points) == pytest.approx(7.0)


def test_principal_axes_are_the_rows_longest_first_and_follow_the_cloud():
    rng = np.random.default_rng(0)
    box = rng.uniform(-1.0, 1.0, (4000, 3)) * [5.0, 200.0, 30.0] + [10.0, 20.0, 30.0]
    turn = Rotation.random(random_state=1).as_matrix()
    axes, variances = extent.principal(box @ turn.T)
    aligned = np.abs(axes @ turn)
    np.testing.assert_allclose(aligned, [[0, 1, 0], [0, 0, 1], [1, 0, 0]], atol=0.02)
    np.testing.assert_allclose(variances, [200.0**2 / 3, 30.0**2 / 3, 5.0**2 / 3], rtol=0.1)
    np.testing.assert_allclose(np.var(box @ turn.T @ axes.T, axis=0), variances)
