"""Starts one register_node for each bone of one parameter file, each in a namespace of its own.

ros2 launch gapr_ros bones.launch.py params_file:=/path/to/bones.yaml points:=/camera/points

The file names a node a bone, `/femur/register_node`, `/tibia/register_node`, ...; what stands under `/**` is for all.
`config/two_bones.yaml` is one to copy.
"""
# ruff: noqa: I001  (this folder is not the package launch)

from pathlib import Path
from typing import Any

import yaml
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch_ros.actions import Node

EXECUTABLE = "register_node"
ENDING = f"/{EXECUTABLE}"
PATIENCE_S = "20"  # after Ctrl-C: the node ends with a second of work, which takes longer on a busy machine
EXAMPLE = "copy share/gapr_ros/config/two_bones.yaml and pass params_file:=FILE"
ARGUMENTS = {
    "params_file": ("", "parameter file with one entry a bone; config/two_bones.yaml is one to copy"),
    "points": ("points", "topic of the clouds, the same for all bones"),
}


def bones(path: str) -> list[str]:
    """The namespaces that the file names, in its order.

    Raises:
        ValueError: there is no such file, it names none, or two bones publish one frame.
    """
    if not Path(path).is_file():
        raise ValueError(f"params_file: expected a parameter file with one entry a bone, got {path!r}; {EXAMPLE}")
    try:
        entries = yaml.safe_load(Path(path).read_text())
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise ValueError(f"{path}: not a parameter file: {error}; {EXAMPLE}") from error
    if not isinstance(entries, dict):
        raise ValueError(
            f"{path}: expected entries such as /femur/{EXECUTABLE}, got {type(entries).__name__}; {EXAMPLE}"
        )
    keys = [key for key in map(str, entries) if "*" not in key]  # what a pattern names is for all
    names = [key.rsplit("/", 1)[0] for key in keys if key.endswith(ENDING) and key != ENDING]
    if not names:
        raise ValueError(f"{path}: no entry such as /femur/{EXECUTABLE}, got {', '.join(map(str, entries))}; {EXAMPLE}")
    frames = [_parameters(entries[f"{name}/{EXECUTABLE}"]).get("model_frame") for name in names]
    if len(set(frames)) < len(frames):
        raise ValueError(f"{path}: every bone needs a model_frame of its own, got {frames}")
    return names


def _parameters(entry: Any) -> dict[str, Any]:
    """What stands under `ros__parameters`; empty without it."""
    found = entry.get("ros__parameters") if isinstance(entry, dict) else None
    return found if isinstance(found, dict) else {}


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
            sigterm_timeout=PATIENCE_S,
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
