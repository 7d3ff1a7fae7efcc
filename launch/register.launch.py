"""Starts register_node and, on request, RViz.

ros2 launch gapr_ros register.launch.py model_path:=/path/to/bone.stl points:=/camera/points rviz:=true
"""
# ruff: noqa: I001  (this folder is not the package launch)

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

ARGUMENTS = {
    "model_path": ("", "file of the pre-operative bone"),
    "model_unit": ("auto", "mm, m, or auto: guess and warn"),
    "points": ("points", "topic of the clouds"),
    "initialpose": ("initialpose", "topic of optional seeds"),
    "output_frame": ("", "frame of the poses; empty: that of the clouds"),
    "use_sim_time": ("false", "take time from /clock"),
    "params_file": ("", "parameter file; what is given here as an argument wins"),
    "rviz": ("false", "show clouds and bone"),
}
TEXTS = ("model_path", "model_unit", "output_frame")


def generate_launch_description() -> LaunchDescription:
    share = FindPackageShare("gapr_ros")
    chosen = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    defaults = PathJoinSubstitution([share, "config", "register_node.yaml"])
    declared = [
        DeclareLaunchArgument(name, default_value=defaults if name == "params_file" else value, description=text)
        for name, (value, text) in ARGUMENTS.items()
    ]
    node = Node(
        package="gapr_ros",
        executable="register_node",
        name="register_node",
        output="screen",
        emulate_tty=True,
        parameters=[
            chosen["params_file"],
            {name: ParameterValue(chosen[name], value_type=str) for name in TEXTS},
            {"use_sim_time": ParameterValue(chosen["use_sim_time"], value_type=bool)},
        ],
        remappings=[("points", chosen["points"]), ("initialpose", chosen["initialpose"])],
    )
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", PathJoinSubstitution([share, "rviz", "register.rviz"])],
        parameters=[{"use_sim_time": ParameterValue(chosen["use_sim_time"], value_type=bool)}],
        condition=IfCondition(chosen["rviz"]),
    )
    return LaunchDescription([*declared, node, rviz])
