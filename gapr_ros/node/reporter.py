"""Sends /diagnostics: from the first moment on, in every state of the node, whatever its clock does."""

from __future__ import annotations

from typing import TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile

from gapr_ros.diagnostics import Input, input_status, registration_status
from gapr_ros.guard import guarded

if TYPE_CHECKING:
    from gapr_ros.register_node import RegisterNode


class Reporter:
    """Collects what the node knows and sends it."""

    def __init__(self, node: RegisterNode) -> None:
        self._node = node
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))

    def get_logger(self) -> object:
        """The node's logger (for `guarded`)."""
        return self._node.get_logger()

    @guarded
    def send(self) -> None:
        """Two statuses: registration and input."""
        node, name = self._node, self._node.get_name()
        source = None if node.subscriptions_in is None else node.subscriptions_in.describe()
        model = None if node.session is None else node.session.model
        last = None if node.session is None else node.session.last_outcome
        message = DiagnosticArray()
        message.header.stamp = node.get_clock().now().to_msg()
        message.status = [
            registration_status(name, node.state, node.failure, model, node.counters, last, source or Input()),
            input_status(name, node.counters, source, last),
        ]
        self._publisher.publish(message)
