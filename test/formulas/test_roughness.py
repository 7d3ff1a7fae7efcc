"""The covariogram of the residuals: what noise, a smooth bias and another bone's ridges leave in it."""

import numpy as np
import pytest

from gapr_core.registration import bias_field, roughness
from gapr_core.registration.refinement import Fit

UP = np.array([0.0, 0.0, 1.0])


def plane_fit(signed, feet, weights=None, sigma_mm=1e6):
    """Points that lie `signed` above feet (N, 3) of a plane; with so large a sigma no residual is damped."""
    count = len(feet)
    normals = np.tile(UP, (count, 1))
    moved = feet + signed[:, None] * normals
    weights = np.ones(count) if weights is None else weights
    return Fit(np.eye(4), sigma_mm, signed, weights, normals, np.zeros(count, dtype=np.int64), moved)


def feet_of(count=3000, seed=0):
    return np.random.default_rng(seed).uniform(0.0, 120.0, (count, 3)) * [1.0, 1.0, 0.0]


def field(feet, length_mm, size_mm, rng):
    """A draw of a Gaussian process of this correlation length and standard deviation."""
    K = bias_field.smooth_correlation(feet, feet, length_mm) + 1e-6 * np.eye(len(feet))
    return size_mm * np.linalg.cholesky(K) @ rng.normal(size=len(feet))


def test_it_is_the_difference_of_the_two_mean_products():
    """Four points by hand: pairs at 5 mm (products 2 and 12), at 15 to 20 mm (3, 4, 6, 8)."""
    feet = np.array([[0.0, 0, 0], [5.0, 0, 0], [0.0, 15.0, 0], [5.0, 15.0, 0]])
    found = roughness.rough_misfit_mm(plane_fit(np.array([1.0, 2.0, 3.0, 4.0]), feet))
    assert found == pytest.approx(np.sqrt((2 + 12) / 2 - (3 + 8 + 4 + 6) / 4))
    turned = roughness.rough_misfit_mm(plane_fit(np.array([1.0, -2.0, 3.0, -4.0]), feet))
    assert turned == pytest.approx(-np.sqrt((2 + 12) / 2 + (3 + 8 - 4 - 6) / 4))


def test_large_residuals_are_damped():
    """By hand: r (1 - (r / 4 sigma)^2) of (1, 2, 3, 5) with a sigma of 1 is (15/16, 3/2, 21/16, 0)."""
    feet = np.array([[0.0, 0, 0], [5.0, 0, 0], [0.0, 15.0, 0], [5.0, 15.0, 0]])
    signed, (a, b, c) = np.array([1.0, 2.0, 3.0, 5.0]), (15 / 16, 3 / 2, 21 / 16)
    places, damped = roughness.on_the_bone(plane_fit(signed, feet, sigma_mm=1.0))
    assert damped == pytest.approx([a, b, c, 0.0]) and places == pytest.approx(feet)
    found = roughness.rough_misfit_mm(plane_fit(signed, feet, sigma_mm=1.0))
    assert found == pytest.approx(-np.sqrt((a * c + b * c) / 4 - a * b / 2))


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
    assert abs(on_the_feet) < 1.0 < 1.5 < roughness.signed_root(*(total / count))


def test_outliers_take_no_part():
    rng, feet = np.random.default_rng(3), feet_of(800)
    signed = rng.normal(0.0, 0.5, 800)
    weights = np.ones(800)
    weights[::4] = 0.0
    off = np.where(weights == 0.0, 30.0, signed)
    kept = weights > 0.0
    alone = roughness.rough_misfit_mm(plane_fit(signed[kept], feet[kept]))
    assert roughness.rough_misfit_mm(plane_fit(off, feet, weights)) == pytest.approx(alone)


def test_without_pairs_there_is_nothing_to_say():
    feet = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [100.0, 0.0, 0.0]])
    assert roughness.rough_misfit_mm(plane_fit(np.ones(3), feet)) == 0.0
    assert roughness.rough_misfit_mm(plane_fit(np.ones(3), feet, np.zeros(3))) == 0.0
