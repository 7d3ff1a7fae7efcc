"""Sends /diagnostics: from the first moment on, in every state of the node, whatever its clock does."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile

from gapr_ros.node.diagnostics import CloudTopic, Snapshot, input_status, registration_status
from gapr_ros.node.guard import guarded
from gapr_ros.node.host import Host
from gapr_ros.node.loader import Loader
from gapr_ros.node.session import Session
from gapr_ros.node.subscription import Subscriptions


class Reported(Host, Protocol):
    """The node, as it is reported on.

    Attributes:
        failure: why the last transition failed; empty when it did not.
        session: what lives between configure and cleanup.
        subscriptions_in: what it listens with while it is active.
    """

    failure: str
    session: Session | None
    subscriptions_in: Subscriptions | None

    @property
    def state(self) -> str:
        """Of its lifecycle."""
        ...


class Reporter:
    """Sends what the node knows.

    Args:
        node: publishes.
        loader: reads bones.
    """

    def __init__(self, node: Reported, loader: Loader) -> None:
        self._node, self._loader = node, loader
        self._publisher = node.ros.create_publisher(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))

    def get_logger(self) -> object:
        """The node's logger (for `guarded`)."""
        return self._node.ros.get_logger()

    @guarded
    def send(self) -> None:
        """Two statuses: registration and input."""
        now = self._look()
        message = DiagnosticArray(status=[registration_status(now), input_status(now)])
        message.header.stamp = self._node.ros.get_clock().now().to_msg()
        self._publisher.publish(message)

    def _look(self) -> Snapshot:
        node, session, listening = self._node, self._node.session, self._node.subscriptions_in
        return Snapshot(
            name=node.ros.get_fully_qualified_name(),
            state=node.state,
            enabled=session is None or session.enabled,
            loading=str(self._loader),
            failure=node.failure,
            counters=node.counters,
            model=None if session is None else session.model,
            last=None if session is None else session.last_outcome,
            topic=CloudTopic() if listening is None else listening.describe(),
            listening=listening is not None,
            conflicts=() if session is None else session.conflicts.texts,
            hardware_id=self._hardware_id(),
            child_frame=node.parameters.model_frame if node.parameters.publish_tf else "",
            overdue_s=0.0 if session is None else self._overdue_s(session),
        )

    def _overdue_s(self, session: Session) -> float:
        busy_s, parameters = session.worker.busy_s, self._node.parameters
        return busy_s if busy_s > parameters.timeout + parameters.tf_timeout else 0.0

    def _hardware_id(self) -> str:
        """The bone in use, which is not the one that the parameters name before it is read, or when it cannot be."""
        session = self._node.session
        path = self._node.parameters.model_path if session is None else session.model.path
        return Path(path).name or "no model"
