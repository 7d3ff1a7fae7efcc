"""A stream of scenes: true poses, the camera on its circle, and the bone's motion."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from shapes import ball_specimen

from gapr_core.data.scenes.stream import SceneMotion, simulate
from gapr_core.geometry import se3

FRAMES = 8
CENTRE = np.array([300.0, -200.0, 900.0])


@lru_cache
def frames(in_room=False, level="scene-C2"):
    return list(simulate(ball_specimen(), 1, SceneMotion(frames=FRAMES, in_room=in_room, level=level)))


@pytest.mark.parametrize("in_room", [False, True])
def test_the_true_pose_of_every_frame_lays_the_bone_on_the_bone(in_room):
    for pair in frames(in_room):
        on_bone = se3.apply(pair.T_target_source, pair.source[pair.metadata["is_bone"]]) + pair.metadata["origin_mm"]
        off = np.abs(np.linalg.norm(on_bone - CENTRE, axis=1) - 60.0)
        assert len(off) > 200 and np.median(off) < 1.0 and off.max() < 6.0


def test_in_the_cameras_frame_the_viewpoint_is_the_origin_and_it_looks_along_z():
    for pair in frames():
        np.testing.assert_allclose(pair.viewpoint, 0.0, atol=1e-9)
        assert 350.0 < np.median(pair.source[:, 2]) < 550.0
        assert np.abs(np.median(pair.source[:, :2], axis=0)).max() < 60.0


def test_in_the_room_the_camera_goes_round_once_and_its_frame_is_not_that_of_the_bone():
    places = np.array([pair.viewpoint for pair in frames(True)])
    radius = np.linalg.norm(places - places.mean(axis=0), axis=1)
    np.testing.assert_allclose(radius, 450.0 * np.sin(np.radians(20.0)), rtol=1e-6)
    steps = np.linalg.norm(np.diff(places, axis=0, append=places[:1]), axis=1)
    np.testing.assert_allclose(steps, 2.0 * radius[0] * np.sin(np.pi / FRAMES), rtol=1e-6)
    assert se3.rotation_angle_deg(frames(True)[0].T_target_source) > 5.0


def test_the_bone_sways_by_what_is_asked_and_comes_back():
    poses = [pair.T_target_source for pair in frames(True)]
    turned = [se3.rotation_angle_deg(se3.inverse(poses[0]) @ pose) for pose in poses]
    assert max(turned) == pytest.approx(5.0, abs=1e-6)
    np.testing.assert_allclose(turned[:: FRAMES // 4], 0.0, atol=1e-6)  # to either side, twice
    assert (np.diff(turned) != 0.0).all()


def test_frames_of_a_seed_repeat_and_a_whole_image_has_no_region():
    again = next(iter(simulate(ball_specimen(), 1, SceneMotion(frames=FRAMES))))
    np.testing.assert_array_equal(again.source, frames()[0].source)
    assert np.ptp(frames(level="scene-image")[0].source, axis=0).max() > np.ptp(frames()[0].source, axis=0).max()
