"""Features that unmask other bones: a scale that is off, and a mirrored source that fits as well."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from gapr_core.config import RegistrarConfig, SensorConfig
from gapr_core.geometry import se3
from gapr_core.registration.confidence.features import FEATURES_OF, SIGNS, of_another_bone, scale_of
from gapr_core.registration.fit import mirror, other_size
from gapr_core.registration.fit.refinement import refine_fully
from gapr_core.registration.problem import source as sources
from gapr_core.registration.problem import target as targets

CONFIG = RegistrarConfig(num_threads=1)


@pytest.fixture(scope="module")
def bone(femur_cloud):
    return targets.prepare(femur_cloud)


@pytest.fixture(scope="module")
def end(femur_cloud, femur):
    """Points of the upper third of the femur with 0.3 mm of noise, in the target's frame."""
    rng = np.random.default_rng(1)
    points = femur.sample(9000, rng)[0]
    points = points[points[:, 2] > np.quantile(points[:, 2], 0.67)]
    return points + rng.normal(0.0, 0.3, points.shape)


def fit_of(points, bone):
    return refine_fully(np.eye(4), points, bone, CONFIG.refinement)


@pytest.mark.parametrize("factor", [0.97, 1.0, 1.03])
def test_the_scale_says_how_much_larger_the_source_would_have_to_be(bone, end, factor):
    centre = end.mean(axis=0)
    scale, sd = scale_of(fit_of(centre + factor * (end - centre), bone), CONFIG.covariance, CONFIG.scale)
    assert scale == pytest.approx(1.0 / factor - 1.0, abs=0.008)
    assert 1e-4 < sd < 0.02


def test_the_scale_of_a_small_patch_is_hardly_known(bone, end):
    patch = end[np.argsort(np.linalg.norm(end - end[0], axis=1))[:250]]
    small, large = (scale_of(fit_of(points, bone), CONFIG.covariance, CONFIG.scale)[1] for points in (patch, end))
    assert small > 3.0 * large


def test_a_bias_makes_the_scale_less_certain(bone, end):
    rng = np.random.default_rng(3)
    wave = 0.8 * np.sin(end @ rng.normal(size=3) * 0.08)[:, None] * (end - end.mean(axis=0)) / 60.0
    clean, biased = (scale_of(fit_of(points, bone), CONFIG.covariance, CONFIG.scale)[1] for points in (end, end + wave))
    assert biased > 1.5 * clean


def test_a_size_within_the_sensors_own_error_speaks_less_against_the_bone(bone, end):
    centre = end.mean(axis=0)
    larger = centre + 1.03 * (end - centre)
    fit, source = fit_of(larger, bone), sources.prepare(larger)
    kinds = ("unknown", "ultrasound")  # sound is up to 3 % faster or slower than assumed
    plain, sound = (
        of_another_bone(fit, source, bone, replace(CONFIG, sensor=SensorConfig(kind=kind)))["scale_z"] for kind in kinds
    )
    assert plain > 2.5 > 2.0 > sound


def test_all_points_that_a_pose_rests_on_say_how_large_the_source_is(bone, end):
    whole = fit_of(end, bone)
    some = {name: getattr(whole, name)[::5] for name in ("signed_mm", "weights", "gradients", "elements", "moved")}
    settings = CONFIG.covariance, CONFIG.scale
    assert scale_of(replace(whole, **some, whole=whole), *settings) == scale_of(whole, *settings)
    assert scale_of(replace(whole, **some), *settings) != scale_of(whole, *settings)


def test_without_inliers_nothing_is_known_of_the_scale():
    nothing = SimpleNamespace(weights=np.zeros(9), rests_on=SimpleNamespace(weights=np.zeros(9)))
    assert scale_of(nothing, CONFIG.covariance, CONFIG.scale) == (0.0, 1.0)


def grown(points, size):
    centre = points.mean(axis=0)
    return centre + size * (points - centre)


@pytest.mark.parametrize("size", [0.94, 1.06])
def test_a_source_of_the_wrong_size_fits_better_in_another_one_and_the_right_one_worse(bone, end, size):
    def margin(points):
        return other_size.margin(fit_of(points, bone).T, sources.prepare(points), bone, CONFIG.verification, 1)

    assert margin(end) > 0.3 and margin(grown(end, size)) < -0.3


def test_the_margin_of_the_size_is_that_of_the_mean_squares_each_in_its_own_size(bone, end, monkeypatch):
    """By hand: 0.36 mm^2 of the source, 1.2 and 0.9 mm^2 of the smaller and the larger one."""
    given, squares = [], {1.0: 0.36, 0.945: 1.2, 1.055: 0.9}

    def refined(poses, points, *rest):
        given.append(points)
        return poses, np.array([squares[(1.0, *other_size.SIZES)[len(given) - 1]]])

    monkeypatch.setattr(other_size, "refine_many", refined)
    source = sources.prepare(end)
    found = other_size.margin(np.eye(4), source, bone, CONFIG.verification, 1)
    assert found == pytest.approx(np.log((0.9 / 1.055**2 + 0.01) / (0.36 + 0.01)))
    some = source.subset(CONFIG.verification.middle_points)
    for points, size in zip(given, (1.0, 0.945, 1.055), strict=True):
        np.testing.assert_allclose(points, grown(some, size), atol=1e-9)


def test_the_mirrored_source_of_a_whole_end_fits_badly(bone, end):
    prepared = sources.prepare(end)
    assert mirror.margin(np.eye(4), prepared, bone, CONFIG.verification, 1) > 1.0


def test_a_mirrored_bone_is_seen_to_fit_better_mirrored(bone, end):
    flipped = end * [1.0, 1.0, -1.0]
    through = bone.points.mean(axis=0)
    T = mirror._reflection(np.array([1.0, 0.0, 0.0]), through) @ mirror.FLIP  # rigid: the mirrored end beside the bone
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    assert mirror.margin(T, sources.prepare(flipped), bone, CONFIG.verification, 1) < 0.0


def test_a_bone_that_is_its_own_mirror_image_has_no_other_side():
    rng = np.random.default_rng(2)
    ball = rng.normal(size=(6000, 3))
    egg = ball / np.linalg.norm(ball, axis=1, keepdims=True) * [30.0, 40.0, 80.0]
    target = targets.prepare(egg)
    seen = egg[(egg[:, 0] > 0.0) & (egg[:, 2] > 10.0)]
    assert mirror.margin(np.eye(4), sources.prepare(seen), target, CONFIG.verification, 1) == mirror.LIMITS[1]


def test_a_reflection_turns_the_normal_round_and_keeps_its_plane():
    H = mirror._reflection(np.array([0.0, 0.6, 0.8]), np.array([1.0, 2.0, 3.0]))
    assert np.linalg.det(H[:3, :3]) == pytest.approx(-1.0)
    across = np.array([[1.0, 2.0, 3.0], [5.0, 2.0, 3.0], [1.0, 2.6, 3.8]])
    np.testing.assert_allclose(se3.apply(H, across), [[1.0, 2.0, 3.0], [5.0, 2.0, 3.0], [1.0, 1.4, 2.2]], atol=1e-12)


def test_signs_are_of_features():
    known = {name for names in FEATURES_OF.values() for name in names}
    assert set(SIGNS) <= known and set(SIGNS.values()) == {1, -1}
