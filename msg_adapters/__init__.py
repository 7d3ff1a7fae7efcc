"""ROS messages to numpy arrays and back: clouds and poses; no policy, no units, no frames of its own."""

from msg_adapters import point_cloud, pose_array
from msg_adapters.errors import InvalidMessageError
from msg_adapters.inputs import Input
from msg_adapters.point_cloud import cloud_to_field, cloud_to_grid, cloud_to_xyz, xyz_to_cloud
from msg_adapters.pose import (
    covariance_to_list,
    list_to_covariance,
    matrix_to_pose,
    matrix_to_transform,
    pose_to_matrix,
    transform_to_matrix,
)

INPUTS: dict[str, Input] = {
    "PointCloud2": point_cloud.INPUT,
    "PoseArray": pose_array.INPUT,
}  # by the name that the parameter `cloud_type` of the node takes

__all__ = [
    "INPUTS",
    "Input",
    "InvalidMessageError",
    "cloud_to_field",
    "cloud_to_grid",
    "cloud_to_xyz",
    "covariance_to_list",
    "list_to_covariance",
    "matrix_to_pose",
    "matrix_to_transform",
    "pose_to_matrix",
    "transform_to_matrix",
    "xyz_to_cloud",
]
