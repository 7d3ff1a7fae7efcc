"""The evidence of a motion or a strain: against dense restricted likelihoods, and what it is found for."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from gapr_core.data.parametric import make_bone
from gapr_core.geometry import se3
from gapr_core.registration.checks import deformation as deformations
from gapr_core.registration.checks.deformation import (
    LIMITS,
    STEPS,
    TEXTS,
    deformation,
    of_deformations,
    of_motion,
    with_looks,
)
from gapr_core.registration.checks.unknowns import (
    BIASES_MM,
    CELLS,
    NOTHING,
    SHARED_MM,
    SIZES_MM,
    Blocks,
    Shown,
    blocks,
    motions,
    shown,
)
from gapr_core.registration.fit.refinement import Fit
from gapr_core.registration.streams.accumulator import MOVES
from gapr_core.registration.uncertainty.covariance import PoseUncertainty, covariance_added_by
from gapr_core.registration.uncertainty.linear_model import CORRELATION_MM
from gapr_core.results import Effect

NOISE_MM = 0.4
STRAINED, APART, LAYERED = LIMITS["strained"], LIMITS["apart"], LIMITS["layered"]


def of_strain(fit):
    found = of_deformations(fit)
    return found["strained"][0] if found else NOTHING


def fit_of(points, normals, errors, weights=None):
    """A fit whose foot points are `points`; `errors` (N, 3), mm, show in the residuals along the normals."""
    signed = np.einsum("ni,ni->n", normals, errors)
    weights = np.ones(len(points)) if weights is None else weights
    moved = points + signed[:, None] * normals
    return Fit(np.eye(4), NOISE_MM, signed, weights, normals, moved)


@pytest.fixture(scope="module")
def seen():
    """Points of one end of a femur, and their normals: an ellipsoid would be strained into another one, or turned."""
    bone = make_bone("femur", 3)
    high = np.quantile(bone.points[:, 2], 0.6)

    def of(count):
        points, normals = bone.sample(6 * count, np.random.default_rng(0))
        end = np.flatnonzero(points[:, 2] > high)[:count]
        return points[end] - points[end].mean(axis=0), normals[end]

    return of


def noise(count, seed=1):
    return np.random.default_rng(seed).normal(0.0, NOISE_MM, (count, 3))


@pytest.fixture(scope="module")
def some():
    """Blocks of random numbers."""
    rng = np.random.default_rng(4)
    n = 16
    return Blocks(rng.normal(size=n), rng.normal(size=(n, 6)), rng.normal(size=(n, 2, 3)), rng.uniform(0.1, 0.5, n),
                  rng.uniform(0.0, 40.0, (n, 3)))  # fmt: skip


def restricted(found, more, bias_mm, shared_mm, size_mm):
    """log likelihood of all contrasts that no `free` changes: what restricted likelihood is by definition."""
    apart = np.linalg.norm(found.feet[:, None] - found.feet, axis=2)
    V = np.diag(found.variances) + shared_mm**2 * np.eye(len(apart)) + size_mm**2 * more @ more.T
    V += bias_mm**2 * np.exp(-0.5 * (apart / CORRELATION_MM) ** 2)
    contrasts = np.linalg.svd(found.free)[0][:, found.free.shape[1] :]
    return multivariate_normal(None, contrasts.T @ V @ contrasts).logpdf(contrasts.T @ found.residuals)


def test_the_evidence_is_a_ratio_of_restricted_likelihoods_and_the_size_their_mean(some):
    for i, found in enumerate(shown(some)):
        dense = np.array([[[restricted(some, some.more[:, i], b, c, h) for h in SIZES_MM] for c in SHARED_MM]
                          for b in BIASES_MM])  # fmt: skip
        best = dense.max(axis=(0, 1))
        assert found.log_ratio == pytest.approx(best.max() - best[0], abs=1e-9)
        posterior = np.exp(dense - dense.max()).sum(axis=(0, 1))
        assert found.size_mm == pytest.approx(np.sqrt(posterior @ SIZES_MM**2 / posterior.sum()), rel=1e-9)
        assert found.log_ratio >= 0.0


def test_blocks_are_weighted_means_of_neighbours_of_one_group(seen):
    points, normals = seen(400)
    weights = np.random.default_rng(3).uniform(0.0, 1.0, 400)
    weights[:40] = 0.0
    fit, inlier = fit_of(points, normals, noise(400), weights), weights > 0.0
    more, group = np.random.default_rng(5).normal(size=(2, 360, 3)), np.arange(360) % 2
    found = blocks(fit, fit.jacobian[inlier], list(more), group)
    count = len(found.residuals)
    assert CELLS < count <= 2 * CELLS
    total = fit.sigma_mm**2 / found.variances
    assert total.sum() == pytest.approx(weights.sum())
    for of_all, of_blocks in (
        (fit.signed_mm[inlier, None], found.residuals[:, None]),
        (fit.jacobian[inlier], found.free),
        (more[0], found.more[:, 0]),
        (more[1], found.more[:, 1]),
        (fit.feet[inlier], found.feet),
    ):
        assert total @ of_blocks == pytest.approx(weights[inlier] @ of_all)
    alone = blocks(fit, fit.jacobian[inlier], [group[:, None] * np.ones((360, 1))], group)
    assert set(alone.more.ravel()) == {0.0, 1.0}, "no block holds points of two groups"


@pytest.mark.parametrize("motion", [[0, 0, 3.0, 0, 0, 0], [2.0, -1.0, 0, 0, 0, 0], [0, 0, 0, 0.0, 0.05, 0.0]])
def test_a_bone_that_moves_while_it_is_measured_is_found_and_one_at_rest_is_not(seen, motion):
    points, normals = seen(2400)
    order = np.random.default_rng(6).permutation(np.repeat(np.arange(12), 200))
    time = order / 11.0 - 0.5
    moved = np.stack(
        [se3.apply(se3.exp(np.array(motion) * t, np.zeros(3)), p[None])[0] for t, p in zip(time, points, strict=True)]
    )
    creeping, resting = (fit_of(points, normals, noise(2400) + off) for off in (moved - points, 0.0))
    found, nothing = (of_motion(fit, order)[0] for fit in (creeping, resting))
    assert found.log_ratio > MOVES > nothing.log_ratio
    assert found.size_mm > 3.0 * nothing.size_mm and 0.5 < found.size_mm < 5.0


def test_what_does_not_go_with_time_is_no_creep(seen):
    """The same errors, but of sources in any order: the bone is deformed, and rests."""
    points, normals = seen(2400)
    order = np.random.default_rng(6).permutation(np.repeat(np.arange(12), 200))
    off = np.random.default_rng(7).choice([-1.5, 1.5], 2400)[:, None] * [0.0, 0.0, 1.0]
    assert of_motion(fit_of(points, normals, noise(2400) + off), order)[0].log_ratio < 4.0
    off = 3.0 * np.sign(order - 5.5)[:, None] * [0.0, 0.0, 1.0]
    assert of_motion(fit_of(points, normals, noise(2400) + off), order)[0].log_ratio > 40.0


@pytest.mark.parametrize("strain", [np.diag([0, 0, 0.03]), np.diag([0.05, 0, 0]),
                                    [[0, 0, 0.04], [0, 0, 0], [0.04, 0, 0]]])  # fmt: skip
def test_a_strained_source_is_found_by_its_size_and_a_rigid_one_is_not(seen, strain):
    points, normals = seen(3000)
    fit, rigid = (fit_of(points, normals, noise(3000) + off) for off in (points @ np.array(strain), 0.0))
    found, nothing = of_strain(fit), of_strain(rigid)
    assert found.log_ratio > STRAINED > nothing.log_ratio
    size_mm = np.linalg.norm(strain) * np.sqrt((points**2).sum(axis=1).mean())
    assert found.size_mm == pytest.approx(size_mm / np.sqrt(6.0), rel=0.8)  # one of six components has all of it
    assert nothing.size_mm < 0.5 * found.size_mm


def test_smooth_bumps_are_no_strain(seen):
    points, normals = seen(3000)
    bumps = 0.7 * np.sin(points @ [0.13, 0.05, 0.1])[:, None] * normals
    assert of_strain(fit_of(points, normals, noise(3000) + bumps)).log_ratio < STRAINED


def test_a_stand_off_is_no_strain(seen):
    points, normals = seen(3000)
    assert of_strain(fit_of(points, normals, noise(3000) + 1.5 * normals)).log_ratio < 1.0


def test_another_size_is_a_strain(seen):
    """Of a sensor whose scale is uncertain, too: the scale may be another subject."""
    points, normals = seen(3000)
    assert of_strain(fit_of(points, normals, noise(3000) + 0.03 * points)).log_ratio > STRAINED


def test_few_points_or_one_source_say_nothing(seen):
    points, normals = seen(199)
    fit = fit_of(points, normals, noise(199) + 0.2 * points)
    assert of_strain(fit) == NOTHING == of_motion(fit, np.arange(199))[0]
    points, normals = seen(200)
    fit = fit_of(points, normals, noise(200) + 0.2 * points * [0, 0, 1])
    assert of_strain(fit).log_ratio > 3.0
    assert of_motion(fit, np.zeros(200, dtype=np.int64)) == (NOTHING, None)


def test_halves_move_against_each_other_along_each_principal_axis(seen):
    points, normals = seen(1000)
    weights = np.random.default_rng(3).uniform(0.0, 1.0, 1000)
    points[:100], weights[:100] = points[:100] + 200.0, 0.0  # what does not count has no part in their middle
    fit = fit_of(points, normals, noise(1000), weights)
    moved, feet = fit.moved[100:], fit.feet[100:]
    away = moved - moved.mean(axis=0)
    radius_mm = np.sqrt((away**2).sum(axis=1).mean())
    axes = np.linalg.svd(feet - feet.mean(axis=0), full_matrices=False)[2]
    for axis, found in zip(axes, deformations.halves(fit), strict=True):
        side = np.sign(feet @ axis - np.median(feet @ axis)) / 2.0
        for i, unit in enumerate(np.eye(3)):
            shift, turn = side * normals[100:, i], side * (normals[100:] * np.cross(unit, away)).sum(axis=1) / radius_mm
            expected = np.stack([shift, turn])
            assert np.allclose(found[:, [i, i + 3]].T, expected) or np.allclose(found[:, [i, i + 3]].T, -expected)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("motion", [[0, 0, 3.0, 0, 0, 0], [2.0, -1.0, 1.0, 0, 0, 0], [0, 0, 0, 0.06, 0.05, 0.0]])
def test_two_halves_in_two_poses_are_found_and_one_piece_is_not(seen, motion, axis):
    points, normals = seen(3000)
    along = points @ np.linalg.svd(points, full_matrices=False)[2][axis]
    above = along > np.median(along)
    moved = np.where(above[:, None], se3.apply(se3.exp(np.array(motion), points.mean(axis=0)), points), points)
    fit, rigid = (fit_of(points, normals, noise(3000) + off) for off in (moved - points, 0.0))
    (apart, changes), (whole, _) = (of_deformations(each)["apart"] for each in (fit, rigid))
    np.testing.assert_array_equal(changes, deformations.halves(fit)[axis])
    assert apart.log_ratio > APART > whole.log_ratio + 3.0
    assert 0.3 < apart.size_mm < 4.0


def deformed(seen, *names, whole=False):
    """A fit of a source with these deformations; `whole`: of 1800 of its points, which rests on all."""
    points, normals = seen(3000)
    along = points @ np.linalg.svd(points, full_matrices=False)[2][0]
    off = {
        "apart": 3.0 * (along > np.median(along))[:, None] * [0.0, 1.0, 0.0],
        "layered": 0.1 * along[:, None] * normals,
        "strained": 0.04 * points * [0, 0, 1],
    }
    fit = fit_of(points, normals, noise(3000) + sum(off[name] for name in names))
    some = np.argsort(along)[:1800]
    part = (each[some] for each in (fit.signed_mm, fit.weights, fit.gradients, fit.moved))
    return Fit(fit.T, fit.sigma_mm, *part, whole=fit) if whole else fit


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize(("names", "found"), [
    ([], set()), (["apart"], {"apart"}), (["layered"], {"layered"}), (["strained"], {"strained"}),
    (["strained", "strained"], {"strained", "apart"}),
])  # fmt: skip
def test_what_is_believed_widens_the_covariance_by_what_it_may_move_the_pose_by(seen, names, found, whole):
    """Several may be found, and add up; the surest is named. What is below its limit is not believed."""
    fit = deformed(seen, *names, whole=whole)
    measured, limits = of_deformations(fit.full_fit), {"strained": 3.0, "apart": 6.0, "layered": 4.0}
    believed = {name: each for name, each in measured.items() if each[0].log_ratio > limits[name]}
    assert set(believed) == found
    if not names:
        assert deformation(fit) is None
        return
    finding, added = deformation(fit)
    expected = sum(covariance_added_by(fit, each.size_mm * changes) for each, changes in believed.values())
    if "apart" in believed:
        expected = expected + deformations.covariance_of_half(fit, believed["apart"][0].size_mm)
    np.testing.assert_allclose(added, expected, atol=1e-12)
    surest = max(believed, key=lambda name: believed[name][0].log_ratio)
    assert (finding.check, finding.text, finding.effect) == (surest, TEXTS[surest], Effect.WIDEN)
    assert (finding.statistic, finding.threshold) == (believed[surest][0].log_ratio, limits[surest])


def test_either_half_lies_half_of_their_motion_from_the_pose_between_them(seen):
    """About the middle of the points that are compared, though all that count are in two halves."""
    fit = deformed(seen, "apart", whole=True)
    middles = [each.moved.mean(axis=0) for each in (fit, fit.whole)]
    radius_mm = np.sqrt(((fit.whole.moved - middles[1]) ** 2).sum(axis=1).mean())
    rng = np.random.default_rng(0)
    twists = 0.5 * 1.7 * rng.normal(size=(200_000, 6)) / ([1.0] * 3 + [radius_mm] * 3)
    about = np.hstack([twists[:, :3] + np.cross(twists[:, 3:], middles[0] - middles[1]), twists[:, 3:]])
    found = deformations.covariance_of_half(fit, 1.7)
    scale = np.sqrt(np.outer(np.diag(found), np.diag(found)))
    np.testing.assert_allclose(np.cov(about.T) / scale, found / scale, atol=0.015)


def test_what_depends_on_what_is_not_in_question_or_is_scaled_changes_nothing(some):
    more = replace(some, free=np.column_stack([some.free, some.free[:, 0] + some.free[:, 1], np.zeros(16)]))
    scaled = replace(some, free=some.free * [1.0, 1.0, 1.0, 1e-6, 1e-6, 1e-6])
    for found in (more, scaled):
        np.testing.assert_allclose(shown(found), shown(some))


def test_points_without_weight_say_nothing_of_a_creep(seen):
    points, normals = seen(2400)
    order, weights = np.arange(2400) // 200, np.where(np.arange(2400) % 2, 1.0, 0.0)
    off = np.where(weights[:, None] > 0.0, 0.0, 3.0 * (order / 11.0)[:, None] * [0.0, 0.0, 1.0])
    assert of_motion(fit_of(points, normals, noise(2400) + off, weights), order)[0].log_ratio < 1.0


def test_a_layer_that_grows_is_found_by_its_size_and_one_that_does_not_is_none(seen):
    points, normals = seen(3000)
    axis = np.linalg.svd(points, full_matrices=False)[2][0]
    along = points @ axis
    thick = 4.0 * (along - along.min())[:, None] / np.ptp(along) * normals
    growing, even = (
        of_deformations(fit_of(points, normals, noise(3000) + off))["layered"][0] for off in (thick, 2.0 * normals)
    )
    assert growing.log_ratio > LAYERED > 2.0 > even.log_ratio
    slope = 4.0 / np.ptp(along) * np.sqrt((points**2).sum(axis=1).mean())
    assert slope / np.sqrt(3.0) < growing.size_mm < 1.5 * slope  # one of three has all of it


def test_what_a_layer_has_everywhere_is_in_its_covariance_though_no_residual_shows_it(seen):
    points, normals = seen(500)
    weights = np.ones(500)
    weights[:50] = 0.0
    fit = fit_of(points, normals, noise(500), weights)
    feet = fit.feet[50:] - fit.feet[50:].mean(axis=0)
    expected = feet / np.sqrt((feet**2).sum(axis=1).mean())
    np.testing.assert_allclose(deformations.a_layer(fit), np.column_stack([expected, np.full(450, 3.0**0.5)]))
    thickness = np.linspace(0.0, 1.0, 100_001)
    assert thickness.mean() / thickness.std() == pytest.approx(3.0**0.5, rel=1e-3)


def test_alternatives_may_have_fewer_unknowns_than_others(seen):
    points, normals = seen(400)
    fit = fit_of(points, normals, noise(400))
    more, none = np.random.default_rng(5).normal(size=(400, 5)), np.zeros(400, dtype=np.int64)
    both = shown(blocks(fit, fit.jacobian, [more, more[:, :2]], none))
    alone = shown(blocks(fit, fit.jacobian, [more[:, :2]], none))
    assert both[1] == pytest.approx(alone[0])


@pytest.mark.parametrize("lifts", [[0.0, 0.0, 1.0], [0.0, 0.03, 1.0]])
def test_a_plane_of_which_some_motions_change_nothing_is_judged_by_the_others(lifts):
    points = np.random.default_rng(0).uniform(-20.0, 20.0, (400, 3)) * [1, 1, 0]
    fit = fit_of(points, np.tile([0.0, 0.0, 1.0], (400, 1)), noise(400) + (points @ lifts)[:, None] * [0, 0, 1])
    found = of_strain(fit)
    assert found.log_ratio == pytest.approx(0.0, abs=1e-6) and np.isfinite(found.size_mm)
    order = np.arange(400) // 40
    falling = replace(fit, signed_mm=fit.signed_mm + 0.4 * order)
    moves, rests = (of_motion(each, order)[0] for each in (falling, fit))
    assert moves.log_ratio > MOVES > rests.log_ratio


def test_points_without_weight_say_nothing(seen):
    points, normals = seen(3000)
    off, weights, strained = noise(3000), np.ones(3000), np.arange(3000) % 2 == 0
    off[strained] += 0.08 * points[strained] * [0, 0, 1]
    weights[strained] = 0.0
    assert of_strain(fit_of(points, normals, off)).log_ratio > 3.0
    assert of_strain(fit_of(points, normals, off, weights)).log_ratio < 1.0


def drawn_along(seen):
    """Points of a sweep along the bone and back in 12 sources, their normals, and when each was measured."""
    points, normals = seen(2400)
    along = np.argsort(np.argsort(points @ np.linalg.svd(points, full_matrices=False)[2][0]))
    order = np.where(np.random.default_rng(8).random(2400) < 0.5, along // 400, 11 - along // 400)
    return points, normals, order


def test_of_a_steady_motion_its_rotation_counts_by_the_radius_of_the_points(seen):
    """So that all six unknowns are mm."""
    points, normals, order = drawn_along(seen)
    radius_mm = np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean())
    time = (order / 11.0 - 0.5)[:, None]
    fit = fit_of(points, normals, noise(2400) + 4.0 * time * [0.0, 0.0, 1.0])
    changes = time * fit.jacobian / ([1.0] * 3 + [radius_mm] * 3)
    group = np.searchsorted([2 / 12, 4 / 12, 6 / 12, 8 / 12, 10 / 12, 11 / 12], order / 11.0, side="right")
    (same,) = shown(blocks(fit, fit.jacobian, [changes], group))
    found, rests_from = of_motion(fit, order)
    assert rests_from is None and same.log_ratio > MOVES
    assert found == pytest.approx(same, rel=1e-2, abs=1e-3)


@pytest.mark.parametrize(("first", "rests_from"), [(2, 3), (4, 5), (6, 7), (8, 9), (10, 10), (11, 11)])
def test_a_step_is_found_and_what_was_measured_since_is_named(seen, first, rests_from):
    """From the middle of the group on, since the step may lie anywhere in it."""
    points, normals, order = drawn_along(seen)
    off = np.where(order < first, 0.0, 4.0)[:, None] * [0.0, 0.0, 1.0]
    stepped, at_rest = (fit_of(points, normals, noise(2400) + each) for each in (off, 0.0 * off))
    (found, since), (resting, _) = (of_motion(fit, order) for fit in (stepped, at_rest))
    assert found.log_ratio > MOVES > resting.log_ratio
    assert since == rests_from
    later = of_motion(fit_of(points, normals, noise(2400) + off), order + 7)
    assert later[1] == rests_from + 7


def test_a_step_is_as_large_as_what_moved_and_may_have_been_between_any_two_groups(seen):
    points, normals, order = drawn_along(seen)
    fit = fit_of(points, normals, noise(2400) + np.where(order < 4, 0.0, 4.0)[:, None] * [0.0, 0.0, 1.0])
    np.testing.assert_allclose(12.0 * STEPS, [2.0, 4.0, 6.0, 8.0, 10.0, 11.0])
    change = (order / 11.0 >= STEPS[1])[:, None] * motions(fit)
    (same,) = shown(blocks(fit, fit.jacobian, [change], np.searchsorted(STEPS, order / 11.0, "right")))
    found = of_motion(fit, order)[0]
    assert found.size_mm == pytest.approx(same.size_mm, rel=1e-6)
    assert found.log_ratio == pytest.approx(same.log_ratio - np.log(6.0))


def looks_that_err(seen, size_mm, count=2400):
    """A fit of points of four looks, each shifted by itself along x, y and z; and which look each is of."""
    points, normals = seen(count)
    look = np.random.default_rng(9).integers(4, size=count)
    shifts = size_mm * np.random.default_rng(2).normal(size=(4, 3))
    return fit_of(points, normals, noise(count) + (shifts - shifts.mean(axis=0))[look]), look


def of_looks(fit, look):
    """The evidence that looks err, and the changes of the residuals by it: each look moves by itself."""
    moved, numbers = motions(fit), np.unique(look)
    changes = np.hstack([np.where(look == number, 1.0, 0.0)[:, None] * moved for number in numbers])
    (found,) = shown(blocks(fit, fit.jacobian, [changes], np.searchsorted(numbers, look)))
    return found, changes


def test_looks_that_err_against_each_other_show_by_how_much(seen):
    none, some, much = (of_looks(*looks_that_err(seen, size_mm))[0] for size_mm in (0.0, 0.5, 1.5))
    assert none.log_ratio < 2.0 < some.log_ratio < much.log_ratio
    assert none.size_mm < 0.2 < 0.25 < some.size_mm < 0.8 < 0.9 < much.size_mm < 2.5


@pytest.mark.parametrize(("size_mm", "last"), [(0.5, 3), (1.5, 3), (0.5, 7)])
def test_what_looks_err_by_against_each_other_is_added_to_the_covariance(seen, size_mm, last):
    """A number that is missing is no look."""
    fit, look = looks_that_err(seen, size_mm)
    look = np.where(look == 3, last, look)
    (found, changes), uncertainty = of_looks(fit, look), PoseUncertainty(np.eye(6), 0.0, 0.0, 0.0)
    added = covariance_added_by(fit, found.size_mm * changes)
    np.testing.assert_allclose(with_looks(uncertainty, fit, look).covariance, np.eye(6) + added)
    assert changes.shape == (len(look), 24) and np.trace(added[:3, :3]) > (0.1 if size_mm > 1.0 else 0.0)


def test_nothing_is_added_of_one_look_or_few_points_or_where_the_looks_do_not_err(seen, monkeypatch):
    fit, look = looks_that_err(seen, 1.5)
    uncertainty, few = PoseUncertainty(np.eye(6), 0.0, 0.0, 0.0), looks_that_err(seen, 1.5, 199)
    for of_one_or_few in ((fit, None), (fit, np.zeros_like(look)), few):
        assert with_looks(uncertainty, *of_one_or_few) is uncertainty
    for log_ratio, is_same in ((0.0, True), (1e-9, False)):
        monkeypatch.setattr(deformations, "shown", lambda _, log_ratio=log_ratio: [Shown(log_ratio, 2.0)])
        assert (with_looks(uncertainty, fit, look) is uncertainty) is is_same
