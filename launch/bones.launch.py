"""Starts one register_node for each bone of one parameter file, each in a namespace of its own.

ros2 launch gapr_ros bones.launch.py params_file:=/path/to/bones.yaml points:=/camera/points

The file names a node a bone, `/femur/register_node`, `/tibia/register_node`, ...; what stands under `/**` is for all.
`config/two_bones.yaml` is one to copy.
"""
# ruff: noqa: I001  (this folder is not the package launch)

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.logging import get_logger
from launch_ros.actions import Node

from gapr_ros.parameters import check_launch_names

FILE = Path(__file__).resolve()
EXECUTABLE = "register_node"
ENDING = f"/{EXECUTABLE}"
PARAMETERS = "ros__parameters"
PATIENCE_S = "20"  # after Ctrl-C: the node ends with a second of work, which takes longer on a busy machine
EXAMPLE = "copy share/gapr_ros/config/two_bones.yaml and pass params_file:=FILE"
ARGUMENTS = {
    "params_file": ("", "parameter file with one entry a bone; config/two_bones.yaml is one to copy"),
    "points": ("points", "topic of the clouds, the same for all bones"),
}
NOT_NEAR = "parameters of a node belong in params_file"


def bones(path: str) -> list[str]:
    """The namespaces that the file names, in its order.

    Raises:
        ValueError: there is no such file, it names none, it names what is no bone, or two bones publish one frame.
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
    found: dict[str, dict[str, Any]] = {}
    for name, parameters in (node for key, entry in entries.items() for node in _nodes_of(key, entry)):
        if "*" not in name:  # what a pattern names is for all
            found.setdefault(name, {}).update(parameters)
    names = [name for name in found if name.endswith(ENDING) and name != ENDING]
    wrong = [name for name in found if name not in names]
    if not names:
        raise ValueError(f"{path}: no entry such as /femur/{EXECUTABLE}, got {', '.join(map(str, entries))}; {EXAMPLE}")
    if wrong:
        expected = f"expected entries such as /femur/{EXECUTABLE}, and patterns such as /** for all"
        raise ValueError(f"{path}: {', '.join(wrong)} would start no node: {expected}")
    frames = [found[name].get("model_frame") for name in names]
    if len(set(frames)) < len(frames):
        raise ValueError(f"{path}: every bone needs a model_frame of its own, got {frames}")
    return [name.removesuffix(ENDING) for name in names]


def _nodes_of(key: Any, entry: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    """The nodes that an entry names, with their parameters: as rcl does, keys above `ros__parameters` are joined."""
    name = "/" + str(key).strip("/")
    inner = entry if isinstance(entry, dict) else {}
    deeper = {part: value for part, value in inner.items() if part != PARAMETERS and isinstance(value, dict)}
    if PARAMETERS in inner or not deeper:
        given = inner.get(PARAMETERS)
        yield name, given if isinstance(given, dict) else {}
    for part, value in deeper.items():
        yield from _nodes_of(f"{name}/{part}", value)


def nodes(context: LaunchContext) -> list[Node]:
    """One node a bone."""
    check_launch_names(context, FILE, ARGUMENTS, NOT_NEAR, get_logger(FILE.name).warning)
    chosen = context.launch_configurations
    path = os.path.expanduser(chosen["params_file"])
    return [
        Node(
            package="gapr_ros",
            executable=EXECUTABLE,
            name=EXECUTABLE,
            namespace=namespace,
            output="screen",
            emulate_tty=True,
            sigterm_timeout=PATIENCE_S,
            parameters=[path],
            remappings=[("points", chosen["points"])],
        )
        for namespace in bones(path)
    ]


def generate_launch_description() -> LaunchDescription:
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=text) for name, (value, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=nodes)])
