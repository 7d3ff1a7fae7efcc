"""Every message that can bring a cloud is read in the same way."""

import numpy as np
import pytest
from geometry_msgs.msg import Point, Pose, PoseArray
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Header

from msg_adapters import INPUTS, xyz_to_cloud

XYZ = np.array([[1.0, 2.0, 3.0], [0.5, -1.0, 4.0]])
HEADER = Header(frame_id="tracker")


def pose_array(points):
    poses = [Pose(position=Point(x=x, y=y, z=z)) for x, y, z in np.asarray(points, dtype=float)]
    return PoseArray(header=HEADER, poses=poses)


MAKE = {"PointCloud2": lambda points: xyz_to_cloud(points, HEADER), "PoseArray": pose_array}


@pytest.mark.parametrize("name", INPUTS)
def test_an_input_gives_its_points_its_count_and_begins_with_its_header(name):
    message, data = MAKE[name](XYZ), serialize_message(MAKE[name](XYZ))
    assert isinstance(message, INPUTS[name].message)
    np.testing.assert_allclose(INPUTS[name].points(deserialize_message(data, INPUTS[name].message)), XYZ)
    assert INPUTS[name].count(message) == 2
    assert deserialize_message(data, Header).frame_id == "tracker"


@pytest.mark.parametrize("name", INPUTS)
def test_an_input_drops_what_is_not_finite_and_counts_it(name):
    message = MAKE[name]([[np.nan, 0.0, 0.0], *XYZ, [0.0, np.inf, 0.0]])
    np.testing.assert_allclose(INPUTS[name].points(message), XYZ)
    assert INPUTS[name].count(message) == 4


@pytest.mark.parametrize(("name", "kept"), [("PointCloud2", XYZ), ("PoseArray", np.vstack([np.zeros(3), XYZ]))])
def test_a_point_at_zero_is_nothing_seen_in_a_cloud_of_a_camera_alone(name, kept):
    message = MAKE[name](np.vstack([np.zeros(3), XYZ]))
    np.testing.assert_allclose(INPUTS[name].points(message), kept)
    assert INPUTS[name].count(message) == 3


@pytest.mark.parametrize("name", INPUTS)
def test_an_empty_input_has_no_points(name):
    message = INPUTS[name].message()
    assert INPUTS[name].points(message).shape == (0, 3) and INPUTS[name].count(message) == 0
