"""The features of the confidence, each from a fit made by hand; the size against dense least squares."""

from dataclasses import replace

import numpy as np
import pytest
import tiny

from gapr_core.config import RegistrarConfig, SensorConfig, SourceConfig, VerificationConfig
from gapr_core.geometry import se3
from gapr_core.registration.confidence import features
from gapr_core.registration.confidence.roughness import rough_misfit_mm
from gapr_core.registration.fit import alternatives
from gapr_core.registration.fit.alternatives import Trial
from gapr_core.registration.fit.refinement import Fit
from gapr_core.registration.problem import source as sources
from gapr_core.registration.uncertainty.covariance import PoseUncertainty
from gapr_core.registration.uncertainty.linear_model import equations_of

COUNT = 40
AXIS = np.array([0.0, 0.0, 1.0])
T = se3.exp([1.0, 2.0, 3.0, 0.3, -0.2, 0.1])
CONFIG = RegistrarConfig(num_threads=1, verification=VerificationConfig(middle_points=60))
KNOWN = PoseUncertainty(np.diag([4.0, 1.0, 0.25, 1e-4, 4e-4, 1e-6]), 0.1, 0.2, 0.3)


@pytest.fixture(scope="module")
def points():
    return np.random.default_rng(0).uniform(-15.0, 15.0, (COUNT, 3)) + [40.0, 0.0, -5.0]


def fit_of(points, signed=None, weights=None, sigma_mm=0.5):
    moved = se3.apply(T, points)
    gradients = moved - moved.mean(axis=0) + np.random.default_rng(1).normal(0.0, 4.0, points.shape)
    gradients /= np.linalg.norm(gradients, axis=1, keepdims=True)
    weights = np.linspace(0.4, 1.0, len(points)) if weights is None else weights
    signed = np.zeros(len(points)) if signed is None else signed
    return Fit(T, sigma_mm, signed, weights, gradients, moved)


@pytest.fixture(scope="module")
def seen():
    """Eighty points of an egg with noise, moved away by T; a fifth of them without weight."""
    on_egg = tiny.on_ellipsoid(80) + np.random.default_rng(2).normal(0.0, 0.4, (80, 3))
    a = tiny.assessed(se3.apply(se3.inverse(T), on_egg), tiny.ellipsoid(count=500), T, scores=(0.25, 0.5))
    return replace(a, fit=replace(a.fit, weights=np.where(np.arange(80) % 5 == 0, 0.0, a.fit.weights + 0.1)))


def measured(a, scores=(0.25, 0.5), config=CONFIG, **fit):
    candidates = replace(tiny.candidates(*scores), support=np.full(len(scores), 0.7), hypotheses=40)
    return features.measure(replace(a.fit, **fit), candidates, KNOWN, a.source, a.target, config)


def test_every_feature_says_what_its_name_says(seen):
    found = measured(seen, sigma_mm=0.5)
    assert tuple(found) == features.FEATURES_OF["bone"] and all(isinstance(value, float) for value in found.values())
    noise_mm = features.noise_of(seen.source, seen.fit)
    reach = max(np.linalg.norm(p - seen.source.points.mean(axis=0)) for p in seen.source.points)
    trial, fit = (
        Trial(T, seen.source.subset(CONFIG.verification.middle_points), seen.target, CONFIG),
        replace(seen.fit, sigma_mm=0.5),
    )
    scale, sd = features.scale_of(fit)
    expected = {
        "log_sigma": np.log(0.5),
        "log_excess": np.log(0.5 / noise_mm),
        "smooth_misfit": 0.2,
        "short_misfit": 0.3,
        "rough_misfit": rough_misfit_mm(fit),
        "inlier_ratio": 0.8,
        "support": 0.7,
        "log_shift_sd": np.log(2.0),
        "log_turn_sd": np.log(np.degrees(0.02)),
        "log_points": np.log(80),
        "extent": reach / seen.target.half_extent_mm,
        "scale_z": min(abs(scale) / np.hypot(sd, 0.005), 10.0),
        "scale_off": abs(scale) * 0.05**2 / (0.05**2 + sd**2),
        "log_scale_sd": np.log(sd),
        "size_margin": alternatives.other_size(trial),
        "near_size_margin": alternatives.other_size(trial, features.NEAR_SIZES),
        "mirror_margin": alternatives.mirrored(trial),
        "residual": 0.5,
        "log_hypotheses": np.log(40),
        "margin": np.log(1.0 + 1e-3),  # the rival's mean square is twice the best one's
    }
    assert {name: found[name] for name in expected} == pytest.approx(expected)


@pytest.mark.parametrize(("scores", "ratio"), [((0.25,), 2.0), ((0.25, 0.2), 1.0), ((0.25, 1.0), 4.0)])
def test_the_margin_is_that_to_the_next_pose_and_of_a_single_pose_that_to_twice_its_residual(seen, scores, ratio):
    assert measured(seen, scores)["margin"] == pytest.approx(np.log(ratio - 1.0 + 1e-3))


def test_a_source_without_noise_counts_as_having_a_tenth_of_a_millimetre(seen):
    exact = replace(seen, source=replace(seen.source, flatness_mm=np.full(80, 0.01)))
    assert measured(exact, sigma_mm=0.5)["log_excess"] == pytest.approx(np.log(5.0))


def on_a_cylinder(radius_mm, noise_mm, rng):
    """Points 5 mm apart on a cylinder, and lifted by noise: as a fit to that cylinder, and as a prepared source."""
    angle, height = (x.ravel() for x in np.meshgrid(np.arange(-1.0, 1.0, 5.0 / radius_mm), np.arange(0.0, 120.0, 5.0)))
    out = np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    feet, signed = radius_mm * out + height[:, None] * AXIS, rng.normal(0.0, noise_mm, len(angle))
    fit = Fit(np.eye(4), 0.5, signed, np.ones(len(feet)), out, feet + signed[:, None] * out)
    return fit, sources.describe(fit.moved, SourceConfig())


@pytest.mark.parametrize("radius_mm", [25.0, 60.0])
def test_the_curvature_of_the_bone_is_no_noise(radius_mm, monkeypatch):
    """Of noise s a plane through k points leaves s sqrt(1 - 3 / k); without noise nothing is left of the curvature."""
    rng = np.random.default_rng(3)
    fit, source = on_a_cylinder(radius_mm, 0.5, rng)
    expected = 0.5 * np.sqrt(1.0 - 3.0 / source.neighbours.shape[1])
    found = features.noise_of(source, fit)
    monkeypatch.setattr(features, "SURE_SIGMAS", 0.0)
    middle = features.noise_of(source, fit)
    assert middle == pytest.approx(expected, rel=0.2) and middle < found < 1.35 * expected
    smooth, source = on_a_cylinder(radius_mm, 0.0, rng)
    assert np.median(source.flatness_mm) > 10.0 / radius_mm and features.noise_of(source, smooth) < 1e-6


def test_the_noise_of_a_part_is_measured_with_the_foot_points_of_the_whole():
    fit, whole = on_a_cylinder(25.0, 0.5, np.random.default_rng(3))
    some = np.arange(0, len(whole.points), 4)
    part = replace(whole, patches=whole.patches[some], flatness_mm=whole.flatness_mm[some])
    found = features.noise_of(part, replace(fit, moved=fit.moved[some], whole=fit))
    assert found == pytest.approx(features.noise_of(whole, fit), rel=0.2)


def test_the_noise_counts_as_the_most_that_it_may_be():
    """The median of what is left of the variances, 1.645 standard errors up: sqrt(pi / 2) s / sqrt(patches)."""
    fit, source = on_a_cylinder(25.0, 0.0, np.random.default_rng(3))
    left = np.random.default_rng(5).uniform(0.2, 0.6, len(source.points))
    s = 1.4826 * np.median(np.abs(left - np.median(left)))
    error = np.sqrt(np.pi / 2.0) * s / np.sqrt(len(source.points) / source.patches.shape[1])
    found = features.noise_of(replace(source, flatness_mm=np.sqrt(source.flatness_mm**2 + left)), fit)
    assert found**2 == pytest.approx(np.median(left) + 1.645 * error)


def test_a_source_that_is_flatter_than_the_bone_has_no_noise():
    """Variances add up: .5 mm of .3 mm and .4 mm; a bone of .6 mm leaves nothing."""
    fit, source = on_a_cylinder(15.0, 0.0, np.random.default_rng(4))
    bone_mm = source.flatness_mm
    rough, flat = (replace(source, flatness_mm=mm) for mm in (np.hypot(bone_mm, 0.3), 0.9 * bone_mm))
    assert features.noise_of(rough, fit) == pytest.approx(0.3) and features.noise_of(flat, fit) == 0.0


def test_normals_agree_as_their_median_cosine_of_either_sign_among_inliers(seen):
    cosines, gradients = np.linspace(0.5, 0.9, 80), seen.fit.gradients
    aside = np.cross(gradients, np.roll(gradients, 1, axis=1))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    sign = np.where(np.arange(80) % 4 == 0, 1.0, -1.0)[:, None]
    normals = sign * (cosines[:, None] * gradients + np.sqrt(1.0 - cosines**2)[:, None] * aside)
    turned = replace(seen, source=replace(seen.source, normals=normals @ T[:3, :3]))
    assert measured(turned)["normal_agreement"] == pytest.approx(np.median(cosines[seen.fit.counts]))
    nothing = measured(turned, weights=np.zeros(80))
    assert nothing["normal_agreement"] == 0.0 and nothing["inlier_ratio"] == 0.0


@pytest.mark.parametrize("size", [1.03, 1.5])
def test_another_size_shows_in_deviations_of_the_sensor_too_and_shrunk_towards_none(seen, size):
    on_egg = tiny.on_ellipsoid(300) + np.random.default_rng(2).normal(0.0, 0.05, (300, 3))
    a = tiny.assessed(on_egg / size, tiny.ellipsoid(count=2000))
    scale, sd = features.scale_of(a.fit)
    assert abs(scale) > 0.02
    for sensor, usual in ((SensorConfig("laser", scale=0.0), 0.005), (SensorConfig("laser", scale=0.02), 0.02)):
        found = features.of_another_bone(a.fit, a.source, a.target, replace(CONFIG, sensor=sensor))
        assert found["scale_z"] == pytest.approx(min(abs(scale) / np.hypot(sd, usual), 10.0))
        assert found["scale_off"] == pytest.approx(abs(scale) * 0.05**2 / (0.05**2 + sd**2))


def dense_scale(fit):
    """Size and its standard deviation by weighted least squares of eight unknowns, each with its prior."""
    from_centre = fit.moved - fit.moved.mean(axis=0)
    growth = (fit.gradients * from_centre).sum(axis=1) - fit.signed_mm
    J = np.column_stack([fit.gradients, np.cross(from_centre, fit.gradients), growth, np.ones(len(growth))])
    information = (J * (fit.weights / fit.sigma_mm**2)[:, None]).T @ J
    information += np.diag([1e-6] * 3 + [1e-3] * 3 + [1.0 / features.WIDEST**2, 1.0 / features.STANDOFF_MM**2])
    step = -np.linalg.solve(information, (J * (fit.weights / fit.sigma_mm**2)[:, None]).T @ fit.signed_mm)
    return step[6], np.sqrt(np.linalg.inv(information)[6, 6])


@pytest.fixture
def sure_of_no_bias(monkeypatch):
    """Sizes of the smooth bias of which none is in question."""
    monkeypatch.setattr(features, "SIZES_MM", np.array([1e-3, 1.1e-3]))


def test_the_size_is_that_of_least_squares_with_a_standoff_beside_it(points, sure_of_no_bias):
    rng = np.random.default_rng(5)
    fit = fit_of(points)
    growth = (fit.gradients * (fit.moved - fit.moved.mean(axis=0))).sum(axis=1)
    fit = replace(fit, signed_mm=-0.04 * growth + 0.2 + rng.normal(0.0, 0.3, COUNT))
    scale, sd = features.scale_of(fit)
    effect = equations_of(fit).design_effect
    alike = replace(fit, sigma_mm=np.sqrt(effect) * fit.sigma_mm)
    assert (scale, sd) == pytest.approx(dense_scale(alike), rel=1e-3) and abs(scale) > 0.01 and effect != 1.0


@pytest.mark.parametrize(("inliers", "is_known"), [(0, False), (7, False), (8, True)])
def test_of_few_points_nothing_is_said_of_the_size(points, inliers, is_known):
    fit = fit_of(points, weights=(np.arange(COUNT) < inliers).astype(float))
    assert (features.scale_of(fit) != (0.0, 1.0)) is is_known


@pytest.mark.parametrize("times", [3.0, -3.0])
def test_a_size_ends_at_one_and_a_sure_one_keeps_a_small_deviation(points, times, sure_of_no_bias):
    """Residuals y of a source that is `times` too small: y = -times g for foot points that grow by g = r - y."""
    fit = fit_of(points, weights=np.ones(COUNT), sigma_mm=1e-6)
    outward = (fit.gradients * (fit.moved - fit.moved.mean(axis=0))).sum(axis=1)
    fit = replace(fit, signed_mm=-times / (1.0 - times) * outward)
    assert features.scale_of(fit) == (np.sign(times), 1e-5)


def test_a_size_of_which_nothing_is_seen_has_the_deviation_of_its_prior(points):
    """Normals across the way out: the points do not move along them when the source grows."""
    fit = fit_of(points, weights=np.ones(COUNT))
    away = fit.moved - fit.moved.mean(axis=0)
    aside = np.cross(away, [0.3, 0.5, -0.8])
    fit = replace(fit, gradients=aside / np.linalg.norm(aside, axis=1, keepdims=True))
    assert features.scale_of(fit) == pytest.approx((0.0, features.WIDEST), rel=1e-6)
