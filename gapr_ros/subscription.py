"""The subscriptions: clouds serialised, newest only, reliable first and best effort when nothing else is offered."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import QoSPolicyKind, QoSProfile, ReliabilityPolicy, qos_policy_name_from_kind
from sensor_msgs.msg import PointCloud2

from gapr_ros.diagnostics import Gaps, Input
from gapr_ros.guard import guarded
from gapr_ros.session import Session

if TYPE_CHECKING:
    from gapr_ros.register_node import RegisterNode

CLOUDS, SEEDS = "points", "initialpose"


class Subscriptions:
    """Listens to `points` and `initialpose` while the node is active.

    Clouds stay serialised until the worker takes one: a dropped cloud costs nothing, and damaged bytes cannot end the
    executor.
    """

    def __init__(self, node: RegisterNode, session: Session) -> None:
        self._node, self._session = node, session
        self._auto = node.parameters.cloud_reliability == "auto"
        self._best_effort = node.parameters.cloud_reliability == "best_effort"
        self._mismatch, self._closed, self._gaps = "", False, Gaps()
        self._clouds = self._subscribe()
        self._seeds = node.create_subscription(PoseWithCovarianceStamped, SEEDS, self._on_seed, 1)

    def describe(self) -> Input:
        """For /diagnostics."""
        publishers = self._node.count_publishers(self._clouds.topic_name)
        mismatch = self._mismatch if publishers else ""
        return Input("best_effort" if self._best_effort else "reliable", publishers, mismatch)

    def close(self) -> None:
        """Listen no more."""
        self._closed = True
        self._node.destroy_subscription(self._clouds)
        self._node.destroy_subscription(self._seeds)

    def get_logger(self) -> Any:
        """The node's logger (for `guarded`)."""
        return self._node.get_logger()

    def _subscribe(self) -> Any:
        reliability = ReliabilityPolicy.BEST_EFFORT if self._best_effort else ReliabilityPolicy.RELIABLE
        return self._node.create_subscription(
            PointCloud2, CLOUDS, self._on_cloud, QoSProfile(depth=1, reliability=reliability), raw=True,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=self._on_mismatch),
        )  # fmt: skip

    @guarded
    def _on_cloud(self, data: bytes, info: dict[str, Any]) -> None:
        number = info["publication_sequence_number"]  # None where the middleware has none
        if number is not None:
            self._node.counters.lost += self._gaps.note(number)
        self._session.take_cloud(data)

    @guarded
    def _on_seed(self, message: PoseWithCovarianceStamped) -> None:
        self._session.take_seed(message)

    @guarded
    def _on_mismatch(self, event: Any) -> None:
        if self._auto and not self._best_effort and event.last_policy_kind == QoSPolicyKind.RELIABILITY:
            self._best_effort = True
            self._node.call_soon(self._fall_back)
            return
        kind = qos_policy_name_from_kind(event.last_policy_kind)
        topic = self._clouds.topic_name
        self._mismatch = f"a publisher of {topic} offers an incompatible {kind}: none of its clouds come"
        self.get_logger().error(self._mismatch)

    def _fall_back(self) -> None:
        if self._closed:
            return
        topic = self._clouds.topic_name
        self.get_logger().warning(f"a publisher of {topic} is best effort: so are we; clouds above 0.5 MB may be lost")
        self._node.destroy_subscription(self._clouds)
        self._clouds = self._subscribe()
