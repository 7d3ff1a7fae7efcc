"""What a part of the node may ask of the node: six members, and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.timer import Timer

from gapr_ros.node.diagnostics import Counters
from gapr_ros.parameters import NodeParameters


class Host(Protocol):
    """The node, as its parts see it.

    Attributes:
        parameters: as they are now.
        counters: what became of every cloud.
    """

    parameters: NodeParameters
    counters: Counters

    @property
    def ros(self) -> LifecycleNode:
        """To advertise, subscribe and log with."""
        ...

    def now_ns(self) -> int:
        """The node's time, ns; 0 while simulated time has not started."""
        ...

    def call_soon(self, call: Callable[[], None]) -> None:
        """Run in the executor's thread; from any thread."""
        ...

    def report(self) -> None:
        """Send the diagnostics now; in the executor's thread."""
        ...


def steady_timer(node: Node, period_s: float, call: Callable[[], Any]) -> Timer:
    """A timer that does not stop with simulated time."""
    return node.create_timer(period_s, call, clock=Clock(clock_type=ClockType.STEADY_TIME))
