from dataclasses import replace

import numpy as np
import pytest

from gapr_core.config import CovarianceConfig, RefinementConfig
from gapr_core.geometry import se3
from gapr_core.geometry.twists import predicted_rmse_mm
from gapr_core.registration.fit import kernels, refinement
from gapr_core.registration.problem.target import prepare
from gapr_core.registration.uncertainty import covariance

CONFIG = RefinementConfig()


def seen_from_above(femur, count, noise_mm, seed):
    """Surface points of the upper half of the bone, with isotropic noise."""
    rng = np.random.default_rng(seed)
    points, normals = femur.sample(6 * count, rng)
    seen = points[normals @ [0.0, 1.0, 0.0] > 0.2][:count]
    return seen + rng.normal(0.0, noise_mm, seen.shape)


def test_every_pose_in_the_basin_comes_to_the_same_rest(femur, target):
    source = seen_from_above(femur, 1500, 0.5, seed=1)
    rests = []
    for seed in range(4):
        twist = np.random.default_rng(seed).normal(size=6) * [2, 2, 2, 0.03, 0.03, 0.03]
        fit = refinement.refine_fully(se3.exp(twist, source.mean(axis=0)), source, target, CONFIG)
        rests.append(se3.apply(fit.T, source))
    assert np.abs(np.array(rests) - rests[0]).max() < 0.02
    assert np.sqrt(((rests[0] - source) ** 2).sum(axis=1).mean()) < 0.3


def test_outliers_get_no_weight(femur, target):
    source = seen_from_above(femur, 1500, 0.5, seed=2)
    source[:150] += [0.0, 9.0, 0.0]
    fit = refinement.refine_fully(np.eye(4), source, target, CONFIG)
    assert (fit.weights[:150] > 0.1).mean() < 0.05
    assert (fit.weights[150:] > 0.1).mean() > 0.95
    assert fit.sigma_mm == pytest.approx(0.5, rel=0.2)


def test_noise_does_not_push_a_one_sided_cloud_along_the_view(femur, target):
    """The offset -s^2 tr(shape) / 2 must be gone: measured over several draws, with and without it."""
    lifts = {"with": [], "without": []}
    for seed in range(6):
        source = seen_from_above(femur, 3000, 1.5, seed)
        corrected = refinement.refine_fully(np.eye(4), source, target, CONFIG).T
        limits = np.full(25, CONFIG.tukey_scale * 1.5)
        start, trust = np.eye(4)[None], np.ones(len(source))
        plain = kernels.refine_batch(start, source, trust, *target.kernel_view, limits, np.zeros(25))[0][0]
        for name, T in (("with", corrected), ("without", plain)):
            lifts[name].append((se3.apply(T, source) - source).mean(axis=0)[1])
    assert abs(np.mean(lifts["with"])) < 0.5 * abs(np.mean(lifts["without"]))


def test_residuals_on_a_sphere_are_its_distances():
    from gapr_core import Registrar
    from gapr_core.geometry.sampling import fibonacci_directions

    ball = Registrar.from_pretrained().prepare(30.0 * fibonacci_directions(5000))
    probes = fibonacci_directions(777) * np.linspace(27.0, 33.0, 777)[:, None]
    fit = refinement.evaluate(np.eye(4), probes, ball, RefinementConfig(largest_sigma_mm=1e-3, smallest_sigma_mm=1e-3))
    assert fit.signed_mm == pytest.approx(np.linalg.norm(probes, axis=1) - 30.0, abs=0.02)


def test_a_patch_that_is_off_as_a_whole_is_left_out(femur, target):
    """A dent little deeper than the noise: hardly a point shows it, its neighbours together do."""
    source = seen_from_above(femur, 3000, 0.8, seed=5)
    dent = np.linalg.norm(source - source[0], axis=1) < 20.0
    source[dent] -= [0.0, 1.2, 0.0]
    careless = replace(CONFIG, patch_scale=1e6)
    careful, plain = (refinement.refine_fully(np.eye(4), source, target, c) for c in (CONFIG, careless))
    assert dent.sum() > 60
    assert np.median(careful.weights[dent]) < 0.5 * np.median(plain.weights[dent])
    assert np.median(careful.weights[~dent]) > 0.5
    shifts = [np.sqrt(((fit.moved - source) ** 2).sum(axis=1).mean()) for fit in (careful, plain)]
    assert shifts[0] < 0.7 * shifts[1]


def test_elements_at_edges_weigh_less_than_those_on_faces():
    rng = np.random.default_rng(0)
    faces = rng.uniform(-30.0, 30.0, (9000, 3))
    sides = rng.integers(3, size=9000)
    faces[np.arange(9000), sides] = rng.choice([-30.0, 30.0], 9000)
    box = prepare(faces)
    to_edge = 30.0 - np.sort(np.abs(box.points), axis=1)[:, 1]
    fit = refinement.evaluate(np.eye(4), box.points, box, CONFIG)
    assert box.elements[to_edge < 0.5, 12].mean() > 20.0 * box.elements[to_edge > 6.0, 12].mean()
    assert fit.weights[to_edge < 0.5].mean() < 0.7 < 0.95 < fit.weights[to_edge > 6.0].mean()


def test_distinct_poses_are_the_best_of_each_group():
    moved = np.zeros((5, 2, 3))
    moved[:, :, 0] = np.array([0.0, 1.0, 10.0, 10.5, 30.0])[:, None]
    assert list(kernels.distinct(moved, np.array([1, 0, 3, 2, 4]), 3.0, 5)) == [1, 3, 4]
    assert list(kernels.distinct(moved, np.array([1, 0, 3, 2, 4]), 3.0, 2)) == [1, 3]


@pytest.fixture(scope="module")
def fit(femur, target):
    return refinement.refine_fully(np.eye(4), seen_from_above(femur, 1500, 0.7, seed=4), target, CONFIG)


def test_the_predicted_error_at_targets_is_that_of_poses_drawn_from_the_covariance(fit, target):
    uncertainty = covariance.estimate(fit, CovarianceConfig())
    centroid = fit.moved.mean(axis=0)
    draws = np.random.default_rng(0).multivariate_normal(np.zeros(6), uncertainty.covariance, 400)
    squares = [
        ((se3.apply(se3.exp(twist, centroid), target.points[::40]) - target.points[::40]) ** 2).sum(1).mean()
        for twist in draws
    ]
    predicted = predicted_rmse_mm(uncertainty.covariance, target.points[::40], centroid)
    assert np.sqrt(np.mean(squares)) == pytest.approx(predicted, rel=0.1)


def test_the_misfit_at_short_range_shows_ripples_that_longer_averages_do_not():
    """A sheet of points, 1 mm apart, whose residuals are noise and a wave of 0.3 mm."""
    rng = np.random.default_rng(0)
    sheet = np.stack(np.meshgrid(np.arange(60.0), np.arange(60.0), [0.0]), axis=-1).reshape(-1, 3)
    misfits = {}
    for length_mm in (8.0, 60.0):
        wave = 0.3 * np.sqrt(2.0) * np.sin(2.0 * np.pi * sheet[:, 0] / length_mm)
        signed = wave + rng.normal(0.0, 0.5, len(sheet))
        ones, up, first = np.ones(len(sheet)), np.tile([0.0, 0.0, 1.0], (len(sheet), 1)), np.zeros(len(sheet), np.int64)
        of_sheet = refinement.Fit(np.eye(4), 0.5, signed, ones, up, first, sheet)
        misfits[length_mm] = covariance.smooth_misfits_mm(of_sheet, (30, 12))
    assert misfits[60.0] == pytest.approx((0.3, 0.3), abs=0.03)  # the noise is taken away
    assert misfits[8.0][0] < 0.7 * misfits[8.0][1] < 0.3
    few = replace(of_sheet, weights=np.r_[np.ones(20), np.zeros(len(sheet) - 20)])
    assert (
        covariance.smooth_misfits_mm(few, (30, 12))[0] == few.sigma_mm != covariance.smooth_misfits_mm(few, (30, 12))[1]
    )
    none = replace(of_sheet, weights=np.zeros(len(sheet)))
    assert covariance.smooth_misfits_mm(none, (30, 12)) == (0.5, 0.5)


def test_the_weakest_turn_of_a_shaft_is_about_its_axis():
    from gapr_core import Registrar

    rng = np.random.default_rng(0)
    angle, z = rng.uniform(0, 2 * np.pi, 8000), rng.uniform(-120, 120, 8000)
    shaft = np.stack([14 * np.cos(angle), 12 * np.sin(angle), z], axis=1)
    source = shaft[(angle < 3.0) & (np.abs(z) < 60)] + rng.normal(
        0, 0.3, ((((angle < 3.0) & (np.abs(z) < 60)).sum()), 3)
    )
    fit = refinement.refine_fully(np.eye(4), source, Registrar.from_pretrained().prepare(shaft), CONFIG)
    uncertainty = covariance.estimate(fit, CovarianceConfig())
    assert abs(uncertainty.weakest_shift[2]) > 0.99
    assert abs(uncertainty.weakest_turn[2]) > 0.99


def test_the_loops_and_numpy_weigh_residuals_alike(femur, target):
    """J^T W J of `evaluate` is the matrix that the compiled loop sums, with outliers and rough elements among them."""
    source = seen_from_above(femur, 800, 0.8, seed=5)
    source[:100] += [0.0, 6.0, 0.0]
    pose = se3.exp([0.4, -0.3, 0.2, 0.004, -0.003, 0.002], source.mean(axis=0))
    fit = refinement.evaluate(pose, source, target, CONFIG)
    signed, *_ = kernels.residuals_at(pose, source, *target.kernel_view, 0.0)
    limit_mm = refinement.tukey_limit(signed, fit.sigma_mm, CONFIG)
    H, g = np.empty((6, 6)), np.empty(6)
    ones, middle = np.ones(len(source)), source.mean(axis=0)
    kernels.accumulate(pose, source, ones, middle, *target.kernel_view, limit_mm, fit.sigma_mm**2, H, g)
    weighted = fit.jacobian * fit.weights[:, None]
    assert (fit.weights == 0.0).sum() > 50 and np.ptp(fit.weights) > 0.5
    np.testing.assert_allclose(weighted.T @ fit.jacobian, H, rtol=1e-6, atol=1e-6 * np.abs(H).max())
    np.testing.assert_allclose(-weighted.T @ np.nan_to_num(fit.signed_mm), g, rtol=1e-6, atol=1e-6 * np.abs(g).max())
