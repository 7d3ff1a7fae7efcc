"""Features that unmask other bones: a scale that is off, and a mirrored source that fits as well."""

from dataclasses import replace

import numpy as np
import pytest

from gapr_core.config import RegistrarConfig, SensorConfig
from gapr_core.registration.confidence.features import of_another_bone, scale_of
from gapr_core.registration.fit.alternatives import FLIP, Trial, mirrored
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
    scale, sd = scale_of(fit_of(centre + factor * (end - centre), bone))
    assert scale == pytest.approx(1.0 / factor - 1.0, abs=0.008)
    assert 1e-4 < sd < 0.02


def test_the_scale_of_a_small_patch_is_hardly_known(bone, end):
    patch = end[np.argsort(np.linalg.norm(end - end[0], axis=1))[:250]]
    small, large = (scale_of(fit_of(points, bone))[1] for points in (patch, end))
    assert small > 3.0 * large


def test_a_bias_makes_the_scale_less_certain(bone, end):
    rng = np.random.default_rng(3)
    wave = 0.8 * np.sin(end @ rng.normal(size=3) * 0.08)[:, None] * (end - end.mean(axis=0)) / 60.0
    clean, biased = (scale_of(fit_of(points, bone))[1] for points in (end, end + wave))
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
    assert scale_of(replace(whole, **some, whole=whole)) == scale_of(whole)
    assert scale_of(replace(whole, **some)) != scale_of(whole)


def test_a_mirrored_end_is_seen_to_fit_better_mirrored_and_the_own_one_worse(bone, end):
    reflected = np.diag([-1.0, 1.0, 1.0, 1.0])
    reflected[0, 3] = 2.0 * bone.points[:, 0].mean()
    T = reflected @ FLIP  # rigid: the mirrored end beside the bone
    flipped = Trial(T, sources.prepare(end * [1.0, 1.0, -1.0]).subset(300), bone, CONFIG)
    assert mirrored(Trial(np.eye(4), sources.prepare(end).subset(300), bone, CONFIG)) > 1.0 > 0.0 > mirrored(flipped)
