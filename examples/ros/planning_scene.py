"""The registered bone as an obstacle of MoveIt: its mesh in the planning scene, moved with every trusted pose.

python examples/ros/planning_scene.py femur.stl --ros-args -p min_confidence:=0.9 -p max_tre:=0.002

Where register_node has `model_unit`, `model_scale`, `model_axes` or `model_label`, give the same here: the pose is that
of the bone as the node reads it, and in other axes the obstacle would lie on the other side of the patient.

Needs a ROS installation with moveit_msgs. A refusal leaves the obstacle where it was last: a robot that moves near a
bone whose pose is no longer known should stop, which is for `hold` to do.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import Point, Pose, TransformStamped
from rclpy.executors import ExternalShutdownException
from rclpy.signals import uninstall_signal_handlers
from rclpy.utilities import remove_ros_args
from shape_msgs.msg import Mesh, MeshTriangle
from trusted_pose import TrustedPose, parser

from gapr_ros.node.model import surface_of
from gapr_ros.parameters import NodeParameters

MM_PER_M = 1000.0
MOST_TRIANGLES = 20_000
NAMES = ("model_unit", "model_scale", "model_axes", "model_label")
AS_THE_NODE = {name: getattr(NodeParameters(), name) for name in NAMES}  # the values that it has by itself


class BoneInScene(TrustedPose):
    """Sends the bone to /planning_scene.

    Args:
        path: file of the bone.
        types: the module `moveit_msgs.msg`.
        kwargs: of rclpy's Node.
    """

    def __init__(self, path: str | Path, types: Any, **kwargs: object) -> None:
        super().__init__(**kwargs)
        how = {name: self.declare_parameter(name, value).value for name, value in AS_THE_NODE.items()}
        self._types, self._mesh = types, mesh_of(NodeParameters(model_path=str(path), **how))
        self._scene = self.create_publisher(types.PlanningScene, "/planning_scene", 1)

    def act(self, transform: TransformStamped, values: dict[str, str]) -> None:
        """Put the bone where it is now."""
        scene = self._types.PlanningScene(is_diff=True)
        scene.world.collision_objects = [obstacle(self._types, self._mesh, transform)]
        self._scene.publish(scene)


def mesh_of(bone: NodeParameters) -> Mesh:
    """The triangles of the bone that parameters of register_node name, metres.

    Raises:
        GaprError: the file cannot be read.
        ValueError: it has no triangles, or more than a planner handles.
    """
    surface = surface_of(bone)
    if surface.faces is None or not 0 < len(surface.faces) <= MOST_TRIANGLES:
        count = 0 if surface.faces is None else len(surface.faces)
        raise ValueError(f"expected a mesh of at most {MOST_TRIANGLES} triangles, got {count}: decimate it")
    vertices = [Point(x=x, y=y, z=z) for x, y, z in (surface.points / MM_PER_M).tolist()]
    triangles = [MeshTriangle(vertex_indices=face.astype(np.uint32)) for face in surface.faces]
    return Mesh(vertices=vertices, triangles=triangles)


def obstacle(types: Any, mesh: Mesh, transform: TransformStamped) -> Any:
    """The moveit_msgs/CollisionObject of a mesh at a pose; the same id moves the one that is there."""
    moved, pose = transform.transform, Pose()
    pose.position.x, pose.position.y, pose.position.z = moved.translation.x, moved.translation.y, moved.translation.z
    pose.orientation = moved.rotation
    made = types.CollisionObject(header=transform.header, id=transform.child_frame_id, operation=b"\x00")  # ADD
    made.pose, made.meshes, made.mesh_poses = pose, [mesh], [Pose()]
    return made


def main() -> None:
    """Run until it is stopped."""
    arguments = parser(__doc__)
    arguments.add_argument("bone", type=Path, help="its mesh")
    given = arguments.parse_args(remove_ros_args(sys.argv)[1:])
    import moveit_msgs.msg

    rclpy.init(args=sys.argv)
    node = None
    try:
        node = BoneInScene(given.bone, moveit_msgs.msg)
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    uninstall_signal_handlers()  # ends rclpy's thread for signals first: it shuts down too, and twice is an error
    if node is not None:
        node.destroy_node()  # not at the interpreter's end, in any order
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
