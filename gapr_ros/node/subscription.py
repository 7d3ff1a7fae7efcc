"""The subscriptions: clouds serialised, newest first; reliable, and best effort too for publishers with only that."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy, qos_policy_name_from_kind
from sensor_msgs.msg import PointCloud2

from gapr_ros.node.host import Host, guarded, steady_timer
from gapr_ros.node.report import SILENCE_S, CloudTopic, names_of
from gapr_ros.node.session import Session

CLOUDS, INITIAL_POSES, CLOUD_TYPE = "points", "initialpose", "sensor_msgs/msg/PointCloud2"
LOOK_S = 1.0  # between two looks at who publishes
GRACE_S = 3.0  # the graph may know of a publisher later than the event of its QoS
MOST_QUEUED = 100  # clouds in the middleware's queue
REMEMBERED = 256  # clouds, to know the same one from the other subscription


class Subscriptions:
    """Listens to `points` and `initialpose` while the node is active.

    Clouds stay serialised until the worker takes one: a dropped cloud costs nothing, and damaged bytes cannot end the
    executor. Reliable publishers are heard by a reliable subscription, always. While there are publishers that offer
    best effort only, a second subscription hears them; what both bring is taken once.
    """

    def __init__(self, host: Host, session: Session) -> None:
        self._host, self._session = host, session
        self._mismatch, self._closed = "", False
        self._last_number: int | None = None
        self._taken: deque[tuple[int, int | None]] = deque(maxlen=REMEMBERED)
        self._needed_at, self._cloud_at = 0.0, time.monotonic()
        self._clouds, self._second = self._subscribe(ReliabilityPolicy.RELIABLE), None
        self._initial_poses = host.ros.create_subscription(
            PoseWithCovarianceStamped, INITIAL_POSES, self._on_initial_pose, 1
        )
        self._looking = steady_timer(host.ros, LOOK_S, self.look)

    def describe(self) -> CloudTopic:
        """Describe the subscriptions for /diagnostics."""
        publishers = self._host.ros.count_publishers(self._clouds.topic_name)
        mismatch = self._mismatch if publishers else ""
        return CloudTopic("reliable" if self._second is None else "reliable and best_effort", publishers, mismatch)

    def close(self) -> None:
        """Listen no more; who publishes is no conflict then."""
        self._closed = True
        for about in ("type", "publishers", "silence"):
            self._session.conflicts.note(about, "")
        self._host.ros.destroy_timer(self._looking)
        for subscription in (self._clouds, self._second, self._initial_poses):
            if subscription is not None:
                self._host.ros.destroy_subscription(subscription)

    def get_logger(self) -> Any:
        """Return the node's logger (for `guarded`)."""
        return self._host.ros.get_logger()

    @guarded
    def look(self) -> None:
        """See who publishes: how many, what, and whether somebody still needs best effort."""
        self._session.look_at_file()
        topic = self._clouds.topic_name
        publishers = self._host.ros.get_publishers_info_by_topic(topic)
        others = {p.topic_type for p in publishers} - {CLOUD_TYPE}
        text = f"a publisher of {topic} sends {', '.join(sorted(others))} and no PointCloud2: nothing of it comes"
        self._session.conflicts.note("type", text if others else "")
        publishers = [each for each in publishers if each.topic_type == CLOUD_TYPE]
        text = f"{len(publishers)} publishers on {topic} ({names_of(publishers)}): a node follows one source of clouds"
        self._session.conflicts.note("publishers", text if len(publishers) > 1 else "")
        self._note_silence(topic, publishers)
        if any(p.qos_profile.reliability is ReliabilityPolicy.BEST_EFFORT for p in publishers):
            self._needed_at = time.monotonic()
        elif time.monotonic() - self._needed_at > GRACE_S:
            self._mismatch = ""
            self._hear_reliable_only()

    def _note_silence(self, topic: str, publishers: list[Any]) -> None:
        """Say so where no cloud came for a while, and the most likely reason."""
        text = f"no cloud on {topic} for {SILENCE_S:.0f} s from {names_of(publishers)}: does the sensor run?"
        if not publishers:
            text = f"nobody publishes on {topic}: start the driver, or remap points (-r points:=TOPIC)"
        elif any(p.qos_profile.durability is DurabilityPolicy.TRANSIENT_LOCAL for p in publishers):
            text += " The cloud that it keeps for late listeners does not come here: publish it once more"
        is_long = time.monotonic() - self._cloud_at > SILENCE_S
        self._session.conflicts.note("silence", text if is_long else "")

    def _subscribe(self, reliability: ReliabilityPolicy) -> Any:
        depth = min(self._host.parameters.accumulate, MOST_QUEUED)  # every cloud counts where clouds are collected
        return self._host.ros.create_subscription(
            PointCloud2, CLOUDS, self._on_cloud,
            QoSProfile(depth=depth, reliability=reliability), raw=True,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=self._on_mismatch),
        )  # fmt: skip

    @guarded
    def _on_cloud(self, data: bytes, info: dict[str, Any]) -> None:
        self._cloud_at = time.monotonic()
        self._session.conflicts.note("silence", "")
        number = info["publication_sequence_number"]  # None where the middleware has none
        if self._is_taken((info["source_timestamp"], number)):
            return
        publishers = self._host.ros.count_publishers(self._clouds.topic_name)
        if number is not None and self._last_number is not None and publishers == 1:  # of several, no gap is a loss
            self._host.counters.count_lost(max(number - self._last_number - 1, 0))
        self._last_number = number
        self._session.take_cloud(data, alone=publishers == 1)

    def _is_taken(self, key: tuple[int, int | None]) -> bool:
        """Say if the other subscription brought this cloud already."""
        if self._second is None or not key[0]:
            return False
        if key in self._taken:
            return True
        self._taken.append(key)
        return False

    @guarded
    def _on_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        self._session.take_initial_pose(message)

    @guarded
    def _on_mismatch(self, event: Any) -> None:
        self._needed_at = time.monotonic()
        if event.last_policy_kind == QoSPolicyKind.RELIABILITY:
            self._host.call_soon(self._hear_best_effort)
            return
        kind = qos_policy_name_from_kind(event.last_policy_kind)
        topic = self._clouds.topic_name
        self._mismatch = f"a publisher of {topic} offers an incompatible {kind}: none of its clouds come"
        self.get_logger().error(self._mismatch)

    def _hear_best_effort(self) -> None:
        if self._closed or self._second is not None:
            return
        topic = self._clouds.topic_name
        text = f"a publisher of {topic} is best effort: it is heard as such; its clouds above 0.5 MB may be lost"
        self.get_logger().warning(f"{text}: let its publisher be reliable")
        self._second = self._subscribe(ReliabilityPolicy.BEST_EFFORT)

    def _hear_reliable_only(self) -> None:
        second, self._second = self._second, None
        if second is not None:
            self.get_logger().info(f"every publisher of {self._clouds.topic_name} is reliable again")
            self._host.ros.destroy_subscription(second)
