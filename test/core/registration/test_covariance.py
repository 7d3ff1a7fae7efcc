"""Every term of the pose covariance against errors drawn at random, and every rule for how large they are."""

import os
from dataclasses import replace

import numpy as np
import pytest

from gapr_core.config import CovarianceConfig, SensorConfig
from gapr_core.geometry import se3
from gapr_core.geometry.twists import covariance_about, error_twist, nees
from gapr_core.registration.fit import refinement
from gapr_core.registration.problem.sensor import Errors
from gapr_core.registration.uncertainty import covariance
from gapr_core.registration.uncertainty import linear_model as bias_field

CONFIG = CovarianceConfig(model_mm=0.0)


@pytest.fixture
def known(monkeypatch):
    """Changes constants of the covariance."""

    def change(**values):
        for name, value in values.items():
            monkeypatch.setattr(covariance, name.upper(), value)

    return change


NOTHING = Errors(offset_mm=0.0, standoff_mm=0.0, noise_mm=1e-6, bias_mm=0.0, scale=0.0)


def curved_fit(count=300, sigma_mm=0.5, bias_mm=0.0, seed=0):
    """A fit of a one-sided, unevenly curved surface: residuals 0, weights of a robust fit, some of them 0."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-40.0, 40.0, (2, count))
    z = -(x**2) / 90.0 - y**2 / 50.0 + x * y / 140.0 + 5.0 * np.sin(x / 12.0)
    slopes = np.stack([2 * x / 90.0 - y / 140.0 - 5.0 / 12.0 * np.cos(x / 12.0), 2 * y / 50.0 - x / 140.0], axis=1)
    normals = np.column_stack([slopes, np.ones(count)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    weights = np.where(rng.random(count) < 0.1, 0.0, rng.uniform(0.5, 1.0, count))
    points = np.stack([x, y, z], axis=1) + [100.0, -30.0, 5.0]
    return refinement.Fit(np.eye(4), sigma_mm, np.zeros(count), weights, normals, points, bias_mm)


def solved(fit, errors_mm, noise_mm, fields):
    """(K, 6) twists of dense (generalised) least squares under errors (K, N) of the residuals."""
    inlier = fit.weights > 0.0
    J, F = fit.jacobian[inlier], fields[inlier]
    V = np.diag(noise_mm**2 / fit.weights[inlier]) + fit.bias_mm**2 * F @ F.T
    VJ = np.linalg.solve(V, J)
    H = J.T @ VJ + bias_field.POSE_PRIOR / noise_mm**2
    return -np.linalg.solve(H, VJ.T @ errors_mm[:, inlier].T).T


def drawn(kind, fit, rng, count=4000):
    """(count, N) errors of one kind, of unit size."""
    points, inlier = fit.moved, fit.weights > 0.0
    if kind == "noise_mm":
        return rng.normal(size=(count, len(points)))
    if kind == "standoff_mm":
        return np.tile(rng.normal(size=(count, 1)), (1, len(points)))
    if kind == "scale":  # the source is larger by this factor about its centroid: points move along p - c
        away = points - points[inlier].mean(axis=0)
        return rng.normal(size=(count, 1)) * (away * fit.gradients).sum(axis=1)
    if kind == "beam standoff_mm":  # depths are off: all points move along the beam
        return rng.normal(size=(count, 1)) * (fit.gradients @ beam_of(fit))
    if kind == "beam scale":  # a point moves along the beam by its depth
        depth = (points - points[inlier].mean(axis=0)) @ beam_of(fit)
        return rng.normal(size=(count, 1)) * depth * (fit.gradients @ beam_of(fit))
    length_mm = covariance.LOCAL_CORRELATION_MM if kind == "local_mm" else bias_field.CORRELATION_MM
    correlation = bias_field.smooth_correlation(points, points, length_mm)
    return rng.multivariate_normal(np.zeros(len(points)), correlation, count, method="eigh")


def beam_of(fit):
    mean = fit.gradients[fit.weights > 0.0].mean(axis=0)
    return mean / np.linalg.norm(mean)


def arms(fit):
    """(6,) mm per mm and mm per rad, so that shifts and turns compare."""
    return np.array([1.0] * 3 + [40.0] * 3)


@pytest.mark.parametrize("corrected_mm", [0.0, 0.8])
@pytest.mark.parametrize(
    ("kind", "size"),
    [("noise_mm", 0.7), ("bias_mm", 0.3), ("standoff_mm", 0.3), ("scale", 0.03), ("local_mm", 0.3),
     ("beam standoff_mm", 0.3), ("beam scale", 0.03)],
)  # fmt: skip
def test_each_error_spreads_the_pose_as_its_term_says(known, kind, size, corrected_mm):
    """Sizes other than 1: entering as b instead of b^2, or not at all, fails. So does another sign of the gain."""
    known(long_share=0.0, linear_share=0.0)
    fit = curved_fit(bias_mm=corrected_mm)
    noise_mm = size if kind == "noise_mm" else 0.5
    fields = bias_field.fields(fit, centres=80)
    twists = solved(fit, size * drawn(kind, fit, np.random.default_rng(1)), noise_mm, fields) * arms(fit)
    along_beam, name = kind.startswith("beam"), kind.removeprefix("beam ")
    errors = replace(NOTHING, along_beam=along_beam, **{"noise_mm": noise_mm, name: size})
    predicted = covariance.sandwich(fit, fields, errors, CONFIG)
    if kind != "noise_mm":
        predicted = predicted - covariance.sandwich(fit, fields, replace(NOTHING, noise_mm=noise_mm), CONFIG)
    predicted = predicted * np.outer(arms(fit), arms(fit))
    sampled = twists.T @ twists / len(twists)
    assert np.abs(sampled - predicted).max() < 0.08 * np.abs(predicted).max()
    assert np.trace(sampled) == pytest.approx(np.trace(predicted), rel=0.08)


def test_noise_counts_by_the_weights_of_the_fit():
    """Of two points that say the same, one of weight 1 and one of weight 1/2, least squares takes 2 to 1."""
    fit = curved_fit()
    fields = bias_field.fields(fit, centres=80)
    gain, _ = covariance.gain_of(fit, fields, 0.5)
    inlier = fit.weights > 0.0
    even, _ = covariance.gain_of(replace(fit, weights=np.where(inlier, 1.0, 0.0)), fields, 0.5)
    assert gain.shape == (6, inlier.sum())
    H = fit.jacobian.T @ (fit.weights[:, None] * fit.jacobian) + bias_field.POSE_PRIOR
    np.testing.assert_allclose(gain, np.linalg.solve(H, (fit.weights[:, None] * fit.jacobian)[inlier].T), rtol=1e-6)
    assert np.abs(gain - even).max() > 1e-3 * np.abs(gain).max()


def test_a_motion_of_which_nothing_is_seen_has_the_variance_of_the_prior():
    flat = curved_fit()
    up = np.tile([0.0, 0.0, 1.0], (300, 1))
    flat = replace(flat, gradients=up, moved=flat.moved * [1.0, 1.0, 0.0])
    C = covariance.sandwich(flat, bias_field.fields(flat, 20.0, 80), replace(NOTHING, noise_mm=0.4), CONFIG)
    assert C[0, 0] == pytest.approx(0.16 / 1e-6, rel=0.01)  # noise variance over the prior's information
    assert C[5, 5] == pytest.approx(0.16 / 1e-3, rel=0.01)
    assert C[2, 2] < 0.01


def test_all_points_that_a_pose_rests_on_make_its_covariance():
    """50 of 300 points are fitted: the covariance is that of the 300, said about the centroid of the 50."""
    whole = replace(curved_fit(), signed_mm=np.random.default_rng(0).normal(0.0, 0.5, 300))
    some = np.arange(50)
    part = {name: getattr(whole, name)[some] for name in ("signed_mm", "weights", "gradients", "moved")}
    fit = replace(whole, **part)
    of_part, of_all = (covariance.estimate(each, CONFIG) for each in (fit, whole))
    found = covariance.estimate(replace(fit, whole=whole), CONFIG)
    apart = fit.moved.mean(axis=0) - whole.moved.mean(axis=0)
    np.testing.assert_allclose(found.covariance, covariance_about(apart, of_all.covariance), rtol=1e-3, atol=1e-6)
    assert np.linalg.norm(apart) > 1.0 and found.bias_mm == of_all.bias_mm != of_part.bias_mm
    assert (found.smooth_mm, found.short_mm) == (of_part.smooth_mm, of_part.short_mm)


def test_an_error_of_the_whole_clouds_place_is_one_of_the_pose():
    """Sizes other than 1, and not alike: mm for deg, or deg for rad, fails; so does a size for its square."""
    fit, fields = curved_fit(), np.zeros((300, 1))
    errors = replace(NOTHING, tracking_mm=0.3, tracking_deg=0.7)
    added = covariance.sandwich(fit, fields, errors, CONFIG) - covariance.sandwich(fit, fields, NOTHING, CONFIG)
    np.testing.assert_allclose(added, np.diag([0.09] * 3 + [np.radians(0.7) ** 2] * 3), atol=1e-9)


def test_depths_that_are_wrong_move_the_pose_along_the_beam_and_nowhere_else():
    """The noise of 1e-6 mm aside: variance of the stand-off along the mean normal, none across it, none of a turn."""
    fit, errors = curved_fit(), replace(NOTHING, standoff_mm=0.6, along_beam=True)
    C = covariance.sandwich(fit, np.zeros((300, 1)), errors, CONFIG)
    beam = beam_of(fit)
    np.testing.assert_allclose(C[:3, :3], 0.36 * np.outer(beam, beam), atol=1e-4)
    np.testing.assert_allclose(C[3:, 3:], 0.0, atol=1e-7)


@pytest.mark.parametrize("far_mm", [200.0, 400.0])
def test_ranges_that_are_wrong_move_the_whole_cloud_along_the_line_of_sight(far_mm):
    """By 1 % of the distance, on top of what an error of the size alone does, which hardly moves its middle."""
    fit, errors, fields = curved_fit(), replace(NOTHING, scale=0.01), np.zeros((300, 1))
    inlier, sight = fit.weights > 0.0, np.array([0.6, 0.0, 0.8])
    eye = fit.moved[inlier].mean(axis=0) - far_mm * sight
    of_size, of_ranges = (covariance.directions(fit, False, *where)[1] for where in ((), (eye,)))
    np.testing.assert_allclose(of_ranges - of_size, fit.gradients[inlier] @ (far_mm * sight), atol=1e-9)
    alone, found = (covariance.sandwich(fit, fields, errors, CONFIG, *where) for where in ((), (eye,)))
    assert np.sqrt(np.trace(alone[:3, :3])) < 0.4
    assert np.sqrt(sight @ found[:3, :3] @ sight) == pytest.approx(0.01 * far_mm, abs=0.4)
    assert np.sqrt(np.trace(found[:3, :3]) - sight @ found[:3, :3] @ sight) < 0.4


def test_only_a_stated_scale_is_one_of_the_ranges_from_where_a_camera_was():
    """Under T the camera moves with its cloud."""
    T, viewpoint = se3.exp([5.0, -3.0, 2.0, 0.1, 0.2, -0.3]), np.array([10.0, 20.0, -400.0])
    stated = SensorConfig("depth_camera", scale=0.01)
    np.testing.assert_allclose(covariance.eye_of(T, viewpoint, stated), se3.apply(T, viewpoint[None])[0])
    assert covariance.eye_of(T, viewpoint, SensorConfig("depth_camera")) is None
    assert covariance.eye_of(T, None, stated) is None


def test_a_view_from_several_sides_has_no_beam():
    fit = curved_fit()
    both_ways = replace(fit, gradients=fit.gradients * np.where(np.arange(300) % 2, 1.0, -0.9)[:, None])
    seen = [covariance.directions(both_ways, along_beam) for along_beam in (True, False)]
    for ours, usual in zip(*seen, strict=True):
        np.testing.assert_array_equal(ours, usual)
    beam, usual = (covariance.directions(fit, along_beam)[0] for along_beam in (True, False))
    assert np.abs(beam - usual).max() > 0.1
    assert covariance.directions(replace(fit, weights=np.zeros(300)), True)[0].shape == (0,)


def test_what_the_bias_has_in_common_is_a_standoff_of_its_own(known):
    known(linear_share=0.0)
    fit, fields = curved_fit(), np.zeros((300, 1))
    shared = covariance.sandwich(fit, fields, replace(NOTHING, bias_mm=0.8), CONFIG)
    standoff = covariance.sandwich(fit, fields, replace(NOTHING, standoff_mm=0.8 * covariance.LONG_SHARE), CONFIG)
    np.testing.assert_allclose(shared, standoff, rtol=1e-9, atol=1e-15)


def test_a_model_that_is_too_thick_is_a_standoff_along_the_normals_for_every_sensor():
    """A size other than 1: entering as m instead of m^2, or along the beam, fails."""
    fit, fields = curved_fit(), np.zeros((300, 1))
    standoff = covariance.sandwich(fit, fields, replace(NOTHING, standoff_mm=0.3), CONFIG)
    for along_beam in (False, True):
        errors = replace(NOTHING, along_beam=along_beam)
        thick = covariance.sandwich(fit, fields, errors, replace(CONFIG, model_mm=0.3))
        np.testing.assert_allclose(thick, standoff, rtol=1e-9, atol=1e-15)


def test_what_the_bias_has_in_common_also_strains_the_source(known):
    """Errors of 0.8 mm x 0.7: symmetric matrices whose entries vary by 1 on the diagonal, by sqrt(1/2) beside it."""
    fit, fields, rng = curved_fit(), np.zeros((300, 1)), np.random.default_rng(2)
    inlier = fit.weights > 0.0
    away = fit.moved - fit.moved[inlier].mean(axis=0)
    size_mm = np.sqrt((away[inlier] ** 2).sum(axis=1).mean())
    entries = rng.normal(size=(4000, 3, 3))
    matrices = (entries + entries.transpose(0, 2, 1)) / 2.0  # off the diagonal the variance halves
    errors_mm = 0.56 * np.einsum("ni,kij,nj->kn", fit.gradients, matrices, away / size_mm)
    twists = solved(fit, errors_mm, 1e-6, fields) * arms(fit)
    known(long_share=0.0, linear_share=0.7)
    predicted = covariance.sandwich(fit, fields, replace(NOTHING, bias_mm=0.8), CONFIG)
    predicted = predicted * np.outer(arms(fit), arms(fit))
    sampled = twists.T @ twists / len(twists)
    assert np.abs(sampled - predicted).max() < 0.08 * np.abs(predicted).max()
    assert np.trace(sampled) == pytest.approx(np.trace(predicted), rel=0.08)
    nothing_seen = replace(fit, weights=np.zeros(300))
    assert covariance.strains(nothing_seen).shape == (0, 6)


def test_a_strain_of_known_size_adds_what_it_moves_the_pose_by(known):
    """As strains in proportion to the bias do, about the middle of the points that were compared."""
    fit = curved_fit()
    errors = replace(NOTHING, bias_mm=0.8)
    fields = bias_field.fields(fit)
    spread = []
    for share in (0.7, 0.0):
        known(long_share=0.0, linear_share=share)
        spread.append(covariance.sandwich(fit, fields, errors, CONFIG))
    strained, rigid = spread
    found = covariance.covariance_added_by(fit, 0.56 * covariance.strains(fit))
    np.testing.assert_allclose(found, strained - rigid, rtol=1e-6, atol=1e-9)
    some = np.arange(300) < 200
    of_some = (each[some] for each in (fit.signed_mm, fit.weights, fit.gradients, fit.moved))
    drawn = refinement.Fit(fit.T, fit.sigma_mm, *of_some, whole=fit)
    about = drawn.moved.mean(axis=0) - fit.moved.mean(axis=0)
    same = covariance.covariance_added_by(drawn, 0.56 * covariance.strains(fit))
    np.testing.assert_allclose(same, covariance_about(about, found))


def test_the_noise_of_few_points_is_larger_than_their_residuals_say():
    """Six unknowns take up six points' residuals, and the sensor's own noise speaks as four points."""
    assert covariance.expected_noise_mm(0.3, 12, 0.5, 4.0) == pytest.approx(np.sqrt((4 * 0.25 + 12 * 0.09) / 10))
    assert covariance.expected_noise_mm(0.3, 4000, 0.5, 4.0) == pytest.approx(0.3, rel=0.01)
    assert covariance.expected_noise_mm(0.3, 7, 0.5, 0.0) == pytest.approx(np.sqrt(7 * 0.09))
    assert np.isfinite(covariance.expected_noise_mm(0.3, 0, 0.5, 4.0))


@pytest.mark.parametrize("size_mm", [0.0, 0.3, 0.9])
def test_the_bias_is_as_large_as_the_residuals_say(size_mm):
    """`BIAS_GAIN` is for what robust weights hide; without it the size is that which was drawn."""
    sizes = []
    for seed in range(6):
        fit = curved_fit(2500, sigma_mm=0.4, seed=seed)
        rng = np.random.default_rng(100 + seed)
        fields = bias_field.fields(fit)
        signed = size_mm * fields @ rng.normal(size=fields.shape[1]) + rng.normal(size=2500) * 0.4
        fit = replace(fit, signed_mm=signed)
        equations = bias_field.NormalEquations.of(fit, fields)
        sizes.append(covariance.expected_bias_mm(equations, 0.1))
    assert np.mean(sizes) == pytest.approx(size_mm, rel=0.25, abs=0.04)


@pytest.mark.parametrize("typical_mm", [0.3, 0.0])
def test_without_points_the_bias_is_the_mean_square_of_a_log_normal_size(known, typical_mm):
    """sqrt(E[s^2]) is m exp(v^2) for a median m and a standard deviation v of the logarithm."""
    steps = np.random.default_rng(4).uniform(0.002, 0.03, 500)  # the sizes are not evenly spaced
    sizes_mm = 0.01 * np.exp(np.cumsum(steps))
    fit = replace(curved_fit(20), weights=np.zeros(20))
    equations = bias_field.NormalEquations.of(fit, bias_field.fields(fit, 20.0, 80))
    known(bias_spread=0.4, no_bias_mm=0.0, sizes_mm=sizes_mm)
    found = covariance.expected_bias_mm(equations, typical_mm)
    if typical_mm:
        assert found == pytest.approx(0.3 * np.exp(0.4**2), rel=2e-3)
    else:  # the smallest size is the median
        assert found == covariance.expected_bias_mm(equations, sizes_mm[0])
        assert found < covariance.expected_bias_mm(equations, sizes_mm[1])


def test_what_residuals_without_a_bias_show_is_taken_off(known):
    fit = replace(curved_fit(20), weights=np.zeros(20))
    equations = bias_field.NormalEquations.of(fit, bias_field.fields(fit, 20.0, 80))
    found = []
    for size_mm in (0.0, 0.6, 3.0):
        known(bias_spread=0.1, no_bias_mm=size_mm)
        found.append(covariance.expected_bias_mm(equations, 1.0))
    whole, less, none = found
    assert less**2 == pytest.approx(whole**2 - 0.36) and none == 0.0


def test_a_pose_is_never_surer_than_a_micrometre(known):
    sensor = SensorConfig("laser", 0.0, noise_mm=1e-3, scale=0.0, known_standoff_mm=1e-3)
    known(bias_gain=0.0, noise_points=0.0)
    C = covariance.estimate(curved_fit(300, sigma_mm=1e-5), CONFIG, sensor).covariance
    assert (np.diag(C)[:3] >= 1e-6).all() and (np.diag(C)[3:] >= 1e-10).all()
    assert (np.diag(C)[:3] < 1e-5).all() and (np.diag(C)[3:] < 1e-8).all()
    assert np.linalg.eigvalsh(C).min() > 0.0


def test_the_least_certain_directions_are_the_largest_axes_of_each_block():
    shift, turn = (np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0] for seed in (0, 1))
    C = np.zeros((6, 6))
    C[:3, :3] = shift @ np.diag([0.04, 0.09, 0.01]) @ shift.T
    C[3:, 3:] = turn @ np.diag(np.radians([0.5, 0.2, 2.0]) ** 2) @ turn.T
    known = covariance.PoseUncertainty(C, 0.1, 0.1, 0.1)
    assert known.largest_shift_mm == pytest.approx(0.3) and known.largest_turn_deg == pytest.approx(2.0)
    assert np.abs(covariance._largest_axis(C[:3, :3])) == pytest.approx(np.abs(shift[:, 1]))


def test_the_uncertainty_names_the_weakest_turn_and_shift_and_the_misfits():
    fit = curved_fit(300)
    fit = replace(fit, signed_mm=np.random.default_rng(0).normal(0.1, 0.5, 300))
    found = covariance.estimate(fit, CONFIG)
    C, misfits = found.covariance, covariance.smooth_misfits_mm(fit, (30, 12))
    assert (found.smooth_mm, found.short_mm) == misfits and misfits[0] != misfits[1]
    for axis, block in ((found.weakest_shift, C[:3, :3]), (found.weakest_turn, C[3:, 3:])):
        assert axis @ block @ axis == pytest.approx(np.linalg.eigvalsh(block).max())


def test_the_smooth_misfit_is_the_mean_square_of_local_averages_less_that_of_noise():
    fit = curved_fit(60)
    signed = 0.2 + 0.02 * fit.moved[:, 1] + np.random.default_rng(1).normal(0.0, 0.3, 60)
    inlier = fit.weights > 0.0
    fit = replace(fit, signed_mm=np.where(inlier, signed, np.nan))  # what lies far off has no residual
    points, signed = fit.moved[inlier], signed[inlier]
    nearest = np.argsort(np.linalg.norm(points[:, None] - points, axis=2), axis=1)
    expected = [
        np.sqrt(np.mean([signed[i[:count]].mean() ** 2 for i in nearest]) - signed.var() / count) for count in (12, 5)
    ]
    assert covariance.smooth_misfits_mm(fit, (12, 5)) == pytest.approx(expected)
    for count in (5, 14, 20):  # too few inliers among those known, for some or for all points
        around = np.argsort(np.linalg.norm(fit.moved[:, None] - fit.moved, axis=2), axis=1)[:, :count]
        assert covariance.smooth_misfits_mm(fit, (12, 5), around) == pytest.approx(expected)


def test_fewer_points_than_an_average_needs_show_their_own_spread():
    fit = curved_fit(40, sigma_mm=0.7)
    fit = replace(fit, signed_mm=np.full(40, 0.4), weights=np.ones(40))
    assert covariance.smooth_misfits_mm(fit, (30, 12)) == pytest.approx((0.4, 0.4))
    for count, expected in ((13, (0.7, 0.4)), (12, (0.7, 0.7)), (5, (0.7, 0.7)), (0, (0.7, 0.7)), (30, (0.7, 0.4))):
        few = replace(fit, weights=(np.arange(40) < count).astype(float))
        assert covariance.smooth_misfits_mm(few, (30, 12)) == pytest.approx(expected)
    alternating = replace(fit, signed_mm=np.tile([1.0, -1.0], 20))  # averages that are smaller than noise leaves
    assert covariance.smooth_misfits_mm(alternating, (40, 39))[0] == 0.7
    assert covariance.smooth_misfits_mm(alternating, (39,))[0] < 0.2


def test_what_is_known_of_the_sensor_reaches_the_covariance():
    fit = curved_fit(100)
    fit = replace(fit, signed_mm=np.random.default_rng(0).normal(0.0, 0.5, 100))

    def spread(**sensor):
        return np.trace(covariance.estimate(fit, CONFIG, SensorConfig(**sensor)).covariance[:3, :3])

    unknown, known = spread(kind="pointer"), spread(kind="pointer", standoff_mm=0.5)
    assert known < 0.75 * unknown
    assert spread(kind="pointer", standoff_mm=0.5, bias_mm=2.0) > 1.5 * known
    assert spread(kind="pointer", standoff_mm=0.5, scale=0.1) > 1.5 * known
    assert spread(kind="pointer", standoff_mm=0.5, noise_mm=5.0) > 1.2 * known
    assert spread(kind="laser") < 0.5 * spread(kind="ultrasound")
    assert spread() == spread(kind="unknown")


@pytest.mark.skipif(
    "NUMBA_DISABLE_JIT" in os.environ, reason="24 fits of 1000 points take minutes without the compiler"
)
def test_noise_alone_gives_the_spread_that_the_covariance_says(femur, target, known):
    """Over draws of noise without bias, refined from the truth: the mean of NEES / 6 is about 1."""
    known(bias_gain=0.0)
    ratios = []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        points, normals = femur.sample(6000, rng)
        source = points[normals @ [0.0, 1.0, 0.0] > 0.2][:1000]
        source = source + rng.normal(0.0, 0.8, source.shape)
        fit = refinement.refine_fully(np.eye(4), source, target, refinement.RefinementConfig())
        C = covariance.estimate(fit, CONFIG, SensorConfig("laser", 0.0, scale=0.0)).covariance
        ratios.append(nees(error_twist(fit.T, np.eye(4), source), C) / 6.0)
    assert 0.4 < np.mean(ratios) < 1.6


def test_a_share_of_the_bias_moves_all_points_together(known):
    fit = curved_fit(400)
    fields = bias_field.fields(fit)
    noise = np.random.default_rng(0).normal(0.0, 0.5, 400)
    fit = replace(fit, signed_mm=0.6 * fields @ np.random.default_rng(1).normal(size=fields.shape[1]) + noise)
    found = []
    for share in (0.0, 2.0):
        known(long_share=share)
        found.append(covariance.estimate(fit, CONFIG))
    without, with_it = found
    effect = bias_field.equations_of(fit).design_effect
    sigma_mm = np.sqrt(effect) * 0.5
    noise_mm = covariance.expected_noise_mm(sigma_mm, np.count_nonzero(fit.weights), 0.5, covariance.NOISE_POINTS)
    together = covariance.gain_of(fit, fields, noise_mm)[0].sum(axis=1)
    expected = (2.0 * without.bias_mm) ** 2 * np.outer(together, together)
    np.testing.assert_allclose(with_it.covariance - without.covariance, expected, rtol=1e-4, atol=1e-9)


def test_points_that_err_alike_make_the_noise_of_the_pose_larger(known):
    """The variance of a pose under the noise alone grows by the design effect."""
    known(bias_gain=0.0, noise_points=0.0)
    sensor = SensorConfig(standoff_mm=0.0, known_standoff_mm=1e-3, scale=0.0)
    fit = curved_fit(2000, sigma_mm=0.5)
    rng = np.random.default_rng(3)
    effects, sizes = [], []
    for clump in (1, 10):
        near = np.lexsort(fit.moved.T.round(-1))  # along one side after another: neighbours in a row
        signed = np.empty(2000)
        signed[near] = np.repeat(rng.normal(0.0, 0.5, 2000 // clump), clump)
        alike = replace(fit, signed_mm=signed, moved=fit.moved + signed[:, None] * fit.gradients)
        effects.append(bias_field.equations_of(alike).design_effect)
        sizes.append(np.trace(covariance.estimate(alike, CONFIG, sensor).covariance[:3, :3]))
    assert effects[1] > 2.0 * effects[0]
    assert sizes[1] / sizes[0] == pytest.approx(effects[1] / effects[0], rel=0.05)


def test_what_was_not_observed_is_uncertain_and_not_exact():
    """Of a plane: the slides and the spin are not known at all, and across it only its stand-off is not."""
    points = np.column_stack([np.random.default_rng(1).uniform(-30.0, 30.0, (500, 2)), np.zeros(500)])
    up, signed = np.tile([0.0, 0.0, 1.0], (500, 1)), np.random.default_rng(2).normal(0.0, 0.2, 500)
    fit = refinement.Fit(np.eye(4), 0.2, signed, np.ones(500), up, points)
    for weights in (np.ones(500), np.zeros(500)):
        found = covariance.estimate(replace(fit, weights=weights), CovarianceConfig())
        assert found.largest_shift_mm > 100.0 and found.largest_turn_deg > 100.0
        np.linalg.cholesky(found.covariance)
        assert bool(np.sqrt(found.covariance[2, 2]) < 0.6) is bool(weights.any())
