"""Clouds that come as another message than a PointCloud2."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Point, Pose, PoseArray
from harness import node_in_thread, wait_until
from std_msgs.msg import Header


def test_points_of_a_digitiser_come_as_a_pose_array(client, method, blob_path):
    points_m = np.random.default_rng(0).normal(size=(300, 3)) * [0.06, 0.02, 0.015]
    poses = [Pose(position=Point(x=x, y=y, z=z)) for x, y, z in points_m]
    with node_in_thread(method, blob_path, namespace="digitiser", cloud_type="PoseArray"):
        publisher = client.do(lambda: client.node.create_publisher(PoseArray, "/digitiser/points", 10))
        wait_until(publisher.get_subscription_count, what="the subscription")
        publisher.publish(PoseArray(header=Header(frame_id="tracker"), poses=poses))
        wait_until(lambda: len(method.calls[-1]["source"]) == 300, what="the registration")
    np.testing.assert_allclose(method.calls[-1]["source"], 1000.0 * points_m, atol=1e-9)
