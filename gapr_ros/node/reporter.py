"""Sends /diagnostics: from the first moment on, in every state of the node, whatever its clock does."""

from __future__ import annotations

from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import QoSProfile

from gapr_ros.node.diagnostics import Snapshot, input_status, registration_status
from gapr_ros.node.guard import guarded


class Reporter:
    """Sends what the node knows.

    Args:
        node: publishes.
        look: what is known now.
    """

    def __init__(self, node: Node, look: Callable[[], Snapshot]) -> None:
        self._node, self._look = node, look
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))

    def get_logger(self) -> object:
        """The node's logger (for `guarded`)."""
        return self._node.get_logger()

    @guarded
    def send(self) -> None:
        """Two statuses: registration and input."""
        now = self._look()
        message = DiagnosticArray(status=[registration_status(now), input_status(now)])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)
