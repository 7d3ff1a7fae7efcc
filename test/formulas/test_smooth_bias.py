"""The steps of the bias correction: its linear algebra is held by `test_bias_field`."""

from dataclasses import replace

import numpy as np
import pytest
import tiny

from gapr_core.config import RegistrarConfig, SensorConfig, SourceConfig
from gapr_core.geometry import se3
from gapr_core.geometry.twists import error_twist, nees
from gapr_core.registration.checks.assess import bias_corrected
from gapr_core.registration.checks.deformation import with_looks
from gapr_core.registration.fit import refinement
from gapr_core.registration.problem import source as sources
from gapr_core.registration.uncertainty import covariance
from gapr_core.registration.uncertainty.linear_model import NormalEquations, equations_of, fields, root_mean_square
from gapr_core.registration.uncertainty.smooth_bias import (
    EVIDENCE,
    FEWEST_POINTS,
    LARGEST_MOVE,
    SIZES_MM,
    SMALLEST_SHARE,
    STEPS,
    believed_size_mm,
    corrected_fit,
)

CONFIG = RegistrarConfig(num_threads=1)
LOOSE = np.diag([1e3] * 3 + [10.0] * 3)


@pytest.fixture(scope="module")
def biased():
    """600 points of one half of an egg, off it by waves of 1 mm."""
    egg = tiny.ellipsoid((60.0, 40.0, 30.0), count=4000)
    rng = np.random.default_rng(0)
    some = rng.permutation(np.flatnonzero(egg.points[:, 2] > -5.0))[:600]
    points, normals = egg.points[some], egg.normals[some]
    wave = np.sin(points @ [0.10, 0.04, 0.02] + 0.5)[:, None]

    def of(fitted=1500, size_mm=1.0):
        moved = points + size_mm * wave * normals + rng.normal(0.0, 0.1, points.shape)
        source = sources.prepare(moved, SourceConfig(fitted_points=fitted))
        fit = refinement.refine_fully(np.eye(4), source.points, egg, CONFIG.refinement, source.neighbours)
        return refinement.rest_on_whole(fit, source, egg, CONFIG.refinement), source, egg

    return of


@pytest.mark.parametrize("fitted", [1500, 200])
def test_each_step_is_that_of_generalised_least_squares_about_the_centroid_of_all_points(biased, fitted):
    fit, source, target = biased(fitted)
    found, before = corrected_fit(fit, LOOSE, source, target, CONFIG), fit.full_fit
    assert (fit.whole is not None) is (fitted < 600)
    trust = None if fit.whole is None else refinement.trust_of_whole(fit, source, CONFIG.refinement)
    spanned, now = fields(before), before
    equations = first = equations_of(before)
    for _ in range(STEPS):
        size_mm = believed_size_mm(equations)
        assert size_mm > 0.0
        T = se3.exp(equations.step(size_mm), now.moved.mean(axis=0)) @ now.T
        if trust is None:
            now = refinement.evaluate_with_patches(T, source.points, target, CONFIG.refinement, source.neighbours)
        else:
            now = refinement.evaluate_trusted(T, source.whole, target, CONFIG.refinement, trust)
        equations = NormalEquations.of(now, spanned).with_design_effect(first.design_effect)  # that of the first stays
    np.testing.assert_allclose(found.T, T, atol=1e-12)
    assert found.bias_mm == found.full_fit.bias_mm == pytest.approx(size_mm)
    assert len(found.moved) == len(source.points) and len(found.full_fit.moved) == 600
    assert np.array_equal(found.full_fit.weights, now.weights)


def test_a_bias_is_believed_from_its_evidence_on(biased):
    sizes = []
    for size_mm in np.linspace(0.0, 0.4, 9):
        equations = equations_of(biased(size_mm=size_mm)[0])
        log_likelihood = equations.log_likelihood(SIZES_MM, SMALLEST_SHARE)
        expected = root_mean_square(SIZES_MM, log_likelihood) if log_likelihood.max() >= EVIDENCE else 0.0
        sizes.append(believed_size_mm(equations))
        assert sizes[-1] == expected
    assert sizes[0] == 0.0 < sizes[-1]
    fit, source, target = biased(size_mm=0.0)
    assert corrected_fit(fit, LOOSE, source, target, CONFIG) is fit


@pytest.mark.parametrize(("inliers", "is_moved"), [(FEWEST_POINTS - 1, False), (FEWEST_POINTS, True)])
def test_too_few_inliers_show_no_bias(biased, inliers, is_moved):
    fit, source, target = biased()
    few = replace(fit, weights=np.where(np.cumsum(fit.counts) <= inliers, fit.weights, 0.0))
    assert (corrected_fit(few, LOOSE, source, target, CONFIG) is not few) is is_moved


@pytest.mark.parametrize(("factor", "is_moved"), [(1.01, True), (0.99, False)])
def test_a_move_beyond_the_limit_in_its_covariance_is_not_made(biased, factor, is_moved):
    """The limit is a squared Mahalanobis distance of the move; the covariance is scaled to lie on either side."""
    fit, source, target = biased()
    moved = corrected_fit(fit, LOOSE, source, target, CONFIG)
    distance = nees(error_twist(moved.T, fit.T, source.points), LOOSE)
    found = corrected_fit(fit, LOOSE * distance / LARGEST_MOVE * factor, source, target, CONFIG)
    assert (found is not fit) is is_moved


@pytest.mark.parametrize("sensor", [SensorConfig(), SensorConfig("depth_camera", scale=0.01)])
@pytest.mark.parametrize("looks", [1, 2])
def test_an_assessment_gets_the_pose_and_its_covariance_or_stays_the_same(biased, sensor, looks):
    fit, source, target = biased()
    config = replace(CONFIG, sensor=sensor)
    a = tiny.assessed(source.points, target, known=replace(tiny.uncertainty(), covariance=LOOSE))
    a = replace(a, fit=fit, source=source, viewpoint=np.array([0.0, 0.0, 400.0]), look=np.arange(600) % looks)
    found = bias_corrected(a, config)
    expected = corrected_fit(fit, LOOSE, source, target, config)
    assert np.array_equal(found.fit.T, expected.T) and found.judgement is a.judgement
    eye = covariance.eye_of(expected.T, a.viewpoint, sensor)
    misfits_mm = a.uncertainty.smooth_mm, a.uncertainty.short_mm
    known = covariance.estimate(expected, config.covariance, sensor, None, misfits_mm, eye)
    np.testing.assert_allclose(found.uncertainty.covariance, with_looks(known, expected, a.look).covariance)
    assert (found.uncertainty.smooth_mm, found.uncertainty.short_mm) == misfits_mm
    few = replace(a, fit=replace(fit, weights=np.zeros(600)))
    assert bias_corrected(few, config) is few
