"""Damaged sources are what their names say: sizes, shares and sides, and nothing else of the pair changes."""

from __future__ import annotations

from dataclasses import replace

import damage as of_damage
import numpy as np
import pytest
from scipy.spatial import cKDTree

from gapr_core.benchmark import records
from gapr_core.config import RegistrarConfig, SensorConfig
from gapr_core.data import damage
from gapr_core.data.damage import CHANGES, DAMAGES, Site
from gapr_core.data.pool import parametric_specimen
from gapr_core.data.protocols import make_pair
from gapr_core.geometry import extent, se3
from gapr_core.results import RegistrationResult, RegistrationStatus


@pytest.fixture(scope="module")
def specimen():
    return parametric_specimen("femur", 3)


@pytest.fixture(scope="module")
def pair(specimen):
    return make_pair("L1", specimen, 7)


@pytest.fixture(scope="module")
def site(specimen, pair):
    return Site.of(specimen, pair.metadata["origin_mm"], parametric_specimen("tibia", 3))


def damaged(name, pair, site, specimen, seed=0):
    """Points of the source before and after, on the bone."""
    found = DAMAGES[name](pair, site, specimen, np.random.default_rng(seed))
    return se3.apply(pair.T_target_source, pair.source), se3.apply(pair.T_target_source, found.source)


@pytest.mark.parametrize("name", DAMAGES)
def test_a_damage_is_the_same_for_the_same_seed_and_leaves_the_true_pose(name, pair, site, specimen):
    first, again = (DAMAGES[name](pair, site, specimen, np.random.default_rng(4)) for _ in range(2))
    np.testing.assert_array_equal(first.source, again.source)
    np.testing.assert_array_equal(first.target, again.target)
    np.testing.assert_array_equal(first.T_target_source, pair.T_target_source)
    assert (first.source is pair.source) == (name == "beyond the target")
    assert np.isfinite(first.source).all() and len(first.source) >= 100


def test_cartilage_lifts_the_ends_outwards_and_nothing_else(pair, site, specimen):
    before, after = damaged("cartilage", pair, site, specimen)
    lifted_mm = np.einsum("ni,ni->n", after - before, site.outward(before))
    along = np.abs((before - site.points.mean(axis=0)) @ extent.principal(site.points).axes[0])
    middle = along < 0.5 * along.max()
    assert np.abs(lifted_mm[middle]).max() < 1e-9 and 1.5 <= lifted_mm.max() <= 3.0 and lifted_mm.min() > -1e-9


def test_an_even_layer_lifts_all_points_outwards_by_the_same(pair, site, specimen):
    before, after = damaged("even layer", pair, site, specimen)
    lifted_mm = np.einsum("ni,ni->n", after - before, site.outward(before))
    assert 4.0 <= lifted_mm.min() == pytest.approx(lifted_mm.max()) and lifted_mm.max() <= 8.0
    assert np.linalg.norm(after - before, axis=1) == pytest.approx(lifted_mm)


def test_a_plate_lies_on_the_bone_and_hides_what_is_under_it(pair, site, specimen):
    before, after = damaged("plate", pair, site, specimen)
    kept = cKDTree(before).query(after)[0] < 1e-6
    top = after[~kept]
    axes = extent.principal(top)
    size = np.ptp((top - top.mean(axis=0)) @ axes.axes.T, axis=0)
    assert 70.0 < size[0] <= 80.0 and 10.0 < size[1] <= 13.0 and size[2] < 3.0
    assert 0.1 <= len(top) / len(before) <= 0.25 and kept.sum() < len(before)


@pytest.mark.parametrize(("name", "low", "high"), [("soft tissue", 0.29, 0.6), ("next bone", 0.2, 0.5)])
def test_what_is_added_has_its_share_and_the_bone_stays(pair, site, specimen, name, low, high):
    before, after = damaged(name, pair, site, specimen)
    np.testing.assert_allclose(after[: len(before)], before, atol=1e-9)
    assert low <= len(after) / len(before) - 1.0 <= high


def test_the_next_bone_lies_where_it_lies_in_the_scan(specimen):
    """Both bones far from the scan's origin, which the pair has taken off: 60 mm apart as before."""
    surface, beside = specimen.surface, np.array([60.0, 0.0, 0.0])
    bone, neighbour = (
        replace(specimen, surface=replace(surface, points=surface.points + [300.0, -200.0, 900.0] + off))
        for off in (np.zeros(3), beside)
    )
    pair = make_pair("L1", bone, 7)
    site = Site.of(bone, pair.metadata["origin_mm"], neighbour)
    before, after = damaged("next bone", pair, site, bone)
    added = after[len(before) :]
    assert len(added) >= 0.2 * len(before) - 1
    assert cKDTree(site.points).query(added)[0].max() < damage.JOINT_MM + 5.0
    gaps_mm = np.abs(bone.distance(added - beside + pair.metadata["origin_mm"]))
    assert 0.3 < np.median(gaps_mm) < 1.0 and gaps_mm.max() < 6.0  # noise of 1 mm


def test_without_a_neighbour_nothing_is_added(pair, site, specimen):
    alone = Site.of(specimen, pair.metadata["origin_mm"])
    before, after = damaged("next bone", pair, alone, specimen)
    np.testing.assert_allclose(after, before, atol=1e-9)


def test_a_fragment_moves_as_one_and_the_rest_does_not_move(pair, site, specimen):
    before, after = damaged("fracture", pair, site, specimen)
    moved = np.linalg.norm(after - before, axis=1) > 1e-9
    assert 0.25 <= moved.mean() <= 0.4 + 1e-3
    T = se3.kabsch(before[moved], after[moved])
    np.testing.assert_allclose(se3.apply(T, before[moved]), after[moved], atol=1e-9)
    assert 4.0 <= se3.rotation_angle_deg(T) <= 10.0
    shift_mm = np.linalg.norm(after[moved].mean(axis=0) - before[moved].mean(axis=0))
    assert 2.0 <= shift_mm <= 6.0


def test_the_grid_is_of_2_mm_and_one_axis_is_longer_by_a_twenty_eighth(pair, site, specimen):
    before, after = damaged("coarse grid", pair, site, specimen)
    assert 0.5 < np.linalg.norm(after - before, axis=1).mean() < 1.74  # sqrt(3) at most, for 2 mm
    assert len(np.unique(after.round(6), axis=0)) < len(before)
    largest = set()
    for seed in range(6):
        before, after = damaged("one axis", pair, site, specimen, seed)
        change = np.linalg.lstsq(before - before.mean(axis=0), after - after.mean(axis=0), rcond=None)[0]
        sizes = np.linalg.svd(change)[1] - 1.0
        np.testing.assert_allclose(np.sort(np.abs(sizes)), [0.0, 0.0, 0.035], atol=1e-9)
        largest.add(round(sizes[np.abs(sizes).argmax()], 3))
    assert largest == {-0.035, 0.035}


def test_a_wrong_range_changes_the_size_and_nothing_else(pair, site, specimen):
    sizes = []
    for seed in range(6):
        before, after = damaged("wrong range", pair, site, specimen, seed)
        before, after = before - before.mean(axis=0), after - after.mean(axis=0)
        sizes.append(np.linalg.norm(after) / np.linalg.norm(before))
        np.testing.assert_allclose(after, sizes[-1] * before, atol=1e-9)
    off = np.array(sizes) - 1.0
    assert (np.abs(off) >= 0.005).all() and (np.abs(off) <= 0.02).all() and off.min() < 0.0 < off.max()


def test_patches_err_by_1_mm_along_the_normals_alike_where_points_are_near(pair, site, specimen):
    before, after = damaged("patches", pair, site, specimen)
    off_mm = np.einsum("ni,ni->n", after - before, site.outward(before))
    np.testing.assert_allclose(np.linalg.norm(after - before, axis=1), np.abs(off_mm), atol=1e-9)
    assert off_mm.std() == pytest.approx(1.0, rel=0.02)
    apart, nearest = cKDTree(before).query(before, k=2)
    near = apart[:, 1] < 1.5
    assert np.corrcoef(off_mm[near], off_mm[nearest[near, 1]])[0, 1] > 0.7


def test_lines_are_15_mm_apart(pair, site, specimen):
    before, after = damaged("lines", pair, site, specimen)
    assert 0.03 < len(after) / len(before) < 0.12
    direction = np.random.default_rng(0).normal(size=3)
    assert (after @ (direction / np.linalg.norm(direction)) % 15.0 < 1.0).all()


def test_two_views_are_1_to_2_mm_apart_and_share_the_middle(pair, site, specimen):
    before, after = damaged("stitched", pair, site, specimen)
    shift = after - before
    lengths = np.linalg.norm(shift, axis=1)
    second = lengths > 1e-9
    assert 0.4 < second.mean() < 0.6 and 1.0 <= lengths[second].min() and np.ptp(shift[second], axis=0).max() < 1e-9
    assert lengths.max() <= 2.0


def test_a_bent_cloud_sags_by_3_mm_at_its_end(pair, site, specimen):
    before, after = damaged("bent", pair, site, specimen)
    sag = np.linalg.norm(after - before, axis=1)
    assert sag.max() == pytest.approx(3.0) and sag.min() < 0.01


def test_smoothing_takes_noise_away_and_heavy_tails_add_it(pair, site, specimen):
    tree = cKDTree(site.points)
    before, after = damaged("smoothed", pair, site, specimen)
    assert np.median(tree.query(after)[0]) < 0.9 * np.median(tree.query(before)[0])
    before, after = damaged("heavy tails", pair, site, specimen)
    assert np.abs(after - before).max() > 20.0 and 0.5 < np.median(np.abs(after - before)) < 1.5


def test_the_target_ends_and_the_source_reaches_beyond(pair, site, specimen):
    found = DAMAGES["beyond the target"](pair, site, specimen, np.random.default_rng(1))
    length = [np.ptp(cloud @ extent.principal(site.points).axes[0]) for cloud in (found.target, pair.target)]
    assert length[0] / length[1] == pytest.approx(0.6, abs=0.03)
    gaps = cKDTree(found.target).query(se3.apply(pair.T_target_source, pair.source))[0]
    assert len(found.target) == len(pair.target) and gaps.max() > 10.0


def test_a_pair_without_a_true_pose_is_not_damaged(pair, site, specimen):
    wrong = replace(pair, T_target_source=np.full((4, 4), np.nan))
    with pytest.raises(ValueError, match="a pair with a true pose"):
        damage.of_source(CHANGES["lines"], wrong, site, specimen, np.random.default_rng(0))


class Asked:
    """A registrar that counts its questions and refuses."""

    def __init__(self, kind="unknown"):
        self.config, self.asked = RegistrarConfig(sensor=SensorConfig(kind)), 0

    def prepare(self, points):
        return points

    def register(self, source, target):
        self.asked += 1
        return RegistrationResult(RegistrationStatus.AMBIGUOUS)


def test_records_of_other_subjects_another_split_and_another_sensor_do_not_pass_for_new_ones(tmp_path):
    people = [parametric_specimen("femur", number) for number in (3, 8)]
    cases, path = [("lines", "femur", 0, False), ("lines", "femur", 0, True)], tmp_path / records.FILE
    asked, camera = Asked(), Asked("depth_camera")
    first = of_damage.run(cases, {"femur": people}, path, asked, "val")
    assert of_damage.run(cases, {"femur": people}, path, asked, "val") == first and asked.asked == 2
    assert [record.person for record in first] == ["parametric_3", "parametric_8"]
    of_damage.run(cases, {"femur": people}, path, asked, "test")
    assert asked.asked == 4
    swapped = of_damage.run(cases, {"femur": people[::-1]}, path, asked, "val")
    assert asked.asked == 6 and [record.person for record in swapped] == ["parametric_8", "parametric_3"]
    of_damage.run(cases, {"femur": people}, path, camera, "val")
    assert camera.asked == 2 and len({record.pair for record in records.read(path)}) == 8
