"""Would the source lie as well otherwise? On shapes made by hand, and against their formulas."""

from dataclasses import replace

import numpy as np
import pytest
import tiny

from gapr_core.config import RegistrarConfig, SensorConfig, VerificationConfig
from gapr_core.geometry import se3
from gapr_core.registration.fit import alternatives
from gapr_core.registration.fit.alternatives import CLIPPED, FLIP, SIZES, Trial
from gapr_core.registration.problem.sensor import offset_surface

CONFIG = RegistrarConfig(num_threads=1, verification=VerificationConfig(middle_points=200))
T = se3.exp([5.0, -3.0, 2.0, 0.4, -0.3, 0.2])


@pytest.fixture(scope="module")
def egg():
    return tiny.ellipsoid(count=1800, symmetric=True)


def bumpy(high):
    """An egg with a bump at one end, aside of all its planes."""
    egg = tiny.ellipsoid(count=1800, symmetric=True)
    bump = high * np.exp(-np.sum(np.square(egg.points - [18.0, 12.0, 6.0]), axis=1) / 2.0 / 8.0**2)
    shapes = egg.elements[:, [6, 7, 8, 7, 9, 10, 8, 10, 11]].reshape(-1, 3, 3)
    return tiny.described(egg.points * (1.0 + bump)[:, None], egg.normals, shapes, np.zeros(len(egg.points)))


@pytest.fixture(scope="module")
def lopsided():
    """A bone with a left and a right side."""
    return bumpy(1.0)


def trial(target, noise_mm=0.05, size=1.0, lift_mm=0.0):
    """A hundred and fifty points of a target, moved away by T, with noise, grown, or lifted off it."""
    rng = np.random.default_rng(1)
    some = rng.permutation(len(target.points))[:150]
    on = target.points[some] + lift_mm * target.normals[some] + rng.normal(0.0, noise_mm, (150, 3))
    on = on.mean(axis=0) + size * (on - on.mean(axis=0))
    source = tiny.assessed(se3.apply(se3.inverse(T), on), target, T).source
    return Trial(T, source.subset(CONFIG.verification.middle_points), target, CONFIG)


class Scripted(Trial):
    """Says which mean squares it found, one after the other, and keeps what it was asked."""

    def said(self, *squares):
        object.__setattr__(self, "left", list(squares))
        object.__setattr__(self, "asked", [])
        return self

    def refined(self, poses, points=None, target=None):
        self.asked.append((poses, points, target))
        return poses, np.array([self.left.pop(0)] * len(poses))


@pytest.mark.parametrize(("changed", "own", "expected"), [
    (0.03, 0.09, np.log(0.04 / 0.10)), (1e-9, 1e-12, 0.0), (0.0, 1e3, -1.5), (1e3, 0.0, 4.0),
])  # fmt: skip
def test_a_log_ratio_is_that_of_mean_squares_above_a_tenth_of_a_millimetre_and_has_ends(changed, own, expected):
    assert alternatives.log_ratio(changed, own) == pytest.approx(expected, abs=1e-6)


def test_a_source_fits_best_in_its_own_size(egg):
    own, small, large = (alternatives.other_size(trial(egg, size=size)) for size in (1.0, 0.945, 1.055))
    assert own > 0.5 > -0.5 > max(small, large)
    assert alternatives.other_size(trial(egg), (0.99, 1.01)) < own


def test_another_size_is_grown_about_the_middle_and_its_residuals_count_in_its_own_size(egg):
    """By hand: .36 mm^2 of the source, 1.2 and .9 mm^2 of the smaller and the larger one."""
    plain = trial(egg)
    scripted = Scripted(plain.T, plain.points, egg, CONFIG).said(1.2, 0.9, 0.36)
    assert alternatives.other_size(scripted) == pytest.approx(np.log((0.9 / 1.055**2 + 0.01) / (0.36 + 0.01)))
    middle = plain.points.mean(axis=0)
    for (poses, points, target), size in zip(scripted.asked, SIZES, strict=False):
        np.testing.assert_allclose(points, middle + size * (plain.points - middle), atol=1e-9)
        assert np.array_equal(poses, T[None]) and target is None


@pytest.mark.parametrize("lift_mm", [-2.0, -1.0, 1.0, 2.5])
def test_a_source_off_the_bone_fits_best_at_its_stand_off(egg, lift_mm):
    best_mm, log_ratio = alternatives.standoff(trial(egg, lift_mm=lift_mm))
    assert best_mm == lift_mm and log_ratio < -0.15 < alternatives.standoff(trial(egg))[1]


def test_a_stand_off_is_asked_of_the_surface_that_far_outside(egg):
    plain = trial(egg)
    scripted = Scripted(plain.T, plain.points, egg, CONFIG).said(3.0, 2.0, 4.0, 1.0)
    assert alternatives.standoff(scripted, (-1.0, 1.5, 2.0)) == (1.5, pytest.approx(np.log(2.01 / 1.01)))
    for (_, _, target), mm in zip(scripted.asked, (-1.0, 1.5, 2.0), strict=False):
        np.testing.assert_array_equal(target.elements, offset_surface(egg, SensorConfig(standoff_mm=mm)).elements)


def test_the_mirrored_source_of_a_lopsided_bone_fits_worse_and_a_flipped_source_better_mirrored(lopsided):
    own = trial(lopsided)
    assert alternatives.mirrored(own) > 0.5
    flipped = replace(own, points=alternatives.flipped(own.points), T=own.T @ FLIP @ np.diag([-1.0, 1.0, 1.0, 1.0]))
    assert np.linalg.det(flipped.T[:3, :3]) == pytest.approx(1.0)
    assert alternatives.mirrored(replace(flipped, T=best_of_flipped(flipped))) < 0.0


def best_of_flipped(trial):
    """The pose of the flipped source on the lopsided bone: at the image of where the own one lies."""
    H = np.diag([1.0, 1.0, -1.0, 1.0])  # the plane in which the bump is the least
    return trial.refined((H @ T @ FLIP)[None])[0][0]


def test_a_bone_that_is_its_own_mirror_image_has_no_other_side(egg):
    assert alternatives.mirrored(trial(egg)) == CLIPPED[1] and alternatives.is_symmetric(trial(egg))


def test_on_an_image_that_is_nearly_its_own_a_source_fits_as_the_bone_is_symmetric(egg):
    """Of mean squares and of robust variances the larger: of the first most may be of a few gross points."""
    of_egg, of_few = trial(egg), trial(bumpy(0.3))
    assert abs(alternatives.on_own_image(of_egg)) < 0.2 < 0.5 < alternatives.on_own_image(of_few)
    for plain, image_mm2, least in ((of_few, 0.001, 0.1), (of_egg, 99.0, CLIPPED[1])):
        scripted = Scripted(plain.T, plain.points, plain.target, CONFIG).said(image_mm2, 0.5)
        assert alternatives.on_own_image(scripted) >= least


def test_what_is_kept_of_a_target_is_that_of_its_settings_and_its_stand_off(egg):
    target = replace(egg, cache={})
    hasty = replace(CONFIG, verification=VerificationConfig(middle_points=200, middle_limits_mm=(0.2, 0.1, 1)))
    for config in (CONFIG, hasty):
        for mm in (0.0, 3.0):
            surface = offset_surface(target, SensorConfig(standoff_mm=mm))
            alternatives.is_symmetric(replace(trial(target), config=config, target=surface))
    assert set(target.cache) == {("own image", mm, each.verification) for mm in (0.0, 3.0) for each in (CONFIG, hasty)}


def test_a_bone_without_an_image_is_not_symmetric_and_has_the_largest_ratio(egg):
    unlike = replace(trial(egg), target=replace(egg, cache={("own image", 0.0, CONFIG.verification): (None, False)}))
    assert not alternatives.is_symmetric(unlike) and alternatives.on_own_image(unlike) == CLIPPED[1]


def test_a_source_is_mirrored_at_planes_along_the_bone_and_at_its_own(lopsided):
    plain = trial(lopsided)
    scripted = Scripted(plain.T, plain.points, lopsided, CONFIG).said(1.0, 0.01)
    alternatives.mirrored(scripted)
    (poses, points, _), *_ = scripted.asked
    np.testing.assert_array_equal(points, plain.points * [1.0, 1.0, -1.0])
    reflections = poses @ FLIP @ se3.inverse(T)
    normals = []
    for H in reflections:
        normals.append(np.linalg.svd(np.eye(3) - H[:3, :3])[0][:, 0])
        np.testing.assert_allclose(H[:3, :3], np.eye(3) - 2.0 * np.outer(normals[-1], normals[-1]), atol=1e-9)
    planes = alternatives.PLANES
    for H in reflections[:planes]:
        np.testing.assert_allclose(H[:3, :3] @ lopsided.main_axes[0], lopsided.main_axes[0], atol=1e-9)
        np.testing.assert_allclose(se3.apply(H, lopsided.centre_mm[None])[0], lopsided.centre_mm, atol=1e-9)
    angles = np.arange(planes) * np.pi / planes
    np.testing.assert_allclose(np.abs(np.array(normals[:planes]) @ normals[0]), np.abs(np.cos(angles)), atol=1e-9)
    middle = se3.apply(T, plain.points).mean(axis=0)
    for H in reflections[planes:]:
        np.testing.assert_allclose(se3.apply(H, middle[None])[0], middle, atol=1e-9)
    assert len(reflections) == planes + 3 and abs(np.linalg.det(np.array(normals[planes:]))) == pytest.approx(1.0)
