"""Finds others that publish on this node's own topics: two nodes of one name, whose poses look like those of one."""

from __future__ import annotations

from typing import Any

from gapr_ros.node.conflicts import Conflicts, names_of
from gapr_ros.node.guard import guarded
from gapr_ros.node.host import Host, steady_timer

KIND = "own topics"
TOPICS = ("~/pose", "~/status")
LOOK_S = 1.0
LOOKS = 2  # in a row with another publisher: one that was just given back may still be in the graph


class SharedName:
    """Looks now and then who publishes on the topics of the node: the node itself has one publisher on each.

    Args:
        host: the node.
        conflicts: where a finding goes.
    """

    def __init__(self, host: Host, conflicts: Conflicts) -> None:
        self._host, self._conflicts = host, conflicts
        self._topics = [host.ros.resolve_topic_name(name) for name in TOPICS]
        self._seen = 0
        self._looking = steady_timer(host.ros, LOOK_S, self.look)

    def get_logger(self) -> Any:
        """The node's logger (for `guarded`)."""
        return self._host.ros.get_logger()

    def close(self) -> None:
        """Look no more."""
        self._host.ros.destroy_timer(self._looking)

    @guarded
    def look(self) -> None:
        """Report the topics that have a second publisher, as long as they have it."""
        text = next(filter(None, map(self._second, self._topics)), "")
        self._seen = self._seen + 1 if text else 0
        if not text or self._seen >= LOOKS:
            self._conflicts.note(KIND, text)

    def _second(self, topic: str) -> str:
        """Who else publishes on a topic; empty for nobody."""
        if self._host.ros.count_publishers(topic) <= 1:
            return ""
        found = self._host.ros.get_publishers_info_by_topic(topic)
        text = f"{len(found)} publishers on {topic} ({names_of(found)}): its poses may be those of another bone"
        return f"{text}; give each node a name or a namespace of its own"
