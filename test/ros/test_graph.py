"""What is around the node: names, other publishers, other frames, other bones, quality of service."""

from __future__ import annotations

import time

import numpy as np
import pytest
from geometry_msgs.msg import PoseArray
from harness import LATCHED, Collecting, Spinner, context, node_in_thread, wait_until
from lifecycle_msgs.msg import Transition
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from gapr_core.errors import ConfigError
from gapr_ros.node import frames, subscription
from gapr_ros.node.report import Conflicts
from gapr_ros.parameters import NodeParameters

GOOD = np.random.default_rng(1).normal(size=(1000, 3)) * 0.02
UNNAMED = "_UNKNOWN_"  # a publisher whose node the graph does not know yet


def statuses(client):
    """Every status of the newest round of diagnostics, by its name."""
    return {entry.name: entry for array in client.diagnostics for entry in array.status}


def test_diagnostics_carry_the_full_name_and_the_model_as_hardware(blob_path, client, method):
    with node_in_thread(method, blob_path, namespace="/left"):
        wait_until(lambda: "/left/register_node: input" in statuses(client))
        assert "/left/register_node: registration" in statuses(client)
        assert {entry.hardware_id for entry in statuses(client).values()} == {"blob.npy"}


def test_a_second_publisher_is_named_until_it_goes(blob_path, client, method):
    with node_in_thread(method, blob_path):
        client.wait_for_state("active")
        second = client.node.create_publisher(PointCloud2, "points", 1)
        wait_until(lambda: "2 publishers on /points" in client.values("input")["message"])
        assert "(/client, /client)" in client.values("input")["message"]
        assert client.values("input")["level"] == 1
        client.forget(second)
        wait_until(lambda: "2 publishers" not in client.values("input")["conflicts"])


def test_who_publishes_is_no_conflict_of_a_node_that_does_not_listen(blob_path, client, method):
    with node_in_thread(method, blob_path):
        client.wait_for_state("active")
        second = client.node.create_publisher(PointCloud2, "points", 1)
        wait_until(lambda: "2 publishers on /points" in client.values("input")["conflicts"])
        assert client.change_state(Transition.TRANSITION_DEACTIVATE)
        wait_until(lambda: "2 publishers" not in client.values("input")["conflicts"])
        client.forget(second)


def test_a_publisher_of_another_type_is_named_until_it_goes(blob_path, client, method):
    """It counts as a publisher, and nothing of it ever comes."""
    with node_in_thread(method, blob_path):
        client.wait_for_state("active")
        apart = Spinner(context())  # one participant cannot have two types of a topic
        tracker = Node("tracker", context=apart.context)
        apart.start(tracker)
        poses = tracker.create_publisher(PoseArray, "points", 1)
        text = "a publisher of /points sends geometry_msgs/msg/PoseArray and no PointCloud2: nothing of it comes"
        wait_until(lambda: text in client.values("input")["message"])
        assert "2 publishers on" not in client.values("input")["message"], "of clouds there is one source"
        apart.do(lambda: tracker.destroy_publisher(poses))
        wait_until(lambda: text not in client.values("input")["conflicts"])
        apart.close()


def test_a_topic_on_which_nobody_publishes_is_named_once_until_somebody_does(
    blob_path, client, method, monkeypatch, capfd
):
    """As where it is misspelt: nothing else would say so in the log."""
    for name, seconds in (("SILENCE_S", 0.5), ("LOOK_S", 0.1)):
        monkeypatch.setattr(subscription, name, seconds)
    with node_in_thread(method, blob_path):
        client.wait_for_state("active")
        client.forget(client.points)
        text = "nobody publishes on /points: start the driver, or remap points"
        wait_until(lambda: text in client.values("input")["message"])
        assert client.values("input")["level"] == 1
        time.sleep(0.5)
        client.do(lambda: client.node.create_publisher(PointCloud2, "points", 1))
        wait_until(lambda: text not in client.values("input")["conflicts"])
    assert capfd.readouterr().err.count(text) == 1


def test_a_publisher_that_keeps_its_only_cloud_is_named_until_one_comes(blob_path, client, method, monkeypatch):
    """As one that loads a file: it published before the node listened, and seems to be silent."""
    for name, seconds in (("SILENCE_S", 0.5), ("LOOK_S", 0.1)):
        monkeypatch.setattr(subscription, name, seconds)
    client.forget(client.points)
    client.points = client.do(lambda: client.node.create_publisher(PointCloud2, "points", LATCHED))
    client.send(GOOD)
    with node_in_thread(method, blob_path):
        client.wait_for_state("active")
        text = "no cloud on /points for 0 s from /client: does the sensor run? The cloud that it keeps"
        wait_until(lambda: text in client.values("input")["conflicts"])
        client.ask(GOOD)
        wait_until(lambda: text not in client.values("input")["conflicts"])


def test_simulated_time_without_a_clock_is_a_conflict_until_the_clock_comes(blob_path, client, method):
    with node_in_thread(method, blob_path, use_sim_time=True) as node:
        client.wait_for_state("active")
        client.ask(GOOD)
        wait_until(lambda: "no /clock has come" in client.values("input")["message"])
        now = Clock(clock=node_time(1000))
        wait_until(lambda: client.clock.publish(now) or node.now_ns())
        client.ask(GOOD, stamp_s=1000.0)
        wait_until(lambda: "/clock" not in client.values("input")["conflicts"])


def test_two_clocks_that_differ_are_a_conflict_and_are_logged_once(blob_path, client, method, monkeypatch):
    with node_in_thread(method, blob_path, use_sim_time=True) as node:
        client.wait_for_state("active")
        said = []
        for logged_by, how in ((node.get_logger(), "warning"), (node.session.conflicts, "_write")):
            monkeypatch.setattr(logged_by, how, lambda text, **_: said.append(text), raising=False)
        other = client.do(lambda: client.node.create_publisher(Clock, "/clock", 10))
        wait_until(lambda: node.count_publishers("/clock") == 2)
        steps = iter(range(1000, 2000))

        def both(seconds):
            client.do(lambda: client.clock.publish(Clock(clock=node_time(seconds))))
            client.do(lambda: other.publish(Clock(clock=node_time(seconds - 5))))

        wait_until(lambda: both(next(steps)) or "/clock has 2 publishers (/client" in client.values("input")["message"])
        for _ in range(10):
            both(next(steps))
        assert sum("jumped back" in text and UNNAMED not in text for text in said) == 1
        client.do(lambda: client.node.destroy_publisher(other))


def node_time(seconds):
    return Time(nanoseconds=seconds * 1_000_000_000).to_msg()


def test_a_leading_slash_of_a_cloud_is_taken_away(blob_path, client, method):
    with node_in_thread(method, blob_path):
        client.wait_for_state("active")
        assert client.ask(GOOD, frame="/probe")["frame"] == "probe"
        wait_until(lambda: client.poses)
        assert client.poses[0].header.frame_id == "probe"


@pytest.mark.parametrize(
    ("given", "hint"),
    [
        ({"model_frame": ""}, "expected a model_frame"),
        ({"model_frame": "/bone"}, "write bone"),
        ({"output_frame": "/tracker"}, "write tracker"),
        ({"output_frame": "bone_preop"}, "for both"),
        ({"viewpoint": ""}, "expected a viewpoint; got an empty one"),
        ({"viewpoint": "bone_preop"}, "name another frame"),
        ({"crop_frame": "/bone_preop"}, "name another frame"),
    ],
)
def test_frames_that_tf2_would_not_take_fail_configure_with_what_to_write(given, hint):
    with pytest.raises(ConfigError, match=hint):
        frames.check_names(NodeParameters(**given))


def test_a_box_may_be_in_the_frame_of_the_bone_where_somebody_else_publishes_it():
    frames.check_names(NodeParameters(crop_frame="bone_preop", publish_tf=False))


def test_a_conflict_is_said_once_and_ends_with_its_time(monkeypatch):
    said, now = [], [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    conflicts = Conflicts(said.append)
    for _ in range(3):
        conflicts.note("frame", "two of them", 5.0)
        conflicts.note("publishers", "")
    assert said == ["two of them"] and conflicts.texts == ("two of them",)
    now[0] = 6.0
    assert conflicts.texts == ()
    conflicts.note("frame", "two of them", 5.0)
    assert len(said) == 2 and conflicts.texts == ("two of them",)
    conflicts.note("frame", "")
    assert conflicts.texts == ()
    conflicts.note("frame", "two of them")
    assert len(said) == 3


# --- quality of service ---


def test_a_best_effort_publisher_takes_nothing_from_a_reliable_one_and_is_forgotten_when_it_goes(
    blob_path, client, method, monkeypatch
):
    monkeypatch.setattr(subscription, "GRACE_S", 0.5)
    with node_in_thread(method, blob_path) as node:
        client.wait_for_state("active")
        assert client.values()["cloud_qos"] == "reliable"
        qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        weak = client.node.create_publisher(PointCloud2, "points", qos)
        wait_until(lambda: client.values()["cloud_qos"] == "reliable and best_effort")
        wait_until(weak.get_subscription_count)
        large = np.random.default_rng(0).normal(size=(200_000, 3)).astype(np.float32) * 0.02
        for _ in range(5):  # as best effort, most of such clouds are lost
            assert client.ask(large)["level"] == 0
        assert node.counters.received == 5, "what both subscriptions bring is one cloud"
        client.forget(weak)
        wait_until(lambda: client.values()["cloud_qos"] == "reliable")
        assert client.ask(GOOD)["level"] == 0 and node.counters.received == 6


def test_the_queue_is_as_long_as_the_collection(blob_path, client):
    with node_in_thread(Collecting(), blob_path, accumulate=30) as node:
        client.wait_for_state("active")
        for i in range(31):
            client.send(GOOD[:250] * (1.0 + 0.01 * i))
            if i == 0:
                wait_until(lambda: node.counters.received == 1)
                node.call_soon(lambda: time.sleep(1.0))
        wait_until(lambda: node.counters.received == 31, what="every slice that came while the executor was busy")
        assert node.counters.lost == 0
