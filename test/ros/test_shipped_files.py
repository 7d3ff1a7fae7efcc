"""The RViz configuration speaks of the topics that the node has."""

from __future__ import annotations

from pathlib import Path

import yaml
from harness import node_in_thread, wait_until

from gapr_ros.node.publish import TOPICS

ROOT = Path(__file__).parents[2]


def topics_in(tree):
    """Every `Topic: {Value: ...}` of an RViz file."""
    if isinstance(tree, dict):
        if "Topic" in tree:
            yield tree["Topic"]["Value"]
        for value in tree.values():
            yield from topics_in(value)
    elif isinstance(tree, list):
        for value in tree:
            yield from topics_in(value)


def test_rviz_shows_topics_that_the_node_has(blob_path, method):
    shown = set(topics_in(yaml.safe_load((ROOT / "rviz" / "register.rviz").read_text())))
    with node_in_thread(method, blob_path) as node:
        wait_until(lambda: node.state == "active")
        sends = {name for name, _ in node.get_publisher_names_and_types_by_node("register_node", "/")}
        hears = {name for name, _ in node.get_subscriber_names_and_types_by_node("register_node", "/")}
    assert len(shown) >= 5
    assert shown <= sends | hears
    assert {"/points", "/initialpose"} <= hears
    own = {f"/register_node/{name}" for name in ("pose", *TOPICS)}
    assert own | {"/diagnostics"} <= sends
