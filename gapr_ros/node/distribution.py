"""Which distributions of ROS 2 the node works with."""

from __future__ import annotations

from collections.abc import Mapping

WORKS = ("jazzy", "kilted", "rolling")


def problem(environment: Mapping[str, str]) -> str:
    """Why the sourced distribution cannot be used; empty when it can, or when none is sourced (the wheels).

    Older ones lack what the node needs of rclpy: callbacks after parameters have changed, numbers of publications, and
    events of a subscription under their present names. `kilted` and `rolling` have them all; tested is `jazzy`.
    """
    name = environment.get("ROS_DISTRO", "")
    if not name or name in WORKS:
        return ""
    return f"expected a sourced ROS 2 {' or '.join(WORKS)}, got {name}: source another one, or none and use the wheels"
