"""What a part of the node may ask of the node: six members, and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from rclpy.lifecycle import LifecycleNode

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
