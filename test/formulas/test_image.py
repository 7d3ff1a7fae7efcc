"""The mirror image of a source: who is asked for it, and the ratio of misfits, written down a second time."""

from dataclasses import replace

import numpy as np
import pytest
import tiny

from gapr_core.config import RegistrarConfig
from gapr_core.geometry import se3
from gapr_core.registration.checks import image
from gapr_core.registration.fit import alternatives
from gapr_core.registration.fit.kernels import residuals_at
from gapr_core.registration.fit.verification import Candidates
from gapr_core.runtime.clock import Clock

CONFIG = RegistrarConfig(num_threads=1)
OWN_MM2 = 0.5


@pytest.fixture(scope="module")
def egg():
    points = tiny.on_ellipsoid(80) + np.random.default_rng(1).normal(0.0, 0.3, (80, 3))
    return tiny.assessed(points, tiny.ellipsoid(count=500, symmetric=True), scores=(OWN_MM2, 2.0))


@pytest.fixture
def lopsided(monkeypatch):
    """An egg is its own mirror image; here it counts as none, and has this ratio on it."""

    def made(ratio):
        monkeypatch.setattr(alternatives, "is_symmetric", lambda trial: False)
        monkeypatch.setattr(alternatives, "on_own_image", lambda trial: ratio)

    return made


def asked(a, believed=False, found=None, scene=None):
    return image.log_ratio(a, CONFIG, believed, lambda *_: found, scene, Clock())


def ratio(changed_mm2, own_mm2):
    return np.clip(np.log((changed_mm2 + 0.1**2) / (own_mm2 + 0.1**2)), -1.5, 4.0)


def test_a_bone_that_is_its_own_mirror_image_has_no_other_side(egg):
    assert asked(egg, found=pytest.fail) == np.inf


@pytest.mark.parametrize(("score_mm2", "up_mm"), [(0.2, 0.0), (0.2, 1.0), (3.0, 0.0), (0.5, 0.2), (1e-9, 0.0)])
def test_the_larger_ratio_of_mean_squares_and_robust_variances_counts(egg, lopsided, score_mm2, up_mm):
    lopsided(0.5)
    T = se3.exp([0.0, 0.0, up_mm, 0.0, 0.0, 0.0])
    points = egg.source.whole * [1.0, 1.0, -1.0]
    off_mm = residuals_at(T, points, *egg.target.kernel_view, 0.0)[0]
    sigma_mm = np.clip(1.4826 * np.median(np.abs(off_mm)), 0.15, 3.0)
    expected = max(ratio(score_mm2, OWN_MM2), ratio(sigma_mm**2, egg.fit.sigma_mm**2))
    found = Candidates(T[None], np.array([score_mm2]), np.ones(1))
    assert asked(egg, found=found) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(("on_own_image", "believed", "many", "expected"), [
    (0.5, True, True, 0.5), (0.5, True, False, np.inf), (0.5, False, True, np.inf), (-0.2, False, False, -0.2),
])  # fmt: skip
def test_an_unsure_answer_or_one_of_few_points_asks_where_else_the_image_lies(
    egg, lopsided, on_own_image, believed, many, expected
):
    """No pose of the image compares with the own one."""
    lopsided(on_own_image)
    source = replace(egg.source, points=np.tile(egg.source.points, (6, 1))) if many else egg.source
    assert asked(replace(egg, source=source), believed) == expected


@pytest.mark.parametrize(("pose", "score", "expected"), [(4.0, 0.25, np.log(0.5)), (2.0, 0.25, np.inf)])
def test_the_image_of_a_scene_counts_where_it_is_surer(egg, lopsided, pose, score, expected):
    lopsided(0.5)
    of_image = tiny.assessed(egg.source.points, egg.target, pose=pose, scores=(score, 2.0))
    assert asked(egg, scene=lambda: of_image) == pytest.approx(expected)
    assert asked(egg, scene=lambda: None) == np.inf
