"""The smooth bias against dense linear algebra: marginal likelihood, generalised least squares, correlation."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from gapr_core.registration.fit.refinement import Fit
from gapr_core.registration.uncertainty import linear_model as bias_field
from gapr_core.registration.uncertainty.linear_model import (
    NormalEquations,
    equations_of,
    fields,
    root_mean_square,
    smooth_correlation,
)

COUNT, FIELDS, SIGMA_MM = 24, 4, 0.6


@pytest.fixture(scope="module")
def fit():
    """Unit normals and residuals drawn at random; two points without weight, one of them without a residual."""
    rng = np.random.default_rng(2)
    normals = rng.normal(size=(COUNT, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    weights = rng.uniform(0.4, 1.0, COUNT)
    signed = rng.normal(0.0, 0.8, COUNT)
    weights[[3, 9]], signed[3] = 0.0, np.nan
    moved = rng.uniform(-20.0, 20.0, (COUNT, 3)) + [50.0, -10.0, 5.0]
    return Fit(np.eye(4), SIGMA_MM, signed, weights, normals, moved)


@pytest.fixture(scope="module")
def spanned():
    return np.random.default_rng(3).normal(size=(COUNT, FIELDS))


def dense(fit, spanned, size_mm, more=None, sizes=()):
    """J, y, covariance V of the residuals and information P of the unknowns; points without weight left out."""
    inlier = fit.weights > 0.0
    J = np.hstack([fit.gradients, np.cross(fit.moved - fit.moved.mean(axis=0), fit.gradients)])
    P = np.diag([1e-6] * 3 + [1e-3] * 3)
    if more is not None:
        J, P = np.hstack([J, more]), np.diag([*np.diag(P), *(1.0 / np.array(sizes) ** 2)])
    V = np.diag(SIGMA_MM**2 / fit.weights[inlier]) + size_mm**2 * spanned[inlier] @ spanned[inlier].T
    return J[inlier], fit.signed_mm[inlier], V, P


def test_points_are_alike_as_the_exponential_of_half_their_squared_distance():
    a, b = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]]), np.array([[0.0, 0.0, 5.0]])
    assert smooth_correlation(a, b, 5.0) == pytest.approx(np.exp([[-0.5], [-1.0]]))
    assert smooth_correlation(a, b, 10.0) == pytest.approx(np.exp([[-0.125], [-0.25]]))


def test_fields_of_all_points_have_the_correlation_of_the_bias(fit):
    F = fields(fit, 12.0, COUNT)
    inlier = fit.weights > 0.0
    assert F.shape == (COUNT, inlier.sum())
    feet = fit.moved - np.nan_to_num(fit.signed_mm)[:, None] * fit.gradients
    wanted = smooth_correlation(feet, feet, 12.0)
    assert (F @ F.T)[np.ix_(inlier, inlier)] == pytest.approx(wanted[np.ix_(inlier, inlier)], abs=2e-5)


def test_noise_along_the_normal_does_not_pass_for_a_bias():
    """A cap of 20 mm on a ball, noise of 1 mm and no bias: each field's score is of the size that chance gives it.

    As functions of the noisy points some fields change along the normal, as the residuals do.
    """
    rng = np.random.default_rng(4)
    normals = rng.normal(size=(60_000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals[normals[:, 2] > 0.7][:4000]
    signed = rng.normal(0.0, 1.0, len(normals))
    moved, weights = (25.0 + signed[:, None]) * normals, np.ones(len(normals))
    cap = Fit(np.eye(4), 1.0, signed, weights, normals, moved)

    def largest(spanned):
        information, score = NormalEquations.of(cap, spanned)._fields_alone
        counted = information > 0.03 * information[-1]
        return (score[counted] ** 2 / information[counted]).max()

    of_the_points = fields(replace(cap, signed_mm=np.zeros(len(normals))))  # each is its own foot point
    assert largest(fields(cap)) < 15.0 < 30.0 < largest(of_the_points)


def test_fields_are_spanned_by_as_many_inliers_as_asked_for(fit):
    few = fields(fit, 12.0, 5)
    assert few.shape == (COUNT, 5)
    assert ((few**2).sum(axis=1) <= 1.0 + 1e-9).all()  # never more alike to itself than 1
    centres = np.flatnonzero((few**2).sum(axis=1) > 1.0 - 1e-5)
    assert len(centres) == 5 and (fit.weights[centres] > 0.0).all()


def test_without_inliers_there_is_one_field_of_zeros(fit):
    assert np.array_equal(fields(replace(fit, weights=np.zeros(COUNT)), 12.0, 5), np.zeros((COUNT, 1)))


def test_two_centres_at_one_place_do_not_break_the_factor(fit):
    twice = replace(fit, moved=np.repeat(fit.moved[:12], 2, axis=0))
    assert np.isfinite(fields(twice, 12.0, COUNT)).all()


def test_the_centres_do_not_depend_on_rounding(fit):
    """Of two points in a voxel each is as near to their mean; what a step of 1e-13 mm adds must not choose."""
    near, rng = replace(fit, weights=np.ones(COUNT)), np.random.default_rng(6)
    pairs = np.repeat(fit.moved[:12], 2, axis=0) + np.tile([[0.0, 0.0, 0.0], [0.7, 0.3, 0.2]], (12, 1))
    first = fields(replace(near, moved=pairs), 12.0, 12)
    for _ in range(5):
        again = fields(replace(near, moved=pairs + rng.uniform(-1e-13, 1e-13, pairs.shape)), 12.0, 12)
        assert again == pytest.approx(first, abs=1e-6)


@pytest.mark.parametrize("size_mm", [0.05, 0.4, 2.0])
def test_the_log_likelihood_is_that_of_the_residuals_with_all_motions_integrated_out(fit, spanned, size_mm):
    """log N(y; 0, V + J P^-1 J^T) less the same without a bias."""
    J, y, V, P = dense(fit, spanned, size_mm)
    motions = J @ np.linalg.inv(P) @ J.T
    without = dense(fit, spanned, 0.0)[2]
    wanted = multivariate_normal(np.zeros(len(y)), V + motions).logpdf(y)
    wanted -= multivariate_normal(np.zeros(len(y)), without + motions).logpdf(y)
    found = NormalEquations.of(fit, spanned).log_likelihood(np.array([size_mm, 1e-9]), 0.0)
    assert found[0] == pytest.approx(wanted, abs=1e-4)
    assert found[1] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("size_mm", [0.05, 0.4, 2.0])
@pytest.mark.parametrize("unknowns", [0, 2])
def test_a_step_is_that_of_dense_generalised_least_squares(fit, spanned, size_mm, unknowns):
    rng, sizes = np.random.default_rng(4), (0.3, 0.05)[:unknowns]
    more = rng.normal(size=(COUNT, unknowns)) if unknowns else None
    J, y, V, P = dense(fit, spanned, size_mm, more, sizes)
    information = J.T @ np.linalg.solve(V, J) + P
    equations = NormalEquations.of(fit, spanned)
    if unknowns:
        equations = equations.extended(fit, spanned, more, sizes)
    assert equations.step(size_mm) == pytest.approx(-np.linalg.solve(information, J.T @ np.linalg.solve(V, y)))
    assert equations.step_covariance(size_mm) == pytest.approx(np.linalg.inv(information))


def test_a_motion_that_nothing_observes_stays_finite(fit, spanned):
    blind = replace(fit, weights=np.zeros(COUNT))
    equations = NormalEquations.of(blind, spanned)
    assert equations.step(0.4) == pytest.approx(np.zeros(6))
    assert np.diag(equations.step_covariance(0.4)) == pytest.approx([1e6] * 3 + [1e3] * 3)


def hand_made(information, score):
    """Fields that no motion shares: information and score of each stand on the diagonal."""
    n = len(information)
    return NormalEquations(np.eye(6), np.zeros((6, n)), np.diag(information), np.zeros(6), np.array(score))


@pytest.mark.parametrize("scale", [1.0, 0.01])
@pytest.mark.parametrize(("share", "counted"), [(0.0, 3), (0.24, 2), (0.26, 1), (0.9, 1)])
def test_fields_with_a_smaller_share_of_the_best_ones_information_do_not_count(share, counted, scale):
    information, score, size = scale * np.array([0.1, 1.0, 4.0]), np.array([3.0, -2.0, 5.0]), 0.7
    each = 0.5 * (size**2 * score**2 / (1.0 + size**2 * information) - np.log1p(size**2 * information))
    found = hand_made(information, score).log_likelihood(np.array([size]), share)
    assert found == pytest.approx([each[3 - counted :].sum()])


def test_a_field_of_exactly_the_share_does_not_count():
    found = hand_made([1.0, 4.0], [9.0, 0.0]).log_likelihood(np.array([1.0]), 0.25)
    assert found == pytest.approx([-0.5 * np.log(5.0)])


def test_without_information_nothing_speaks_for_a_bias():
    assert hand_made([0.0, 0.0], [0.0, 0.0]).log_likelihood(np.array([0.5, 1.0]), 0.1) == pytest.approx([0.0, 0.0])


def test_the_size_is_the_posterior_root_mean_square():
    sizes = np.array([0.1, 0.5, 2.0])
    chance = np.array([0.2, 0.5, 0.3])
    wanted = np.sqrt(0.2 * 0.01 + 0.5 * 0.25 + 0.3 * 4.0)
    for offset in (0.0, -2000.0, 2000.0):  # a factor of the posterior does not count, however large
        assert root_mean_square(sizes, np.log(chance) + offset) == pytest.approx(wanted)


def test_the_prior_of_a_motion_is_weak():
    assert np.array_equal(np.diag(bias_field.POSE_PRIOR), [1e-6] * 3 + [1e-3] * 3)


def by_hand(information, score):
    """Geometric mean of k under scores of variance k i + b^2 i^2, b one of the sizes, k log-normal about 1."""
    log_k, chance = np.log(bias_field.DESIGN_EFFECTS), np.zeros(len(bias_field.DESIGN_EFFECTS))
    for place, k in enumerate(bias_field.DESIGN_EFFECTS):
        for b in bias_field.BIASES_MM:
            sds = np.sqrt(k * information + b**2 * information**2)
            chance[place] += np.exp(norm.logpdf(score, 0.0, sds).sum() + norm.logpdf(log_k[place], 0.0, 0.7))
    return np.exp((chance * log_k).sum() / chance.sum())


@pytest.mark.parametrize("times", [0.3, 1.0, 4.0])
def test_the_design_effect_is_the_posterior_mean_over_scores_of_rough_and_smooth_fields(times):
    information = np.array([0.02, 0.3, 1.0, 5.0, 40.0])
    score = times * np.sqrt(information) * np.array([1.0, -0.7, 1.2, 2.0, -6.0])
    found = hand_made(information, score).expected_design_effect()
    assert found == pytest.approx(by_hand(information, score), rel=1e-6)


@pytest.mark.parametrize("effect", [0.5, 1.0, 4.0, 10.0])
@pytest.mark.parametrize("bias_mm", [0.0, 1.0])
def test_the_design_effect_is_found_whatever_the_bias(effect, bias_mm):
    rng, information = np.random.default_rng(5), np.geomspace(1e-3, 1e3, 70)
    sds = np.sqrt(effect * information + bias_mm**2 * information**2)
    found = [hand_made(information, sds * rng.normal(size=70)).expected_design_effect() for _ in range(30)]
    assert np.exp(np.mean(np.log(found))) == pytest.approx(effect, rel=0.25)


def test_fields_that_the_points_hardly_determine_say_nothing_of_the_design_effect():
    information, score = np.array([1.0, 4.0]), np.array([1.0, -3.0])
    wanted = hand_made(information, score).expected_design_effect()
    rounding = hand_made([3e-5, *information], [0.5, *score]), hand_made([5e-5, *information], [0.5, *score])
    assert rounding[0].expected_design_effect() == wanted != rounding[1].expected_design_effect()
    assert hand_made([0.0, 0.0], [0.0, 0.0]).expected_design_effect() == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("count", [0, 1, 3, 6, 7])
def test_as_few_points_as_a_pose_has_unknowns_say_nothing_of_the_design_effect(fit, count):
    """A motion fits them all: the scores that are left are rounding, and would pass for a very small noise."""
    few = replace(fit, weights=np.where(np.cumsum(fit.weights > 0.0) <= count, fit.weights, 0.0))
    assert np.count_nonzero(few.weights) == count
    assert (equations_of(few).design_effect == 1.0) == (count <= 6)


def test_a_design_effect_is_a_variance_of_all_points(fit, spanned):
    """Sums of points vary as if each point had sqrt(k) times its standard deviation; further unknowns too."""
    more, sizes = np.random.default_rng(4).normal(size=(COUNT, 2)), (0.3, 0.05)
    alike, rough = replace(fit, sigma_mm=3.0 * SIGMA_MM), NormalEquations.of(fit, spanned)
    found, wanted = rough.with_design_effect(2.0).with_design_effect(4.5), NormalEquations.of(alike, spanned)
    for name in ("JF", "FF", "Jy", "Fy"):
        assert getattr(found, name) == pytest.approx(getattr(wanted, name))
    assert found.JJ == pytest.approx(wanted.JJ, abs=1e-3)  # the prior of the motion
    found, wanted = found.extended(fit, spanned, more, sizes), wanted.extended(alike, spanned, more, sizes)
    assert found.step(0.4) == pytest.approx(wanted.step(0.4), rel=1e-3) and found.design_effect == pytest.approx(9.0)
    assert found.step_covariance(0.4) == pytest.approx(wanted.step_covariance(0.4), rel=1e-3)


@pytest.mark.parametrize(("clump", "least", "most"), [(1, 0.7, 1.2), (8, 5.0, 9.0)])
def test_points_that_err_alike_in_clumps_have_a_design_effect(clump, least, most):
    """n points with one error vary as n^2 in a sum, where n independent ones vary as n."""
    rng = np.random.default_rng(8)
    middles = rng.uniform(-40.0, 40.0, (3200 // clump, 2))
    places = np.repeat(middles, clump, axis=0) + rng.uniform(-0.5, 0.5, (3200, 2))
    x, y = places.T / 60.0
    normals = np.column_stack([x, y, np.sqrt(1.0 - x**2 - y**2)])
    signed = np.repeat(rng.normal(0.0, 0.5, len(middles)), clump)
    moved = (60.0 + signed[:, None]) * normals
    cap = Fit(np.eye(4), 0.5, signed, np.ones(3200), normals, moved)
    assert least < equations_of(cap).design_effect < most
