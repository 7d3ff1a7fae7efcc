"""Puts the bone into MoveIt's planning scene as an obstacle, wherever ~/detection says that it is.

python examples/ros/planning_scene.py femur.stl --units mm --ros-args -p topic:=/register_node/detection

Needs a ROS installation with moveit_msgs and vision_msgs. Give `--axes` as model_axes of the node, or the obstacle lies
on the other side of the patient. A refusal leaves the obstacle where it was last: `hold` is the place to stop a robot.
"""

import argparse
import sys
from contextlib import suppress

import numpy as np
import rclpy
from geometry_msgs.msg import Point, Pose
from rclpy.utilities import remove_ros_args
from shape_msgs.msg import Mesh, MeshTriangle
from std_msgs.msg import Header
from trusted_pose import TrustedPose

from gapr_core import ReadOptions, load

MM_PER_M = 1000.0
MOST_TRIANGLES = 20_000


class BoneInScene(TrustedPose):
    """Sends the bone to /planning_scene. `types`: the module `moveit_msgs.msg`."""

    def __init__(self, mesh, types, **kwargs):
        super().__init__(**kwargs)
        self.mesh, self.types = mesh, types
        self.scene = self.create_publisher(types.PlanningScene, "/planning_scene", 1)

    def act(self, bone, frame, pose, covariance):
        add = b"\x00"  # the same id moves the obstacle that is there
        it = self.types.CollisionObject(header=Header(frame_id=frame), id=bone, operation=add)
        it.pose, it.meshes, it.mesh_poses = pose, [self.mesh], [Pose()]
        scene = self.types.PlanningScene(is_diff=True)
        scene.world.collision_objects = [it]
        self.scene.publish(scene)


def mesh_of(path, units="auto", axes="as_is"):
    """The triangles of a bone, metres. Raises ValueError where there are none, or more than a planner handles."""
    surface = load(path, units=units, options=ReadOptions(axes=axes))
    count = 0 if surface.faces is None else len(surface.faces)
    if not 0 < count <= MOST_TRIANGLES:
        raise ValueError(f"expected a mesh of at most {MOST_TRIANGLES} triangles, got {count}: decimate it")
    vertices = [Point(x=x, y=y, z=z) for x, y, z in (surface.points / MM_PER_M).tolist()]
    return Mesh(vertices=vertices, triangles=[MeshTriangle(vertex_indices=f.astype(np.uint32)) for f in surface.faces])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bone", help="its mesh")
    parser.add_argument("--units", default="auto")
    parser.add_argument("--axes", default="as_is")
    given = parser.parse_args(remove_ros_args(sys.argv)[1:])
    import moveit_msgs.msg

    rclpy.init()
    with suppress(KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        rclpy.spin(BoneInScene(mesh_of(given.bone, given.units, given.axes), moveit_msgs.msg))
