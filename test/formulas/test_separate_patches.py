"""Which points are of one patch, and what becomes of a pose of which one patch speaks against all others."""

from types import SimpleNamespace

import numpy as np
import pytest
import tiny

from gapr_core.config import RegistrarConfig
from gapr_core.geometry import se3
from gapr_core.geometry.twists import error_twist
from gapr_core.registration.checks import separate_patches
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.checks.separate_patches import FALLS_TO, MOVES_MM, NAME, allowing_for_a_patch, patches
from gapr_core.registration.uncertainty.covariance import PoseUncertainty

CONFIG = RegistrarConfig(num_threads=1)


def spot(count, at_mm, spread_mm=4.0):
    """A grid of points about a place on the x axis."""
    side = int(np.ceil(np.sqrt(count)))
    grid = np.stack(np.meshgrid(*2 * [np.linspace(-spread_mm, spread_mm, side)]), axis=-1).reshape(-1, 2)[:count]
    return np.column_stack([grid, np.zeros(count)]) + [at_mm, 0.0, 0.0]


@pytest.mark.parametrize(("gap_mm", "count"), [(9.0, 1), (12.1, 2)])
def test_points_farther_apart_than_12_mm_are_of_two_patches(gap_mm, count):
    found = patches(np.concatenate([spot(25, 0.0), spot(25, 8.0 + gap_mm)]))
    assert len(np.unique(found)) == count


def test_the_largest_patch_comes_first_and_small_ones_are_none():
    points = np.concatenate([spot(19, 0.0), spot(25, 50.0), spot(100, 100.0), spot(20, 150.0)])
    found = patches(points)
    assert [np.unique(found[k]).tolist() for k in (slice(0, 19), slice(19, 44), slice(44, 144), slice(144, None))] == [
        [-1], [1], [0], [2],
    ]  # fmt: skip


def test_a_patch_of_less_than_a_twentieth_is_none():
    assert patches(np.concatenate([spot(600, 0.0, 20.0), spot(31, 80.0)])).max() == 0
    assert patches(np.concatenate([spot(600, 0.0, 20.0), spot(32, 80.0)])).max() == 1


def test_every_point_is_of_a_patch_though_one_of_each_voxel_is_looked_at():
    found = patches(np.concatenate([spot(400, 0.0), spot(400, 50.0)]))
    assert np.bincount(found).tolist() == [400, 400]


SPOTS = np.concatenate([spot(25, at) for at in (0.0, 40.0, 80.0)])


def assessed(points=SPOTS, seen=None):
    fit, source = SimpleNamespace(T=np.eye(4)), SimpleNamespace(points=points)
    known = PoseUncertainty(np.eye(6), 0.1, 0.2, 0.3)
    return Assessment(fit, None, known, {}, 0.95, None, source, tiny.plane(), seen=seen, deformed={"apart": 1.0})


def refined(monkeypatch, sigmas_mm, shifts_mm):
    """Replaces the refinement: of all points, then without each patch; scales of the residuals, and shifts along x."""
    answers = [
        SimpleNamespace(T=se3.exp([x, 0.0, 0.0, 0.0, 0.0, 0.0]), sigma_mm=sigma)
        for x, sigma in zip(shifts_mm, sigmas_mm, strict=True)
    ]
    asked = []

    def refine(T, points, target, config):
        asked.append(points)
        return answers[len(asked) - 1]

    monkeypatch.setattr(separate_patches, "refine_fully", refine)
    return asked


def test_a_patch_without_which_the_others_fit_far_better_widens_the_covariance(monkeypatch):
    asked = refined(monkeypatch, [1.0, 0.9, 0.6, 0.8], [0.5, 9.0, 3.0, 9.0])
    before = assessed()
    found = allowing_for_a_patch(before, CONFIG)
    assert len(asked[0]) == 75 and [np.unique(each[:, 0].round(-1)).tolist() for each in asked[1:]] == [
        np.unique(np.delete(SPOTS, slice(25 * k, 25 * k + 25), axis=0)[:, 0].round(-1)).tolist() for k in range(3)
    ]
    twist = error_twist(se3.exp([3.0, 0.0, 0.0, 0.0, 0.0, 0.0]), se3.exp([0.5, 0.0, 0.0, 0.0, 0.0, 0.0]), SPOTS)
    assert found.uncertainty.covariance == pytest.approx(np.eye(6) + np.outer(twist, twist))
    assert list(found.deformed) == [NAME, "apart"] and found.deformed[NAME] == pytest.approx(2.5)
    assert found.refusal is None and found.probability == before.probability


@pytest.mark.parametrize(("sigma_mm", "moved_mm", "is_found"), [
    (FALLS_TO - 0.01, MOVES_MM + 0.1, True), (FALLS_TO + 0.01, MOVES_MM + 0.1, False),
    (FALLS_TO - 0.01, MOVES_MM - 0.1, False),
])  # fmt: skip
def test_both_the_residuals_and_the_pose_have_to_change(monkeypatch, sigma_mm, moved_mm, is_found):
    refined(monkeypatch, [1.0, sigma_mm, 0.9, 0.9], [0.0, moved_mm, 9.0, 9.0])
    before = assessed()
    assert (allowing_for_a_patch(before, CONFIG) is not before) is is_found


def test_each_of_five_patches_is_left_out_in_turn(monkeypatch):
    points = np.concatenate([SPOTS, spot(25, 120.0), spot(25, 160.0)])
    asked = refined(monkeypatch, [1.0, 0.9, 0.9, 0.9, 0.9, 0.5], [0.0, 9.0, 9.0, 9.0, 9.0, 4.0])
    found = allowing_for_a_patch(assessed(points), CONFIG)
    assert found.deformed[NAME] == pytest.approx(4.0)
    assert [len(each) for each in asked] == [125] + [100] * 5
    assert all(len(np.unique(each[:, 0].round(-1))) < len(np.unique(points[:, 0].round(-1))) for each in asked[1:])


@pytest.mark.parametrize("change", [{"points": SPOTS[:50]}, {"seen": SimpleNamespace()}])
def test_two_patches_and_scenes_are_not_asked(monkeypatch, change):
    asked = refined(monkeypatch, [1.0] + [0.1] * 3, [0.0] + [9.0] * 3)
    before = assessed(**change)
    assert allowing_for_a_patch(before, CONFIG) is before and not asked
