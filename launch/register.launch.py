"""Starts register_node and, on request, RViz. Every parameter of the node is an argument.

ros2 launch gapr_ros register.launch.py model_path:=/path/to/bone.stl points:=/camera/points rviz:=true
"""
# ruff: noqa: I001  (this folder is not the package launch)

import json
import os
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import yaml
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.logging import get_logger
from launch.substitutions import PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from gapr_ros.parameters import FIELDS, check_launch_names

FILE = Path(__file__).resolve()
PATIENCE_S = "20"  # after Ctrl-C: the node ends with a second of work, which takes longer on a busy machine
ARGUMENTS = {
    "points": ("points", "topic of the clouds"),
    "initialpose": ("initialpose", "topic of poses to start from"),
    "namespace": ("", "of the node, its topics and its services"),
    "use_sim_time": ("", "true: node and RViz take time from /clock; RViz does not read params_file"),
    "params_file": ("", "parameter file; what is given here as an argument, and not empty, wins"),
    "rviz": ("false", "show clouds and bone"),
    "manager": ("false", "true: nav2's lifecycle manager configures and activates the node, with autostart:=false"),
}
# in every namespace, and in no other file: rcl joins entries of one name where the first one is, and the last one wins
ENTRY = "/**/register_node/**"
NOT_NEAR = "--show-args lists those that there are"


def given(context: LaunchContext) -> dict[str, Any]:
    """The parameters that the arguments name; the empty ones leave what the file says."""
    texts = {name: context.launch_configurations[name] for name in (*FIELDS, "use_sim_time")}
    return {name: _value(name, text) for name, text in texts.items() if text}


def _value(name: str, text: str) -> Any:
    """An argument as the parameter's type wants it: 1 is no double, 007 is a text where a text is wanted."""
    if name == "use_sim_time":
        value = yaml.safe_load(text)
        if not isinstance(value, bool):
            raise ValueError(f"use_sim_time must be true or false, got {text!r}")
        return value
    default = FIELDS[name].default
    if isinstance(default, str):
        return text
    try:
        value = yaml.safe_load(text)
        if isinstance(default, tuple):
            return [float(number) for number in value]
        is_whole = isinstance(value, bool | int) and not isinstance(default, float)
        return value if is_whole else float(value)  # YAML 1.1 reads 1e5 as text
    except (TypeError, ValueError, yaml.YAMLError):
        return text  # the node says what it wants instead


def _files(path: str, parameters: dict[str, Any]) -> list[str]:
    """The parameter file, and one with what the arguments say, which wins.

    The latter is written here, as JSON: every text is in quotes. launch leaves those out that YAML needs none for,
    and rcl takes 1e3, y or nan for a number or a boolean.
    """
    if not parameters:
        return [path]
    with NamedTemporaryFile("w", prefix="launch_params_", suffix=".yaml", delete=False, encoding="utf-8") as file:
        json.dump({ENTRY: {"ros__parameters": parameters}}, file, ensure_ascii=False)
    return [path, file.name]


def _shown(chosen: dict[str, str]) -> dict[str, str]:
    """Where the topics of register.rviz are, by their names there."""
    own = {f"register_node/{name}": f"register_node/{name}" for name in ("debug/aligned", "model", "pose")}
    return {"points": chosen["points"], "initialpose": chosen["initialpose"]} | own


def nodes(context: LaunchContext, share: FindPackageShare) -> list[Node]:
    """The node and RViz, once the arguments are known."""
    check_launch_names(context, FILE, (*ARGUMENTS, *FIELDS), NOT_NEAR, get_logger(FILE.name).warning)
    chosen = context.launch_configurations
    parameters = given(context) | ({"autostart": False} if chosen["manager"] == "true" else {})
    path = os.path.expanduser(chosen["params_file"])
    if not Path(path).is_file():  # launch only warns, and the node would run with other limits
        raise ValueError(f"params_file: expected a parameter file, got {chosen['params_file']!r}")
    register = Node(
        package="gapr_ros",
        executable="register_node",
        name="register_node",
        namespace=chosen["namespace"],
        output="screen",
        emulate_tty=True,
        sigterm_timeout=PATIENCE_S,
        parameters=_files(path, parameters),
        remappings=[("points", chosen["points"]), ("initialpose", chosen["initialpose"])],
    )
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        namespace=chosen["namespace"],
        remappings=[(f"/{name}", target) for name, target in _shown(chosen).items()],
        arguments=["-d", PathJoinSubstitution([share, "rviz", "register.rviz"])],
        parameters=[{"use_sim_time": parameters.get("use_sim_time", False)}],
        condition=IfCondition(chosen["rviz"]),
    )
    manager = Node(
        package="nav2_lifecycle_manager",
        executable="lifecycle_manager",
        name="lifecycle_manager_gapr",
        namespace=chosen["namespace"],
        parameters=[{"node_names": ["register_node"], "autostart": True, "bond_timeout": 0.0}],  # it has no bond
        condition=IfCondition(chosen["manager"]),
    )
    return [rviz, manager, register]  # RViz first: where it is not installed, launch stops before it has started a node


def generate_launch_description() -> LaunchDescription:
    share = FindPackageShare("gapr_ros")
    defaults = PathJoinSubstitution([share, "config", "register_node.yaml"])
    declared = [
        DeclareLaunchArgument(name, default_value=defaults if name == "params_file" else value, description=text)
        for name, (value, text) in ARGUMENTS.items()
    ]
    declared += [
        DeclareLaunchArgument(name, default_value="", description=f"{setting.metadata['text']}; empty: as in the file")
        for name, setting in FIELDS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=nodes, args=[share])])
