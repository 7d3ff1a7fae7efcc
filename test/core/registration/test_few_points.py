"""Sources of 6 to 60 points: prepared without fuss; the uncertainty, not a limit, decides."""

import numpy as np
import pytest

from gapr_core.config import SourceConfig
from gapr_core.geometry import se3
from gapr_core.registration.problem import source as sources


@pytest.mark.parametrize("count", [6, 12, 30, 60, 200])
def test_few_points_are_prepared(count):
    points = np.random.default_rng(count).normal(size=(count, 3)) * [30.0, 20.0, 10.0]
    prepared = sources.prepare(points)
    assert len(prepared.points) == count
    assert np.isfinite(prepared.axes(prepared.order)).all()
    assert np.linalg.norm(prepared.normals, axis=1) == pytest.approx(np.ones(count))
    assert sorted(prepared.order) == list(range(count))
    assert prepared.neighbours.shape[1] <= max(6, count // 4)


def test_a_dense_source_has_the_neighbours_of_the_settings():
    points = np.random.default_rng(0).normal(size=(1000, 3)) * 30.0
    assert sources.prepare(points).neighbours.shape[1] == SourceConfig().normal_neighbours


@pytest.mark.parametrize("apart_mm", [1e-162, 1e-12, 1e-3])
def test_points_that_all_but_coincide_are_no_trouble(apart_mm):
    rng = np.random.default_rng(0)
    crowd = rng.normal(size=(40, 3)) * apart_mm
    crowd[:, 0] += apart_mm * np.arange(40)
    prepared = sources.prepare(np.concatenate([crowd, rng.normal(size=(20, 3)) * 30.0]))
    assert sorted(prepared.order) == list(range(len(prepared.points)))
    assert np.isfinite(prepared.flatness_mm).all()


def test_a_dozen_points_with_an_initial_pose_are_answered(registrar, femur, target):
    points, normals = femur.sample(4000, np.random.default_rng(4))
    touched = points[normals @ [0.0, 1.0, 0.0] > 0.3][:14]
    initial = se3.exp([2.0, 1.0, -2.0, 0.02, 0.0, 0.03], touched.mean(axis=0))
    result = registrar.register(touched, target, initial)
    assert result.ok
    assert se3.pose_error(result.T_target_source, np.eye(4), touched).is_right
