"""The covariogram of the residuals: what noise, a smooth bias and another bone's ridges leave in it."""

import numpy as np
import pytest

from gapr_core.registration.confidence import roughness
from gapr_core.registration.fit.refinement import Fit
from gapr_core.registration.uncertainty import linear_model as bias_field

UP = np.array([0.0, 0.0, 1.0])


def plane_fit(signed, feet, weights=None, sigma_mm=1e6):
    """Points that lie `signed` above feet (N, 3) of a plane; with so large a sigma no residual is damped."""
    count = len(feet)
    normals = np.tile(UP, (count, 1))
    moved = feet + signed[:, None] * normals
    weights = np.ones(count) if weights is None else weights
    return Fit(np.eye(4), sigma_mm, signed, weights, normals, moved)


def feet_of(count=3000, seed=0):
    return np.random.default_rng(seed).uniform(0.0, 120.0, (count, 3)) * [1.0, 1.0, 0.0]


def field(feet, length_mm, size_mm, rng):
    """A draw of a Gaussian process of this correlation length and standard deviation."""
    K = bias_field.smooth_correlation(feet, feet, length_mm) + 1e-6 * np.eye(len(feet))
    return size_mm * np.linalg.cholesky(K) @ rng.normal(size=len(feet))


def possible(near, far, largest, near_pairs, far_pairs):
    """By hand: the difference of the two means, and 1.645 standard deviations of it; each pair is counted twice."""
    difference = near - far + 1.645 * largest * np.sqrt(1.0 / near_pairs + 1.0 / far_pairs)
    return np.sign(min(difference, largest)) * np.sqrt(abs(min(difference, largest)))


FOUR = np.array([[0.0, 0, 0], [5.0, 0, 0], [0.0, 15.0, 0], [5.0, 15.0, 0]])  # pairs: two at 5 mm, four at 15 to 20 mm


def test_it_is_what_the_difference_of_the_two_mean_products_may_be(monkeypatch):
    """Four points by hand: products 2 and 12 of near ones, 3, 8, 4 and 6 of far ones."""
    monkeypatch.setattr(roughness, "SURE_SIGMAS", 0.0)
    found = roughness.rough_misfit_mm(plane_fit(np.array([1.0, 2.0, 3.0, 4.0]), FOUR))
    assert found == pytest.approx(np.sqrt((2 + 12) / 2 - (3 + 8 + 4 + 6) / 4))
    turned = roughness.rough_misfit_mm(plane_fit(np.array([1.0, -2.0, 3.0, -4.0]), FOUR))
    assert turned == pytest.approx(-np.sqrt((2 + 12) / 2 + (3 + 8 - 4 - 6) / 4))
    monkeypatch.undo()
    turned = roughness.rough_misfit_mm(plane_fit(np.array([1.0, -2.0, 3.0, -4.0]), FOUR))
    assert turned == pytest.approx(possible(-7.0, 0.25, (1 + 4 + 9 + 16) / 4, 2, 4))
    assert turned == pytest.approx(1.853, abs=1e-3)


def test_it_is_at_most_the_size_of_the_residuals():
    found = roughness.rough_misfit_mm(plane_fit(np.array([1.0, 2.0, 3.0, 4.0]), FOUR))
    assert found == pytest.approx(np.sqrt((1 + 4 + 9 + 16) / 4))
    assert found < np.sqrt(7.0 - 5.25 + 1.645 * 7.5 * np.sqrt(1 / 2 + 1 / 4))


def test_the_more_pairs_the_less_is_possible():
    """Of noise alone: what is found of 200 points is well above what is found of 6000, and both above nothing."""
    rng, found = np.random.default_rng(5), []
    for count in (200, 6000):
        several = [plane_fit(rng.normal(0.0, 1.0, count), feet_of(count, seed)) for seed in range(20)]
        found.append([roughness.rough_misfit_mm(fit) for fit in several])
    assert np.median(found[0]) > 2.0 * np.median(found[1]) > 0.1
    assert (np.array(found) > 0.0).mean() > 0.85  # 95 % of the truth is below, and the truth is nothing


def test_large_residuals_are_damped(monkeypatch):
    """By hand: r (1 - (r / 4 sigma)^2) of (1, 2, 3, 5) with a sigma of 1 is (15/16, 3/2, 21/16, 0)."""
    monkeypatch.setattr(roughness, "SURE_SIGMAS", 0.0)
    signed, (a, b, c) = np.array([1.0, 2.0, 3.0, 5.0]), (15 / 16, 3 / 2, 21 / 16)
    places, damped = roughness.on_the_bone(plane_fit(signed, FOUR, sigma_mm=1.0))
    assert damped == pytest.approx([a, b, c, 0.0]) and places == pytest.approx(FOUR)
    found = roughness.rough_misfit_mm(plane_fit(signed, FOUR, sigma_mm=1.0))
    assert found == pytest.approx(-np.sqrt((a * c + b * c) / 4 - a * b / 2))


def test_the_last_bits_of_a_foot_point_do_not_decide_which_points_are_near():
    """5.9999999 and 6.0000001 mm are both 6 mm: not near."""
    for apart in (6.0 - 1e-8, 6.0 + 1e-8):
        feet = np.array([[0.0, 0, 0], [apart, 0, 0]])
        places, _ = roughness.on_the_bone(plane_fit(np.ones(2), feet))
        assert places[1, 0] == 6.0


def test_a_rough_field_shows_and_a_smooth_one_and_noise_do_not():
    rng, feet = np.random.default_rng(1), feet_of()
    noise = rng.normal(0.0, 1.5, len(feet))
    rough = noise + field(feet, 6.0, 0.8, rng)
    smooth = noise + field(feet, 60.0, 1.0, rng)
    found = [roughness.rough_misfit_mm(plane_fit(signed, feet)) for signed in (noise, smooth, rough)]
    assert abs(found[0]) < 0.35 and abs(found[1]) < 0.55
    assert found[2] == pytest.approx(0.8 * np.sqrt(0.72), abs=0.12)  # means of exp(-d^2 / 72): .79 and .07


def test_how_far_noise_lifts_the_points_does_not_decide_which_are_near():
    """Points at the same height are nearer to each other: by measured points noise alone would look rough."""
    feet = feet_of()
    noise = np.random.default_rng(2).normal(0.0, 4.0, len(feet))
    lifted = plane_fit(noise, feet)
    on_the_feet = roughness.rough_misfit_mm(lifted)
    chosen = np.arange(600)
    moved = lifted.moved
    total, count = roughness.products_mm2(moved[chosen], noise[chosen], moved, noise, roughness.LIMITS_MM, chosen)
    near, far = total / count
    assert abs(on_the_feet) < 1.2 < 1.5 < np.sqrt(near - far)


def test_outliers_take_no_part():
    rng, feet = np.random.default_rng(3), feet_of(800)
    signed = rng.normal(0.0, 0.5, 800)
    weights = np.ones(800)
    weights[::4] = 0.0
    off = np.where(weights == 0.0, 30.0, signed)
    kept = weights > 0.0
    alone = roughness.rough_misfit_mm(plane_fit(signed[kept], feet[kept]))
    assert roughness.rough_misfit_mm(plane_fit(off, feet, weights)) == pytest.approx(alone)


def test_without_pairs_all_that_is_known_is_how_large_the_residuals_are():
    feet, signed = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [100.0, 0.0, 0.0]]), np.array([1.0, -2.0, 4.0])
    assert roughness.rough_misfit_mm(plane_fit(signed, feet)) == pytest.approx(np.sqrt(21.0 / 3.0))  # none is far
    far = feet * [2.4, 1.0, 1.0]
    assert roughness.rough_misfit_mm(plane_fit(signed, far)) == pytest.approx(np.sqrt(21.0 / 3.0))  # none is near
    assert roughness.rough_misfit_mm(plane_fit(signed, feet, np.zeros(3), sigma_mm=1.5)) == 1.5  # no inlier
