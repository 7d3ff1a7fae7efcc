"""The size of the source, by which other bones are unmasked: from all points that its pose rests on, a bias in it."""

from dataclasses import replace

import numpy as np
import pytest

from gapr_core.config import RegistrarConfig
from gapr_core.registration.confidence.features import scale_of
from gapr_core.registration.fit.refinement import refine_fully
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


def test_a_bias_makes_the_scale_less_certain(bone, end):
    rng = np.random.default_rng(3)
    wave = 0.8 * np.sin(end @ rng.normal(size=3) * 0.08)[:, None] * (end - end.mean(axis=0)) / 60.0
    clean, biased = (scale_of(fit_of(points, bone))[1] for points in (end, end + wave))
    assert biased > 1.5 * clean


def test_all_points_that_a_pose_rests_on_say_how_large_the_source_is(bone, end):
    whole = fit_of(end, bone)
    some = {name: getattr(whole, name)[::5] for name in ("signed_mm", "weights", "gradients", "moved")}
    assert scale_of(replace(whole, **some, whole=whole)) == scale_of(whole)
    assert scale_of(replace(whole, **some)) != scale_of(whole)
