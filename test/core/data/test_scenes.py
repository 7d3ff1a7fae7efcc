"""What the scene protocols say of themselves holds: shares, lines of sight, tissue outside, noise, seeds."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import open3d as o3d
import pytest
from shapes import ball_specimen, knob_specimen

from gapr_core.data.pair_files import load_pair, save_pair
from gapr_core.data.parametric import make_bone
from gapr_core.data.protocols import make_pair
from gapr_core.data.scenes import camera, joint, limb, scene
from gapr_core.data.scenes.scene import SCENE_LEVELS
from gapr_core.data.specimen import Specimen
from gapr_core.errors import ConfigError
from gapr_core.geometry import se3

LEVELS = ("scene-C1", "scene-C2", "scene-C3")
WORST_MM = 6.0 * (0.4 + 1.2e-6 * 650.0**2) + 0.4  # six standard deviations and the smooth error


@lru_cache
def tibia():
    return Specimen(make_bone("tibia", 3), "tibia", "parametric_3", "parametric")


@lru_cache
def made(protocol, seed=0):
    return make_pair(protocol, tibia(), seed)


def ray_scene(surface, origin):
    rays = o3d.t.geometry.RaycastingScene(nthreads=1)
    rays.add_triangles((surface.points - origin).astype(np.float32), surface.triangles.astype(np.uint32))
    return rays


def in_bone_frame(pair, points):
    return se3.apply(pair.T_target_source, points) + pair.metadata["origin_mm"]


def signed_distance_mm(pair):
    """Of every source point to the bone, negative inside."""
    rays = ray_scene(tibia().surface, pair.metadata["origin_mm"])
    return rays.compute_signed_distance(se3.apply(pair.T_target_source, pair.source).astype(np.float32)).numpy()


def depth_of_bone_mm(pair):
    """How far the camera is from every source point, and from the bone along the same line."""
    viewpoint = in_bone_frame(pair, pair.viewpoint[None])[0]
    sight = in_bone_frame(pair, pair.source) - viewpoint
    away = np.linalg.norm(sight, axis=1)
    rays = np.hstack([np.zeros_like(sight), sight / away[:, None]]).astype(np.float32)
    return away, ray_scene(tibia().surface, viewpoint).cast_rays(rays)["t_hit"].numpy()


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("protocol", LEVELS)
def test_the_share_of_bone_is_that_of_the_level(protocol, seed):
    pair = made(protocol, seed)
    low, high = SCENE_LEVELS[protocol].bone_share
    assert pair.metadata["is_bone"].shape == (len(pair.source),)
    assert low <= pair.metadata["is_bone"].mean() <= high
    assert pair.metadata["bone_share"] == pair.metadata["is_bone"].mean()
    assert len(pair.source) <= 8000


@pytest.mark.parametrize("protocol", LEVELS)
def test_a_point_is_bone_where_the_camera_meets_bone_first(protocol):
    pair = made(protocol)
    is_bone = pair.metadata["is_bone"]
    away, bone = depth_of_bone_mm(pair)
    assert np.abs(away - bone)[is_bone].max() < WORST_MM
    assert (bone - away)[~is_bone].min() > -WORST_MM  # nothing of the bone lies before it
    assert np.median(np.abs(away - bone)[is_bone]) < 1.0


@pytest.mark.parametrize("protocol", [*LEVELS, "scene-packed", "scene-hand"])
def test_what_is_not_bone_lies_outside_the_bone(protocol):
    pair = made(protocol)
    signed = signed_distance_mm(pair)
    assert signed[~pair.metadata["is_bone"]].min() > -WORST_MM
    assert np.abs(signed[pair.metadata["is_bone"]]).max() < WORST_MM


def test_the_bone_lies_deeper_than_the_skin_above_it():
    """Measured from the camera in the wound: bone at the bottom."""
    pair = made("scene-C3")
    height = in_bone_frame(pair, pair.source) @ pair.metadata["wound_axis"]
    is_bone = pair.metadata["is_bone"]
    assert np.median(height[is_bone]) + 5.0 < np.quantile(height[~is_bone], 0.75)


@pytest.mark.parametrize("protocol", ["scene-C2", "scene-packed", "scene-drape"])
def test_nothing_at_all_lies_between_the_camera_and_a_point(protocol):
    rng = np.random.default_rng(5)
    setting = scene.arrange(tibia(), rng, SCENE_LEVELS[protocol])
    seen_from = camera.looking_at(setting.wound.centre, setting.wound.at(np.array([50.0, 0.0, 450.0])), 0.3)
    view = camera.see(setting.parts, seen_from)
    sight = view.points - view.camera
    rays = np.hstack([np.zeros_like(sight), 0.999 * sight]).astype(np.float32)
    for part in setting.parts:
        assert not ray_scene(part, view.camera).test_occlusions(rays, tfar=1.0).numpy().any()


def test_the_camera_is_where_the_protocol_says():
    off, away = [], []
    for seed in range(3):
        pair = made("scene-C2", seed)
        sight = in_bone_frame(pair, pair.viewpoint[None])[0] - pair.metadata["wound_centre"]
        away.append(np.linalg.norm(sight))
        off.append(np.degrees(np.arccos(sight @ pair.metadata["wound_axis"] / away[-1])))
    assert 350.0 <= min(away) and max(away) <= 550.0
    assert max(off) <= 25.0 and np.ptp(off) > 1.0


@pytest.mark.parametrize("protocol", [*LEVELS, "scene-packed", "scene-image"])
def test_the_same_seed_gives_the_same_scene_to_the_bit_and_another_seed_another(protocol):
    pair, again, other = made(protocol), make_pair(protocol, tibia(), 0), make_pair(protocol, tibia(), 9)
    for first, second in ((pair.source, again.source), (pair.viewpoint, again.viewpoint)):
        np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(pair.metadata["is_bone"], again.metadata["is_bone"])
    np.testing.assert_array_equal(pair.T_target_source, again.T_target_source)
    assert np.abs(pair.T_target_source - other.T_target_source).max() > 1e-3


def test_a_scene_made_after_others_is_the_same():
    """What is kept of a bone, the grown limb, does not depend on what was made before."""
    pair = made("scene-C1", 1)
    limb.skin.cache_clear()
    np.testing.assert_array_equal(make_pair("scene-C1", tibia(), 1).source, pair.source)


def test_the_order_of_the_points_says_nothing_about_bone():
    is_bone = made("scene-C3").metadata["is_bone"]
    halves = [half.mean() for half in np.array_split(is_bone, 2)]
    assert abs(halves[0] - halves[1]) < 0.05


def test_the_pose_of_the_frame_says_nothing_about_the_wound():
    """Rotations of many seeds spread; the source's frame is no frame of the camera or of the bone."""
    pairs = [made("scene-C1", seed) for seed in range(2)] + [made("scene-C2", seed) for seed in range(3)]
    angles = [se3.rotation_angle_deg(pair.T_target_source) for pair in pairs]
    assert min(angles) > 10.0 and np.ptp(angles) > 10.0
    assert min(np.linalg.norm(pair.viewpoint) for pair in pairs) > 50.0


def test_pair_files_keep_the_viewpoint_and_which_points_are_bone(tmp_path):
    pair = made("scene-C2")
    save_pair(tmp_path / "a.npz", pair)
    read = load_pair(tmp_path / "a.npz")
    np.testing.assert_array_equal(read.viewpoint, pair.viewpoint)
    np.testing.assert_array_equal(read.metadata["is_bone"], pair.metadata["is_bone"])
    assert read.metadata["is_bone"].dtype == bool and read.metadata["bone_share"] == pair.metadata["bone_share"]


def test_a_whole_image_has_a_box_of_interest_near_the_wound():
    pair = made("scene-image")
    low, high = pair.metadata["crop_min"], pair.metadata["crop_max"]
    inside = ((pair.source >= low) & (pair.source <= high)).all(axis=1)
    is_bone = pair.metadata["is_bone"]
    np.testing.assert_allclose(high - low, 200.0)
    wound = se3.apply(
        se3.inverse(pair.T_target_source), (pair.metadata["wound_centre"] - pair.metadata["origin_mm"])[None]
    )[0]
    assert 0.0 < np.linalg.norm((low + high) / 2.0 - wound) <= 30.0
    assert 0.03 <= is_bone.mean() <= 0.12 and is_bone[inside].mean() > 1.5 * is_bone.mean()
    assert np.ptp(pair.source, axis=0).max() > 200.0


def test_a_bone_too_small_for_any_wound_is_an_error(monkeypatch):
    monkeypatch.setattr(scene, "TRIES", 2)
    with pytest.raises(ConfigError, match="none in"):
        make_pair("scene-C1", ball_specimen(2.0), 0)


@pytest.mark.parametrize("turn", [0, 3, 4])
def test_a_wrong_scene_is_of_somebody_else(turn):
    others = [ball_specimen(person="p1"), knob_specimen(person="p2")]
    pair = make_pair("scene-wrong", ball_specimen(person="p0"), 3, others, turn)
    assert not pair.has_truth and pair.viewpoint is not None
    assert pair.metadata["source_person"] == ("p2", "p1")[turn % 2] and pair.person == "p0"
    assert pair.metadata["wrong_kind"] == ("other_bone", "other_person")[turn % 2]
    assert pair.metadata["degraded_as"] == LEVELS[turn // 2]
    assert np.linalg.norm(pair.target, axis=1).max() == pytest.approx(60.0, abs=3.0)  # its own bone


@pytest.mark.parametrize("turn", [0, 3])
def test_a_wrong_scene_is_seen_by_a_stereo_camera_or_under_layers_too(turn):
    others = [ball_specimen(person="p1"), knob_specimen(person="p2")]
    pair = make_pair("scene-wrong-stereo", ball_specimen(person="p0"), 3, others, turn)
    assert not pair.has_truth and pair.metadata["source_person"] == ("p2", "p1")[turn % 2]
    assert pair.metadata["degraded_as"] == ("scene-stereo", "scene-layers")[turn // 2]


def test_a_wound_at_a_joint_is_where_both_bones_are_near(monkeypatch):
    own, neighbour = ball_specimen(50.0), knob_specimen()
    monkeypatch.setattr(joint.wounds, "somewhere", lambda *arguments: arguments[-1])
    near = joint._between(own, neighbour, own, np.random.default_rng(0), None)
    assert not near(own.surface.points[:9]).any() and not near(neighbour.surface.points[:9]).any()
    near = joint._between(own, own, own, np.random.default_rng(0), None)
    assert near(own.surface.points[:9]).all()


def test_a_wound_at_a_joint_holds_the_next_bone_of_the_same_subject():
    """Two balls 10 mm apart, as two bones of one scan: both are seen, and only the first one is bone."""
    bone, far = ball_specimen(40.0), ball_specimen(40.0, bone="far")
    other = moved(ball_specimen(30.0, bone="other"), [80.0, 0.0, 0.0])
    pair = make_pair("scene-joint", bone, 1, [moved(far, [300.0, 0.0, 0.0]), other, replace(other, person="p1")])
    assert pair.metadata["neighbour"] == "other" and 0.1 <= pair.metadata["is_bone"].mean() <= 0.6
    middle = bone.surface.points.mean(axis=0)
    on_bone = np.linalg.norm(in_bone_frame(pair, pair.source) - middle, axis=1) - 40.0
    on_other = np.linalg.norm(in_bone_frame(pair, pair.source) - middle - [80.0, 0.0, 0.0], axis=1) - 30.0
    is_bone = pair.metadata["is_bone"]
    assert np.abs(on_bone[is_bone]).max() < WORST_MM and (np.abs(on_other[~is_bone]) < WORST_MM).mean() > 0.05
    centre = pair.metadata["wound_centre"][None]
    assert max(bone.distance(centre)[0], other.distance(centre)[0]) <= 40.0
    np.testing.assert_allclose(np.linalg.norm(pair.target, axis=1), 40.0, atol=2.0)  # the other one is no target


@pytest.mark.parametrize("others", [[], [ball_specimen(person="p1")], [replace(ball_specimen(), cohort="parametric")]])
def test_a_joint_needs_another_bone_of_the_same_scan(others):
    with pytest.raises(ConfigError, match="another bone of p0 within 40 mm"):
        make_pair("scene-joint", knob_specimen(), 0, others)


def moved(specimen, shift):
    return replace(specimen, surface=replace(specimen.surface, points=specimen.surface.points + np.asarray(shift)))
