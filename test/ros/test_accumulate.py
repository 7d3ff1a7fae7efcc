"""Many small clouds that are registered together, by the node as users start it."""

from __future__ import annotations

import time

import bones
import numpy as np
from harness import PATIENCE_S, NodeProcess, pose_mm, wait_until

from gapr_core.geometry import se3
from gapr_ros.node import units
from msg_adapters import pose_to_matrix

KINDS = ("accepted", "refused", "dropped", "merged", "lost")


def stamp_of(pose):
    return f"{pose.header.stamp.sec}.{pose.header.stamp.nanosec:09d}"


def test_slices_of_a_probe_that_are_too_small_alone_give_the_pose_together(client, tmp_path):
    """As images of a tracked probe: 60 points each, in the frame of a reference on the bone."""
    bone = bones.bone()
    T = pose_mm([0.2, 0.5, -0.3], [10.0, 40.0, 20.0])
    cloud = bones.partial(bone, T, 31)
    order = np.argsort(se3.apply(T, cloud * 1000.0)[:, 2])
    slices = np.array_split(cloud[order], 50)
    node = NodeProcess(tmp_path, model_path=bones.save(bone, tmp_path / "bone.npz"), model_unit="mm", accumulate=50)
    try:
        client.wait_for_state("active")
        before = client.ask(slices[0])
        assert before["level"] >= 1
        for points in slices[1:]:
            client.send(points)
            time.sleep(0.02)
        wait_until(lambda: sum(int(client.values()[f"frames_{kind}"]) for kind in KINDS) == 50, PATIENCE_S)
        wait_until(lambda: client.poses and stamp_of(client.poses[-1]) == client.values()["cloud_stamp"])
        estimate = units.core_pose(pose_to_matrix(client.poses[-1]))
        translation_mm, rotation_deg = se3.pose_error(estimate, T, cloud * 1000.0)
        assert translation_mm < 1.0 and rotation_deg < 1.0
        assert int(client.values()["points_used"]) == len(cloud)
    finally:
        assert node.stop() == 0, node.log
    assert "Traceback" not in node.log, node.log
