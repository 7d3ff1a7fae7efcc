"""The refinement's scales and weights, each against the formula written down a second time."""

import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import tiny

from gapr_core.config import RefinementConfig
from gapr_core.geometry import se3
from gapr_core.registration.fit import kernels, refinement
from gapr_core.registration.fit.refinement import Fit

CONFIG = RefinementConfig()
RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def target():
    return tiny.ellipsoid(count=500, variance=0.04)


@pytest.fixture(scope="module")
def points():
    return tiny.on_ellipsoid(70) + np.random.default_rng(3).normal(0.0, 0.3, (70, 3))


def test_the_robust_scale_is_that_of_the_median_absolute_residual():
    signed = RNG.normal(0.0, 1.2, 301)
    assert refinement._robust_sigma(signed, CONFIG) == pytest.approx(1.4826 * np.median(np.abs(signed)))


def test_residuals_without_a_surface_count_as_large_and_the_scale_stays_within_its_limits():
    far = np.r_[np.full(60, np.nan), np.full(40, 0.5)]
    assert refinement._robust_sigma(far, CONFIG) == CONFIG.largest_sigma_mm
    assert refinement._robust_sigma(np.zeros(10), CONFIG) == CONFIG.smallest_sigma_mm


def test_the_weights_end_farther_out_where_almost_nothing_lies_beyond_three_sigma():
    clean, dirty = np.zeros(1000), np.zeros(1000)
    clean[:14], dirty[:15] = 4.0, -4.0
    assert refinement.tukey_limit(clean, 1.2, CONFIG) == pytest.approx(1.2 * CONFIG.clean_tukey_scale)
    assert refinement.tukey_limit(dirty, 1.2, CONFIG) == pytest.approx(1.2 * CONFIG.tukey_scale)
    dirty[:15] = np.nan
    assert refinement.tukey_limit(dirty, 1.2, CONFIG) == pytest.approx(1.2 * CONFIG.tukey_scale)
    dirty[:15] = 7.0  # beyond 3 sigma of 2 mm
    assert refinement.tukey_limit(dirty, 2.0, CONFIG) == pytest.approx(2.0 * CONFIG.tukey_scale)
    edge = np.r_[np.full(15, 3.0), np.zeros(985)]  # 3 sigma itself is not beyond
    assert refinement.tukey_limit(edge, 1.0, CONFIG) == pytest.approx(CONFIG.clean_tukey_scale)


def test_the_weights_of_a_fit_are_tukeys_times_the_share_of_the_noise_in_the_variance(target, points):
    """Ties the weights of NumPy to those of the compiled loop: both give the same normal equations."""
    T = se3.exp([0.4, -0.3, 0.2, 0.01, 0.02, -0.01])
    dirty = points.copy()
    dirty[:5] += 4.0
    fit = refinement.evaluate(T, dirty, target, CONFIG)
    plain, *_ = kernels.residuals_at(T, dirty, *target.kernel_view, 0.0)
    sigma = refinement._robust_sigma(plain, CONFIG)
    limit = refinement.tukey_limit(plain, sigma, CONFIG)
    signed, gradients, aside, elements = kernels.residuals_at(T, dirty, *target.kernel_view, sigma**2)
    assert fit.sigma_mm == sigma
    assert np.array_equal(fit.signed_mm, signed, equal_nan=True) and np.array_equal(fit.gradients, gradients)
    expected = np.zeros(len(dirty))
    for i in range(len(dirty)):
        square = (signed[i] ** 2 + aside[i] ** 2) / limit**2
        if square < 1.0:
            expected[i] = (1.0 - square) ** 2 * sigma**2 / (sigma**2 + target.elements[elements[i], 12])
    assert fit.weights == pytest.approx(expected)
    assert (fit.weights[:5] == 0.0).all() and fit.moved == pytest.approx(se3.apply(T, dirty))
    H, g = np.empty((6, 6)), np.empty(6)
    middle, surface = dirty.mean(axis=0), target.kernel_view
    kernels.accumulate(T, dirty, np.ones(len(dirty)), middle, *surface, limit, sigma**2, H, g)
    J = fit.jacobian
    assert np.allclose((J * fit.weights[:, None]).T @ J, H)
    assert np.allclose(-J.T @ (fit.weights * np.nan_to_num(fit.signed_mm)), g)


def test_a_point_beside_the_surface_weighs_less_by_how_far_aside_it_lies():
    """On a plate of 40 mm with elements of 4 mm radius: 3 mm and 6 mm beyond the edge of the outermost elements."""
    plate = tiny.plane(size_mm=40.0, step_mm=2.0)
    points = np.array([[27.0, 0.0, 0.1], [24.5, 0.0, 0.1], *([x, 0.0, 0.1] for x in np.linspace(-10.0, 10.0, 9))])
    fit = refinement.evaluate(np.eye(4), points, plate, replace(CONFIG, smallest_sigma_mm=1.0))
    limit = refinement.tukey_limit(fit.signed_mm, 1.0, CONFIG)
    aside = np.r_[27.0 - 24.0, 24.5 - 24.0, np.zeros(9)]
    expected = np.clip(1.0 - (0.1**2 + aside**2) / limit**2, 0.0, 1.0) ** 2
    assert fit.weights == pytest.approx(expected) and 0.0 < expected[0] < expected[1] < expected[2]


def test_the_patch_of_a_point_is_its_nearest_points_with_itself(target, points, monkeypatch):
    seen = []
    monkeypatch.setattr(refinement, "evaluate_with_patches", lambda *words: seen.append(words[4]))
    refinement.refine_fully(np.eye(4), points, target, replace(CONFIG, rounds=1, iterations=1))
    refinement.refine_fully(np.eye(4), points[:5], target, replace(CONFIG, rounds=1, iterations=1))
    apart = np.linalg.norm(points[:, None] - points, axis=2)
    assert np.array_equal(seen[0], np.argsort(apart, axis=1)[:, : refinement.PATCH_POINTS])
    assert np.array_equal(seen[1], np.argsort(apart[:5, :5], axis=1))


def test_the_jacobian_is_the_derivative_of_the_height_over_the_tangent_plane(target, points):
    fit = refinement.evaluate(np.eye(4), points, target, CONFIG)
    centre, h = fit.moved.mean(axis=0), 1e-6
    for axis in range(6):
        twist = np.zeros(6)
        twist[axis] = h
        moved = se3.apply(se3.exp(twist, centre), fit.moved)
        assert fit.jacobian[:, axis] == pytest.approx(((moved - fit.moved) * fit.gradients).sum(axis=1) / h, abs=1e-4)


def patched(means_mm, weights, sigma_mm=0.5, size=4):
    """A fit whose patches of `size` points have these residuals."""
    signed = np.repeat(means_mm, size)
    count = len(signed)
    fit = Fit(np.eye(4), sigma_mm, signed, np.repeat(weights, size), np.zeros((count, 3)), np.zeros((count, 3)))
    neighbours = np.repeat(np.arange(count).reshape(-1, size), size, axis=0)
    return fit, neighbours


def test_a_patch_that_is_off_as_a_whole_loses_its_trust():
    means = np.r_[np.full(9, 0.3), np.full(9, -0.3), [1.2, 3.0]]
    fit, neighbours = patched(means, np.ones(20))
    limit = CONFIG.patch_scale * 1.4826 * 0.3
    expected = np.clip(1.0 - (np.repeat(means, 4) / limit) ** 2, 0.0, 1.0) ** 2
    assert refinement.patch_trust(fit, neighbours, CONFIG) == pytest.approx(expected, abs=1e-6)
    assert expected[-1] == 0.0 < expected[-5] < 1.0


def test_the_mean_of_a_patch_is_weighted_and_never_trusted_less_than_noise_explains():
    signed = np.array([0.2, 0.6, 0.2, 0.6, 9.0, 0.2])
    weights = np.array([1.0, 0.5, 1.0, 0.5, 0.0, 1.0])
    fit = Fit(np.eye(4), 0.9, signed, weights, np.zeros((6, 3)), np.zeros((6, 3)))
    neighbours = np.array([[0, 1], [1, 0], [2, 3], [3, 2], [4, 5], [5, 4]])
    means = np.array([1.0 / 3.0] * 4 + [0.2] * 2)  # (0.2 + 0.3) / 1.5
    limit = CONFIG.patch_scale * max(1.4826 * np.median(means), 0.9 / np.sqrt(2.0))
    assert limit == pytest.approx(CONFIG.patch_scale * 0.9 / np.sqrt(2.0))  # the noise decides here
    expected = (1.0 - (means / limit) ** 2) ** 2
    assert refinement.patch_trust(fit, neighbours, CONFIG) == pytest.approx(expected, abs=1e-6)


def test_a_final_evaluation_is_rigid_and_has_the_patches_trust(target, points):
    neighbours = np.argsort(((points[:, None] - points[None]) ** 2).sum(axis=2), axis=1)[:, :6]
    skewed = np.eye(4)
    skewed[0, 1] += 1e-5
    fit = refinement.evaluate_with_patches(skewed, points, target, CONFIG, neighbours)
    assert np.allclose(fit.T[:3, :3] @ fit.T[:3, :3].T, np.eye(3), atol=1e-12)
    plain = refinement.evaluate(fit.T, points, target, CONFIG)
    assert fit.weights == pytest.approx(plain.weights * refinement.patch_trust(plain, neighbours, CONFIG))


def test_a_point_of_the_whole_is_trusted_as_the_patches_that_it_is_in():
    fit, neighbours = patched(np.r_[np.full(9, 0.3), np.full(9, -0.3), [1.2, 3.0]], np.ones(20))
    source = SimpleNamespace(neighbours=neighbours, patches=neighbours + 3, whole=np.zeros((84, 3)))
    trust = refinement.patch_trust(fit, neighbours, CONFIG)
    found = refinement.trust_of_whole(fit, source, CONFIG)
    total, count = np.zeros(84), np.zeros(84)
    for each, patch in zip(trust, neighbours + 3, strict=True):
        total[patch] += each
        count[patch] += 1
    assert found == pytest.approx(total / np.maximum(count, 1)) and not found[:3].any()


def test_a_pose_of_some_points_comes_to_rest_with_all_of_them(target, points):
    """Every third point is fitted: from a pose off its rest, a round with all of them, trusted as their patches."""
    some = np.arange(0, len(points), 3)
    alone = np.argsort(((points[some][:, None] - points[None]) ** 2).sum(axis=2), axis=1)[:, :6]
    own = np.arange(len(some))[:, None]
    source = SimpleNamespace(is_part=True, points=points[some], whole=points, patches=alone, neighbours=own)
    off = refinement.refine_fully(se3.exp([0.3, 0.2, -0.1, 0.0, 0.0, 0.01]), source.points, target, CONFIG, own)
    moved = replace(off, T=se3.exp([0.2, -0.1, 0.1, 0.0, 0.0, 0.005]) @ off.T)
    found = refinement.rest_on_whole(moved, source, target, CONFIG)
    limits = np.full(CONFIG.iterations, refinement.tukey_limit(moved.signed_mm, moved.sigma_mm, CONFIG))
    trust = refinement.trust_of_whole(moved, source, CONFIG)
    noise = np.full_like(limits, moved.sigma_mm**2)
    expected = kernels.refine_batch(moved.T[None], points, trust, *target.kernel_view, limits, noise)[0][0]
    assert found.T == pytest.approx(expected, abs=1e-9) and len(found.signed_mm) == len(some)
    assert found.whole.T == pytest.approx(found.T, abs=1e-12) and len(found.whole.signed_mm) == len(points)
    plain = refinement.evaluate(found.T, points, target, CONFIG)
    assert found.whole.weights == pytest.approx(plain.weights * trust) and found.full_fit is found.whole
    assert refinement.rest_on_whole(off, SimpleNamespace(is_part=False), target, CONFIG) is off is off.full_fit


def test_a_pose_in_the_basin_is_brought_home_and_rests(target, points):
    start = se3.exp([1.0, -0.8, 0.6, 0.05, -0.04, 0.06])
    fit = refinement.refine_fully(start, points, target, CONFIG)
    assert np.abs(se3.apply(fit.T, points) - points).max() < 0.6
    again = refinement.refine_fully(fit.T, points, target, CONFIG)
    assert np.abs(se3.apply(again.T, points) - se3.apply(fit.T, points)).max() < 5e-3


def test_rounds_end_when_the_points_rest_and_not_before(target, points, monkeypatch):
    calls = []
    true = kernels.refine_batch
    monkeypatch.setattr(kernels, "refine_batch", lambda *args: (calls.append(args), true(*args))[1])
    start = se3.exp([0.5, -0.4, 0.3, 0.02, 0.0, 0.03])
    refinement.refine_fully(start, points, target, replace(CONFIG, rest_mm=1e-9, rounds=5))
    assert len(calls) == 5 and all(len(call[8]) == CONFIG.iterations for call in calls)
    assert all((call[2] == 1.0).all() for call in calls[: CONFIG.free_rounds])  # trust of all at first
    assert all((call[2] < 1.0).any() for call in calls[CONFIG.free_rounds :])
    fit = refinement.evaluate(start, points, target, CONFIG)
    assert calls[0][8] == pytest.approx(refinement.tukey_limit(fit.signed_mm, fit.sigma_mm, CONFIG))
    assert calls[0][9] == pytest.approx(fit.sigma_mm**2)
    calls.clear()
    refinement.refine_fully(np.eye(4), points, target, replace(CONFIG, rest_mm=1.0, rounds=5))
    assert len(calls) == CONFIG.free_rounds + 1


def test_many_poses_are_refined_as_each_alone(target, points):
    poses = np.array([se3.exp(RNG.normal(size=6) * [1, 1, 1, 0.03, 0.03, 0.03]) for _ in range(5)])
    limits = np.linspace(6.0, 4.0, 3)
    refined, scores = refinement.refine_many(poses, points, target, limits, num_threads=2)
    for k, pose in enumerate(poses):
        alone, score = kernels.refine_batch(
            pose[None], points, np.ones(len(points)), *target.kernel_view, limits, 0 * limits
        )
        assert np.allclose(refined[k], alone[0]) and scores[k] == pytest.approx(score[0])


@pytest.mark.parametrize(("iterations", "own_thread"), [(714, True), (715, False)])
def test_little_work_is_done_without_another_thread(target, points, monkeypatch, iterations, own_thread):
    """Of two poses and 70 points 715 iterations are more than 100 000 moved points."""

    def noted(poses, *_):
        ran_in.add(threading.get_ident())
        return poses, np.zeros(len(poses))

    ran_in: set[int] = set()
    monkeypatch.setattr(kernels, "refine_batch", noted)
    refinement.refine_many(np.stack([np.eye(4)] * 2), points, target, np.ones(iterations), num_threads=2)
    assert (ran_in == {threading.get_ident()}) is own_thread
