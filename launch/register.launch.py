"""Starts register_node and, on request, RViz.

ros2 launch gapr_ros register.launch.py model_path:=/path/to/bone.stl points:=/camera/points rviz:=true
"""
# ruff: noqa: I001  (this folder is not the package launch)

from typing import Any

import yaml
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

ARGUMENTS = {
    "model_path": ("", "file of the pre-operative bone"),
    "model_unit": ("", "mm, m, or auto: guess and warn"),
    "points": ("points", "topic of the clouds"),
    "initialpose": ("initialpose", "topic of optional seeds"),
    "output_frame": ("", "frame of the poses; empty: that of the clouds"),
    "use_sim_time": ("", "true: node and RViz take time from /clock; RViz does not read params_file"),
    "params_file": ("", "parameter file; what is given here as an argument, and not empty, wins"),
    "rviz": ("false", "show clouds and bone"),
}
TEXTS = ("model_path", "model_unit", "output_frame")


def given(context: LaunchContext) -> dict[str, Any]:
    """The parameters that the arguments name; the empty ones leave what the file says."""
    values = {name: context.launch_configurations[name] for name in (*TEXTS, "use_sim_time")}
    chosen: dict[str, Any] = {name: text for name, text in values.items() if text}
    if "use_sim_time" in chosen:
        chosen["use_sim_time"] = yaml.safe_load(chosen["use_sim_time"])
        if not isinstance(chosen["use_sim_time"], bool):
            raise ValueError(f"use_sim_time must be true or false, got {values['use_sim_time']!r}")
    return chosen


def nodes(context: LaunchContext, share: FindPackageShare) -> list[Node]:
    """The node and RViz, once the arguments are known."""
    parameters = given(context)
    chosen = context.launch_configurations
    register = Node(
        package="gapr_ros",
        executable="register_node",
        name="register_node",
        output="screen",
        emulate_tty=True,
        parameters=[chosen["params_file"], parameters],
        remappings=[("points", chosen["points"]), ("initialpose", chosen["initialpose"])],
    )
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", PathJoinSubstitution([share, "rviz", "register.rviz"])],
        parameters=[{"use_sim_time": parameters.get("use_sim_time", False)}],
        condition=IfCondition(chosen["rviz"]),
    )
    return [register, rviz]


def generate_launch_description() -> LaunchDescription:
    share = FindPackageShare("gapr_ros")
    defaults = PathJoinSubstitution([share, "config", "register_node.yaml"])
    declared = [
        DeclareLaunchArgument(name, default_value=defaults if name == "params_file" else value, description=text)
        for name, (value, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=nodes, args=[share])])
