import numpy as np
import pytest

from gapr_core.config import CovarianceConfig, RefinementConfig, RegistrarConfig, SourceConfig
from gapr_core.data.degradation import bias_along_normals
from gapr_core.geometry import se3
from gapr_core.registration.fit.refinement import refine_fully, rest_on_whole
from gapr_core.registration.problem import source as sources
from gapr_core.registration.uncertainty.covariance import estimate
from gapr_core.registration.uncertainty.smooth_bias import corrected_fit

REFINEMENT = RefinementConfig()


def view(femur, target, seed, bias_mm, noise_mm=0.4, fitted=1500, at_rest=rest_on_whole):
    """2500 points of one side, with noise and a smooth bias, and how they lie when refined from the truth."""
    rng = np.random.default_rng(seed)
    points, normals = femur.sample(16_000, rng)
    seen = np.flatnonzero(normals @ [0.0, 1.0, 0.0] > 0.2)[:2500]
    source = points[seen] + rng.normal(0.0, noise_mm, (len(seen), 3))
    if bias_mm:
        source += bias_along_normals(points[seen], normals[seen], bias_mm, rng)
    prepared = sources.prepare(source, SourceConfig(fitted_points=fitted))
    fit = refine_fully(np.eye(4), prepared.points, target, REFINEMENT, prepared.neighbours)
    return prepared, at_rest(fit, prepared, target, REFINEMENT)


def without_bias(fit, source, target):
    known = estimate(fit, CovarianceConfig()).covariance
    return corrected_fit(fit, known, source, target, RegistrarConfig())


def error_mm(T, source):
    return float(np.sqrt(((se3.apply(T, source.whole) - source.whole) ** 2).sum(axis=1).mean()))


def test_a_smooth_bias_costs_less_when_it_is_modelled(femur, target):
    plain, corrected = [], []
    for seed in range(6):
        source, fit = view(femur, target, seed, bias_mm=1.5)
        plain.append(error_mm(fit.T, source))
        corrected.append(error_mm(without_bias(fit, source, target).T, source))
    assert np.mean(np.square(corrected)) < 0.7 * np.mean(np.square(plain))


@pytest.mark.parametrize("bias_mm", [0.0, 1.5])
def test_a_pose_of_some_points_is_as_good_as_one_of_all_where_all_take_part(femur, target, bias_mm):
    """300 of 2500 points, 1 mm of noise: by themselves they are worse."""
    squares = {"all": 0.0, "some": 0.0, "some, then all": 0.0}
    for seed in range(6):
        for name, fitted, at_rest in (
            ("all", 2500, rest_on_whole), ("some", 300, lambda fit, *_: fit), ("some, then all", 300, rest_on_whole)
        ):  # fmt: skip
            source, fit = view(femur, target, seed, bias_mm, 1.0, fitted, at_rest)
            squares[name] += error_mm(without_bias(fit, source, target).T, source) ** 2
    assert squares["some, then all"] < 1.2 * squares["all"] and squares["some"] > 1.5 * squares["all"], squares
