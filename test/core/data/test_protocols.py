from __future__ import annotations

import pickle

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from shapes import ball_specimen, knob_specimen

from gapr_core.data import degradation, protocols
from gapr_core.data.protocols import LEVELS, PROTOCOLS, TARGET_POINTS, make_pair
from gapr_core.data.specimen import Specimen
from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_core.geometry import se3
from gapr_core.surface import Surface

OF_THE_BONE = [name for name in PROTOCOLS if not name.startswith("scene") and "-far" not in name]  # see test_scenes
WITH_TRUTH = [name for name in OF_THE_BONE if name != "wrong"]
RADIUS = 60.0
OTHERS = [ball_specimen(person="p1"), knob_specimen(person="p0"), knob_specimen(person="p1")]


def in_target_frame(pair):
    return se3.apply(pair.T_target_source, pair.source)


@pytest.mark.parametrize("protocol", OF_THE_BONE)
def test_the_same_seed_gives_the_same_pair_and_another_seed_another_one(protocol):
    first, again, other = (make_pair(protocol, ball_specimen(), seed, OTHERS) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.source, again.source)
    np.testing.assert_array_equal(first.target, again.target)
    np.testing.assert_array_equal(first.T_target_source, again.T_target_source)
    assert first.source.shape != other.source.shape or np.abs(first.source - other.source).max() > 1.0


@pytest.mark.parametrize("protocol", WITH_TRUTH)
def test_the_true_pose_lays_the_source_on_the_surface(protocol):
    pair = make_pair(protocol, ball_specimen(RADIUS), 1)
    off = np.linalg.norm(in_target_frame(pair) + pair.metadata["origin_mm"] - [300.0, -200.0, 900.0], axis=1) - RADIUS
    standoff_mm, shift_mm = (abs(pair.metadata.get(name, 0.0)) for name in ("standoff_mm", "shift_mm"))
    systematic_mm = 3.0 * pair.metadata["bias_mm"] + 3.0 * standoff_mm + shift_mm
    clean = np.abs(off) < 6.0 * pair.metadata["noise_mm"] + systematic_mm
    assert clean.mean() >= 0.99 - pair.metadata["outlier_share"]
    assert abs(np.median(off)) < 1.5 + (standoff_mm if protocol == "covered" else 0.0)
    assert np.linalg.det(pair.T_target_source[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize("protocol", WITH_TRUTH)
def test_targets_have_8192_points_centred_on_their_mean(protocol):
    pair = make_pair(protocol, ball_specimen(), 5)
    expected = round(0.9 * TARGET_POINTS) if protocol == "incomplete" else TARGET_POINTS
    assert pair.target.shape == (expected, 3)
    np.testing.assert_allclose(pair.target.mean(axis=0), 0.0, atol=1e-9)


@pytest.mark.parametrize("percent", [40, 50, 60, 70])
def test_overlap_k_keeps_that_share_of_the_surface(percent):
    pair = make_pair(f"overlap-{percent}", ball_specimen(RADIUS), 2)
    heights = cKDTree(in_target_frame(pair)).query(pair.target)[0]
    covered = (heights < 5.0).mean()  # a cap of a ball: covered target points are those near the source
    assert covered == pytest.approx(percent / 100.0, abs=0.05)


def test_the_noise_of_the_paper_is_one_percent_of_half_the_longest_edge():
    pair = make_pair("overlap-70", ball_specimen(RADIUS), 0)
    off = np.linalg.norm(in_target_frame(pair) + pair.metadata["origin_mm"] - [300.0, -200.0, 900.0], axis=1) - RADIUS
    half_edge_mm = degradation.half_edge_mm(in_target_frame(pair))
    inner = np.abs(off) < 3.0  # interpolated points lie on chords below the surface
    assert off[inner].std() == pytest.approx(0.01 * half_edge_mm, rel=0.25)
    assert pair.metadata["noise_mm"] == pytest.approx(0.01 * half_edge_mm, rel=0.1)


def test_on_long_bones_the_paper_crops_at_an_end_and_on_round_ones_anywhere():
    def crop_heights(stretch):
        pairs = [make_pair("overlap-40", ball_specimen(40.0, stretch=stretch), seed) for seed in range(24)]
        return np.array([np.median(in_target_frame(p)[:, 2]) / p.target[:, 2].max() for p in pairs])

    long_bone, round_bone = np.abs(crop_heights(6.0)), np.abs(crop_heights(1.0))
    assert long_bone.min() > 0.3
    assert round_bone.min() < 0.3


@pytest.mark.parametrize(("stretch", "at_an_end"), [(1.8, False), (2.2, True)])
def test_a_bone_is_long_where_it_is_twice_as_long_as_wide(stretch, at_an_end):
    rng = np.random.default_rng(0)
    cloud = rng.uniform(-1.0, 1.0, (4000, 3)) * [1.0, 1.0, stretch]
    heights = np.array([cloud[protocols._crop_centre(cloud, rng), 2] for _ in range(60)]) / stretch
    assert (np.abs(heights).min() > 0.88) == at_an_end


def test_a_ball_is_thinned_to_half_or_filled_with_half_as_many_between_its_points(monkeypatch):
    monkeypatch.setattr(degradation, "ROUNDS", 1)
    points = np.random.default_rng(0).normal(size=(101, 3))
    found = [degradation.vary_density(points, 1e3, np.random.default_rng(seed)) for seed in range(8)]
    assert {len(each) for each in found} == {101 - 50, 101 + 51}
    for each in found:
        assert (each.min(axis=0) >= points.min(axis=0)).all() and (each.max(axis=0) <= points.max(axis=0)).all()


def test_a_sweep_covers_a_narrow_band_from_end_to_end():
    pair = make_pair("sweep", ball_specimen(40.0, stretch=6.0), 1)
    swept = in_target_frame(pair)
    along, across = np.ptp(swept[:, 2]), min(np.ptp(swept[:, 0]), np.ptp(swept[:, 1]))
    assert along > 0.8 * np.ptp(pair.target[:, 2])
    assert across < 0.7 * np.ptp(pair.target[:, 0])
    assert 0.02 < pair.metadata["overlap"] <= 0.20


def test_the_rotations_of_the_paper_stay_within_a_half_turn_per_axis_and_the_levels_cover_all():
    def angles(protocol):
        inverse = [make_pair(protocol, ball_specimen(), seed).T_target_source[:3, :3].T for seed in range(60)]
        return np.abs(Rotation.from_matrix(inverse).as_matrix())[:, 2, 2], Rotation.from_matrix(inverse)

    _, papers = angles("paper")
    _, levels = angles("L3")
    # Euler angles in [0, 180] per axis: the composed matrix of any of them keeps -sin(y) <= 0 in its last row's x
    assert (papers.as_matrix()[:, 2, 0] <= 1e-12).all()
    assert (levels.as_matrix()[:, 2, 0] > 0).sum() > 15
    assert np.degrees(levels.magnitude()).max() > 150.0


def test_translations_reach_150_mm_and_no_farther():
    shifts = np.array([se3.inverse(make_pair("paper", ball_specimen(), s).T_target_source)[:3, 3] for s in range(60)])
    assert np.abs(shifts).max() <= 150.0
    assert np.abs(shifts).max(axis=0).min() > 120.0


@pytest.mark.parametrize("level", list(LEVELS))
def test_a_one_sided_source_lies_on_the_side_of_the_probe(level):
    pair = make_pair(level, ball_specimen(RADIUS), 7)
    local = in_target_frame(pair) + pair.metadata["origin_mm"] - [300.0, -200.0, 900.0]
    clean = np.abs(np.linalg.norm(local, axis=1) - RADIUS) < 3.0
    assert ((local[clean] @ pair.metadata["view_direction"]) > -5.0).mean() > 0.99
    low, high = LEVELS[level].share
    assert low <= pair.metadata["share"] <= high
    assert pair.metadata["overlap"] <= pair.metadata["share"] + 1e-3
    assert len(pair.source) <= LEVELS[level].max_points


def thin_specimen():
    """A flat ellipsoid, which has as much surface on its far side as on its near one."""
    ball = ball_specimen(RADIUS).surface
    return Specimen(Surface(ball.points * [1.0, 1.0, 0.1], ball.faces), "disc", "p0")


@pytest.mark.parametrize("level", ["L2", "L3"])
def test_the_share_is_of_what_is_seen_or_of_a_region_whose_far_side_is_lost(level):
    seen, region = (
        [make_pair(name, thin_specimen(), seed).metadata for seed in range(6)] for name in (level, f"{level}-region")
    )
    assert all(m["overlap"] == pytest.approx(m["share"], abs=0.01) for m in seen)
    assert all(m["overlap"] < 0.7 * m["share"] for m in region)


def test_a_point_behind_another_part_of_the_bone_is_not_seen():
    specimen = knob_specimen()
    points = np.array([[120.0, 0.0, 0.0], [80.0, 0.0, 0.0], [50.0, 0.0, 0.0], [0.0, 50.0, 0.0], [-50.0, 0.0, 0.0]])
    from_right = specimen.visible_from(points, np.array([1.0, 0.0, 0.0]))
    np.testing.assert_array_equal(from_right, [True, False, False, True, False])
    from_above = specimen.visible_from(points, np.array([0.0, 1.0, 0.0]))
    assert from_above[3]


def test_views_do_not_depend_on_the_winding_of_the_faces():
    specimen = ball_specimen()
    flipped = Specimen(Surface(specimen.surface.points, specimen.surface.faces[:, ::-1].copy()), "ball", "p0")
    points = specimen.sample(500, np.random.default_rng(0))[0]
    direction = np.array([0.0, 0.6, 0.8])
    np.testing.assert_array_equal(specimen.visible_from(points, direction), flipped.visible_from(points, direction))


def test_the_bias_is_nowhere_more_than_named_is_smooth_and_lies_along_the_normals():
    rng = np.random.default_rng(0)
    points, normals = ball_specimen(RADIUS).sample(3000, rng)
    offsets = degradation.bias_along_normals(points, normals, 1.5, rng)
    height = (offsets * normals).sum(axis=1)
    assert np.abs(height).max() == pytest.approx(1.5)
    assert np.sqrt((height**2).mean()) > 0.4
    np.testing.assert_allclose(offsets, height[:, None] * normals, atol=1e-12)
    apart, near = (column[:, 1] for column in cKDTree(points).query(points, k=2))
    assert (np.abs(height - height[near]) / apart).max() < 1.0  # no step anywhere
    assert (height > 0.3).any() and (height < -0.3).any()


def test_outliers_are_3_to_15_mm_off_the_surface():
    specimen, rng = ball_specimen(RADIUS), np.random.default_rng(0)
    outliers = degradation.scatter_outliers(specimen, *specimen.sample(400, rng), rng)
    off = specimen.distance(outliers)
    assert len(outliers) == 400
    assert off.min() >= 3.0 and off.max() <= 15.0


@pytest.mark.parametrize("level", ["L2", "L3"])
def test_the_share_of_outliers_is_the_named_one(level):
    specimen = ball_specimen(RADIUS)
    pair = make_pair(level, specimen, 11)
    off = specimen.distance(in_target_frame(pair) + pair.metadata["origin_mm"])
    expected = LEVELS[level].outlier_share
    assert abs((off > 7.0).mean() / expected - 0.6) < 0.12  # two thirds of U[3, 15], lessened by the slant


def test_the_source_of_the_levels_shares_no_point_with_the_target():
    pair = make_pair("L1", ball_specimen(), 0)
    assert cKDTree(pair.target).query(in_target_frame(pair))[0].min() > 1e-6


def test_incomplete_targets_lack_a_tenth_and_overlap_by_at_least_40_percent():
    pair = make_pair("incomplete", ball_specimen(RADIUS), 1)
    assert pair.metadata["overlap"] == pytest.approx(0.4 / 0.9, abs=0.01)
    far_from_target = cKDTree(pair.target).query(in_target_frame(pair))[0] > 8.0
    assert 0.02 < far_from_target.mean() < 0.3


def test_wrong_pairs_come_from_another_bone_or_another_person_and_have_no_pose():
    pairs = [make_pair("wrong", ball_specimen(), 1, OTHERS, turn) for turn in range(8)]
    assert all(np.isnan(p.T_target_source).all() and not p.has_truth for p in pairs)
    assert [p.metadata["wrong_kind"] for p in pairs[:2]] == ["other_bone", "other_person"]
    both = {(p.metadata["wrong_kind"], p.metadata["degraded_as"]) for p in pairs}
    assert both == {(kind, seen) for kind in ("other_bone", "other_person") for seen in ("L1", "L2", "L3", "paper")}
    for pair in pairs:
        same_bone = pair.metadata["source_bone"] == pair.bone
        assert not same_bone or pair.metadata["source_person"] != pair.person


def test_wrong_without_anybody_else_says_what_is_missing():
    same_person_twice = [ball_specimen(person="p0"), ball_specimen(person="p0")]
    with pytest.raises(ConfigError, match="another bone or another subject"):
        make_pair("wrong", ball_specimen(person="p0"), 0, same_person_twice)


def test_an_unknown_protocol_and_a_cloud_without_faces_are_refused():
    with pytest.raises(ConfigError, match="overlap-40"):
        make_pair("L4", ball_specimen(), 0)
    with pytest.raises(InvalidPointCloudError, match="faces"):
        Specimen(Surface(np.zeros((5, 3))), "femur", "somebody")


def test_specimens_travel_to_worker_processes_after_they_have_cast_rays():
    specimen = ball_specimen()
    specimen.distance(np.zeros((1, 3)))
    copy = pickle.loads(pickle.dumps(specimen))
    np.testing.assert_array_equal(make_pair("L1", copy, 3).source, make_pair("L1", specimen, 3).source)
