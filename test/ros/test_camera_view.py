"""A camera's view of a wound, to the node as users start it: nothing but the pixels says where the camera was."""

from __future__ import annotations

import numpy as np
from harness import Client, NodeProcess, pose_mm, wait_until

from gapr_core.data.parametric import make_bone
from gapr_core.data.scenes import camera
from gapr_core.data.scenes import stream as scenes
from gapr_core.data.specimen import Specimen
from gapr_core.geometry import se3
from gapr_ros.node import units
from msg_adapters import pose_to_matrix

T_ROOM_CAMERA = pose_mm([2.0, 0.4, -0.3], [300.0, -150.0, 900.0])


def test_a_wound_is_registered_by_its_pixels_or_its_surface_whatever_frame_it_is_in(tmp_path):
    """More than half of the points are not bone: first in pixels, then in a row, where their surface has to do."""
    femur = Specimen(make_bone("femur", 900_001), "femur", "test")
    pair = next(iter(scenes.simulate(femur, 4, scenes.SceneMotion(frames=1))))
    focal = camera.PIXELS / 2.0 / np.tan(np.radians(camera.FIELD_OF_VIEW_DEG / 2.0))
    column, row = np.rint((pair.source[:, :2] / pair.source[:, 2:] * focal + camera.PIXELS / 2.0 - 0.5).T).astype(int)
    image = np.full((camera.PIXELS, camera.PIXELS, 3), np.nan)
    image[row, column] = se3.apply(T_ROOM_CAMERA, pair.source)
    client, model = Client(), tmp_path / "femur.npy"
    np.save(model, pair.target)
    node = NodeProcess(tmp_path, model_path=model, model_unit="mm")
    try:
        client.wait_for_state("active")
        values = client.ask(image / 1000.0)
        assert values["level"] == 0 and values["found_by"] == "scene", (values, node.log)
        seen_from = [float(x) for x in values["seen_from"].split()]
        np.testing.assert_allclose(seen_from, T_ROOM_CAMERA[:3, 3] / 1000.0, atol=0.002)
        wait_until(lambda: client.poses)
        estimate = units.core_pose(pose_to_matrix(client.poses[0])) @ T_ROOM_CAMERA
        translation_mm, rotation_deg = se3.pose_error(estimate, pair.T_target_source, pair.source)
        assert translation_mm < 2.0 and rotation_deg < 3.0
        client.call("reset")
        in_a_row = client.ask(image[row, column] / 1000.0)
        assert in_a_row["level"] == 0 and in_a_row["found_by"] == "scene", (in_a_row, node.log)
        assert in_a_row["seen_from"] == ""
        wait_until(lambda: len(client.poses) > 1)
        estimate = units.core_pose(pose_to_matrix(client.poses[1])) @ T_ROOM_CAMERA
        translation_mm, rotation_deg = se3.pose_error(estimate, pair.T_target_source, pair.source)
        assert translation_mm < 2.0 and rotation_deg < 3.0
    finally:
        client.close()
        code = node.stop()
    assert code == 0, node.log
