"""Starts one register_node for each bone of one parameter file, each in a namespace of its own.

ros2 launch gapr_ros bones.launch.py params_file:=/path/to/bones.yaml points:=/camera/points

The file names a node a bone, `/femur/register_node`, `/tibia/register_node`, ...; what stands under `/**` is for all.
`config/two_bones.yaml` is one to copy.
"""
# ruff: noqa: I001  (this folder is not the package launch)

from pathlib import Path

import yaml
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch_ros.actions import Node

EXECUTABLE = "register_node"
ARGUMENTS = {
    "params_file": ("", "parameter file with one entry a bone"),
    "points": ("points", "topic of the clouds, the same for all bones"),
}


def bones(path: str) -> list[str]:
    """The namespaces that the file names, in its order.

    Raises:
        ValueError: it names none, or two bones publish one frame.
    """
    entries = yaml.safe_load(Path(path).read_text())
    names = [key.rsplit("/", 1)[0] for key in entries if key.endswith(f"/{EXECUTABLE}") and key != f"/{EXECUTABLE}"]
    if not names:
        raise ValueError(f"{path}: no entry such as /femur/{EXECUTABLE}, got {', '.join(entries)}")
    frames = [entries[f"{name}/{EXECUTABLE}"]["ros__parameters"].get("model_frame") for name in names]
    if len(set(frames)) < len(frames):
        raise ValueError(f"{path}: every bone needs a model_frame of its own, got {frames}")
    return names


def nodes(context: LaunchContext) -> list[Node]:
    """One node a bone."""
    chosen = context.launch_configurations
    return [
        Node(
            package="gapr_ros",
            executable=EXECUTABLE,
            name=EXECUTABLE,
            namespace=namespace,
            output="screen",
            emulate_tty=True,
            parameters=[chosen["params_file"]],
            remappings=[("points", chosen["points"])],
        )
        for namespace in bones(chosen["params_file"])
    ]


def generate_launch_description() -> LaunchDescription:
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=text) for name, (value, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=nodes)])
