"""The features of the confidence, each from a fit made by hand; the size against dense least squares."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from gapr_core.config import CovarianceConfig, RegistrarConfig, ScaleConfig, SourceConfig
from gapr_core.geometry import se3
from gapr_core.registration.confidence import features
from gapr_core.registration.confidence.classifier import Calibration
from gapr_core.registration.fit.refinement import Fit
from gapr_core.registration.fit.verification import Candidates
from gapr_core.registration.problem import source as sources
from gapr_core.registration.uncertainty.covariance import PoseUncertainty
from gapr_core.registration.uncertainty.linear_model import equations_of

COUNT = 40
AXIS = np.array([0.0, 0.0, 1.0])
T = se3.exp([1.0, 2.0, 3.0, 0.3, -0.2, 0.1])


@pytest.fixture(scope="module")
def points():
    return np.random.default_rng(0).uniform(-15.0, 15.0, (COUNT, 3)) + [40.0, 0.0, -5.0]


def fit_of(points, signed=None, weights=None, sigma_mm=0.5):
    moved = se3.apply(T, points)
    gradients = moved - moved.mean(axis=0) + np.random.default_rng(1).normal(0.0, 4.0, points.shape)
    gradients /= np.linalg.norm(gradients, axis=1, keepdims=True)
    weights = np.linspace(0.4, 1.0, len(points)) if weights is None else weights
    signed = np.zeros(len(points)) if signed is None else signed
    return Fit(T, sigma_mm, signed, weights, gradients, np.zeros(len(points), dtype=int), moved)


@pytest.fixture
def other_bone(monkeypatch):
    """Replaces size and mirror image."""
    monkeypatch.setattr(features.mirror, "margin", lambda *_: 1.25)
    monkeypatch.setattr(features.other_size, "margin", lambda *_: 0.75)
    known = SimpleNamespace(scale=(-0.03, 0.04))
    monkeypatch.setattr(features, "scale_of", lambda *_: known.scale)
    return known


def measured(fit, scores=(0.25, 0.5), normals=None, noise_mm=0.3, **more):
    count = len(fit.moved)
    normals = np.tile(AXIS, (count, 1)) if normals is None else normals
    alone = np.arange(count)[:, None]  # neighbours without a curvature
    points, flatness_mm = se3.apply(se3.inverse(T), fit.moved), np.full(count, noise_mm)
    source = SimpleNamespace(points=points, normals=normals, flatness_mm=flatness_mm, patches=alone)
    covariance = np.diag([4.0, 1.0, 0.25, 1e-4, 4e-4, 1e-6])
    known = PoseUncertainty(covariance, 0.1, 0.2, 0.3)
    candidates = Candidates(None, np.array(scores), np.array([0.7, 0.1]))
    target = SimpleNamespace(half_extent_mm=50.0)
    return features.measure(fit, candidates, known, source, target, RegistrarConfig())


def test_every_feature_says_what_its_name_says(points, other_bone):
    weights = np.where(np.arange(COUNT) < 10, 0.0, 0.5)
    found = measured(fit_of(points, weights=weights))
    assert set(found) == set(features.FEATURES) and all(isinstance(value, float) for value in found.values())
    assert found["log_sigma"] == pytest.approx(np.log(0.5)) and found["log_excess"] == pytest.approx(np.log(0.5 / 0.3))
    assert (found["smooth_misfit"], found["short_misfit"], found["support"]) == (0.2, 0.3, 0.7)
    assert found["inlier_ratio"] == 0.75 and found["residual"] == 0.5
    assert found["margin"] == pytest.approx(np.log(1.0 + 1e-3))  # the rival's mean square is twice the best one's
    assert found["log_shift_sd"] == pytest.approx(np.log(2.0))
    assert found["log_turn_sd"] == pytest.approx(np.log(np.degrees(0.02)))
    assert found["log_points"] == pytest.approx(np.log(COUNT))
    reach = max(np.linalg.norm(p - points.mean(axis=0)) for p in points)
    assert found["extent"] == pytest.approx(reach / 50.0) and found["mirror_margin"] == 1.25
    assert found["size_margin"] == 0.75


@pytest.mark.parametrize(("scores", "ratio"), [((0.25,), 2.0), ((0.25, 0.2), 1.0), ((0.25, 1.0), 4.0)])
def test_the_margin_is_that_to_the_next_pose_and_of_a_single_pose_that_to_twice_its_residual(
    points, other_bone, scores, ratio
):
    assert measured(fit_of(points), scores)["margin"] == pytest.approx(np.log(ratio - 1.0 + 1e-3))


def test_a_source_without_noise_counts_as_having_a_tenth_of_a_millimetre(points, other_bone):
    assert measured(fit_of(points), noise_mm=0.01)["log_excess"] == pytest.approx(np.log(5.0))


def on_a_cylinder(radius_mm, noise_mm, rng):
    """Points 5 mm apart on a cylinder, and lifted by noise: as a fit to that cylinder, and as a prepared source."""
    angle, height = (x.ravel() for x in np.meshgrid(np.arange(-1.0, 1.0, 5.0 / radius_mm), np.arange(0.0, 120.0, 5.0)))
    out = np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    feet, signed = radius_mm * out + height[:, None] * AXIS, rng.normal(0.0, noise_mm, len(angle))
    fit = Fit(np.eye(4), 0.5, signed, np.ones(len(feet)), out, np.zeros(len(feet), int), feet + signed[:, None] * out)
    return fit, sources.describe(fit.moved, SourceConfig())


@pytest.mark.parametrize("radius_mm", [25.0, 60.0])
def test_the_curvature_of_the_bone_is_no_noise(radius_mm, monkeypatch):
    """Of noise s a plane through k points leaves s sqrt(1 - 3 / k); without noise nothing is left of the curvature."""
    rng = np.random.default_rng(3)
    fit, source = on_a_cylinder(radius_mm, 0.5, rng)
    expected = 0.5 * np.sqrt(1.0 - 3.0 / source.neighbours.shape[1])
    found = features.noise_of(source.flatness_mm, source, fit)
    monkeypatch.setattr(features, "SURE_SIGMAS", 0.0)
    middle = features.noise_of(source.flatness_mm, source, fit)
    assert middle == pytest.approx(expected, rel=0.2) and middle < found < 1.35 * expected
    smooth, source = on_a_cylinder(radius_mm, 0.0, rng)
    assert source.noise_mm > 10.0 / radius_mm and features.noise_of(source.flatness_mm, source, smooth) < 1e-6


def test_the_noise_of_a_part_is_measured_with_the_foot_points_of_the_whole():
    fit, whole = on_a_cylinder(25.0, 0.5, np.random.default_rng(3))
    some = np.arange(0, len(whole.points), 4)
    part = SimpleNamespace(patches=whole.patches[some])
    found = features.noise_of(whole.flatness_mm[some], part, replace(fit, moved=fit.moved[some], whole=fit))
    assert found == pytest.approx(features.noise_of(whole.flatness_mm, whole, fit), rel=0.2)


def test_the_noise_counts_as_the_most_that_it_may_be():
    """The median of what is left of the variances, 1.645 standard errors up: sqrt(pi / 2) s / sqrt(patches)."""
    fit, source = on_a_cylinder(25.0, 0.0, np.random.default_rng(3))
    left = np.random.default_rng(5).uniform(0.2, 0.6, len(source.points))
    s = 1.4826 * np.median(np.abs(left - np.median(left)))
    error = np.sqrt(np.pi / 2.0) * s / np.sqrt(len(source.points) / source.patches.shape[1])
    found = features.noise_of(np.sqrt(source.flatness_mm**2 + left), source, fit)
    assert found**2 == pytest.approx(np.median(left) + 1.645 * error)


def test_a_source_that_is_flatter_than_the_bone_has_no_noise():
    """Variances add up: .5 mm of .3 mm and .4 mm; a bone of .6 mm leaves nothing."""
    fit, source = on_a_cylinder(15.0, 0.0, np.random.default_rng(4))
    bone_mm = source.flatness_mm
    assert features.noise_of(np.hypot(bone_mm, 0.3), source, fit) == pytest.approx(0.3)
    assert features.noise_of(0.9 * bone_mm, source, fit) == 0.0


def test_normals_agree_as_their_median_cosine_of_either_sign_among_inliers(points, other_bone):
    weights = np.where(np.arange(COUNT) % 2 == 0, 0.8, 0.0)
    fit = fit_of(points, weights=weights)
    cosines = np.linspace(0.5, 0.9, COUNT)
    aside = np.cross(fit.gradients, np.roll(fit.gradients, 1, axis=1))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    sign = np.where(np.arange(COUNT) % 4 == 0, 1.0, -1.0)[:, None]
    normals = sign * (cosines[:, None] * fit.gradients + np.sqrt(1.0 - cosines**2)[:, None] * aside)
    found = measured(fit, normals=normals @ T[:3, :3])
    assert found["normal_agreement"] == pytest.approx(np.median(cosines[weights > 0.0]))
    nothing = measured(fit_of(points, weights=np.zeros(COUNT)))
    assert nothing["normal_agreement"] == 0.0 and nothing["inlier_ratio"] == 0.0


@pytest.mark.parametrize(("scale", "sd", "z", "off"), [
    (-0.03, 0.0, 0.03 / 0.005, 0.03), (0.03, 0.012, 0.03 / 0.013, 0.03 * 25.0 / (25.0 + 1.44)), (0.9, 1e-5, 10.0, 0.9),
    (-0.05, 0.05, 0.05 / np.hypot(0.05, 0.005), 0.025),
])  # fmt: skip
def test_another_size_shows_in_deviations_and_shrunk_towards_none(points, other_bone, scale, sd, z, off):
    other_bone.scale = scale, max(sd, 1e-9)
    found = measured(fit_of(points))
    assert found["scale_z"] == pytest.approx(z) and found["scale_off"] == pytest.approx(off, rel=1e-3)
    assert found["log_scale_sd"] == pytest.approx(np.log(max(sd, 1e-9)))


SURE_OF_NO_BIAS = CovarianceConfig(sizes_mm=(1e-3, 1.1e-3), centres=4)


def dense_scale(fit, prior):
    """Size and its standard deviation by weighted least squares of eight unknowns, each with its prior."""
    from_centre = fit.moved - fit.moved.mean(axis=0)
    growth = (fit.gradients * from_centre).sum(axis=1) - fit.signed_mm
    J = np.column_stack([fit.gradients, np.cross(from_centre, fit.gradients), growth, np.ones(len(growth))])
    information = (J * (fit.weights / fit.sigma_mm**2)[:, None]).T @ J
    information += np.diag([1e-6] * 3 + [1e-3] * 3 + [1.0 / prior.widest**2, 1.0 / prior.standoff_mm**2])
    step = -np.linalg.solve(information, (J * (fit.weights / fit.sigma_mm**2)[:, None]).T @ fit.signed_mm)
    return step[6], np.sqrt(np.linalg.inv(information)[6, 6])


@pytest.mark.parametrize("prior", [ScaleConfig(), ScaleConfig(widest=0.05, standoff_mm=0.1)])
def test_the_size_is_that_of_least_squares_with_a_standoff_beside_it(points, prior):
    rng = np.random.default_rng(5)
    fit = fit_of(points)
    growth = (fit.gradients * (fit.moved - fit.moved.mean(axis=0))).sum(axis=1)
    fit = replace(fit, signed_mm=-0.04 * growth + 0.2 + rng.normal(0.0, 0.3, COUNT))
    scale, sd = features.scale_of(fit, SURE_OF_NO_BIAS, prior)
    effect = equations_of(fit, SURE_OF_NO_BIAS.correlation_mm, SURE_OF_NO_BIAS.centres).design_effect
    alike = replace(fit, sigma_mm=np.sqrt(effect) * fit.sigma_mm)
    assert (scale, sd) == pytest.approx(dense_scale(alike, prior), rel=1e-3) and abs(scale) > 0.01 and effect != 1.0


@pytest.mark.parametrize(("inliers", "is_known"), [(7, False), (8, True)])
def test_of_few_points_nothing_is_said_of_the_size(points, inliers, is_known):
    fit = fit_of(points, weights=(np.arange(COUNT) < inliers).astype(float))
    assert (features.scale_of(fit, SURE_OF_NO_BIAS, ScaleConfig()) != (0.0, 1.0)) is is_known


@pytest.mark.parametrize("times", [3.0, -3.0])
def test_a_size_ends_at_one_and_a_sure_one_keeps_a_small_deviation(points, times):
    """Residuals y of a source that is `times` too small: y = -times g for foot points that grow by g = r - y."""
    fit = fit_of(points, weights=np.ones(COUNT), sigma_mm=1e-6)
    outward = (fit.gradients * (fit.moved - fit.moved.mean(axis=0))).sum(axis=1)
    fit = replace(fit, signed_mm=-times / (1.0 - times) * outward)
    scale, sd = features.scale_of(fit, SURE_OF_NO_BIAS, ScaleConfig(widest=1.0, standoff_mm=1e-3))
    assert (scale, sd) == (np.sign(times), 1e-5)


def test_a_size_of_which_nothing_is_seen_has_the_deviation_of_its_prior(points):
    """Normals across the way out: the points do not move along them when the source grows."""
    fit = fit_of(points, weights=np.ones(COUNT))
    away = fit.moved - fit.moved.mean(axis=0)
    aside = np.cross(away, [0.3, 0.5, -0.8])
    fit = replace(fit, gradients=aside / np.linalg.norm(aside, axis=1, keepdims=True))
    assert features.scale_of(fit, SURE_OF_NO_BIAS, ScaleConfig(widest=0.4)) == pytest.approx((0.0, 0.4), rel=1e-6)


@pytest.mark.parametrize("kind", features.FEATURES_OF)
def test_every_curve_that_ships_falls_or_rises_as_its_sign_says(kind):
    curves = {curve.feature: curve.adds for curve in Calibration.shipped(kind).model.curves}
    signed = {name: curves[name] for name in features.SIGNS if name in curves}
    assert signed
    for name, adds in signed.items():
        assert features.SIGNS[name] in (-1, 1)
        assert (features.SIGNS[name] * np.diff(adds) >= -1e-9).all(), name
