"""Real bags, written and replayed over DDS."""

from __future__ import annotations

import signal
import time

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from harness import DOMAIN, NodeProcess, Spinner, context, wait_until
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from gapr_ros.bags import replay as bag_replay
from gapr_ros.bags.files import BagError, open_bag
from gapr_ros.bags.replay import Replay, ReplayOptions
from gapr_ros.bags.writing import STORAGES, BagWriter, offered, type_name
from msg_adapters import cloud_to_xyz

START_NS = 1_700_000_000_250_000_000
WAIT_S = 60.0  # for listeners; DDS takes seconds to find them now and then


@pytest.fixture(scope="module")
def bag_path(request, tmp_path_factory):
    """Ten clouds in 0.45 s, the i-th with i + 1 points, and two transforms."""
    storage = getattr(request, "param", "mcap")
    path = tmp_path_factory.mktemp("bags") / storage
    with BagWriter(path, storage) as bag:
        for i in range(10):
            bag.write_cloud("/points", np.full((i + 1, 3), 0.1 * i), "probe", START_NS + 50_000_000 * i)
            if i % 5 == 0:
                bag.write("/pose_of_tool", TransformStamped(child_frame_id=f"tool{i}"), START_NS + 50_000_000 * i)
    return path


@pytest.fixture
def listener():
    spinner = Spinner(context())
    node = Node("listener", context=spinner.context)
    node.heard = {"clouds": [], "transforms": [], "clocks": [], "times": []}

    def on_cloud(message):
        node.heard["clouds"].append(message)
        node.heard["times"].append(time.monotonic())

    node.create_subscription(PointCloud2, "/points", on_cloud, 100)
    node.create_subscription(TransformStamped, "/pose_of_tool", node.heard["transforms"].append, 100)
    node.create_subscription(Clock, "/clock", lambda m: node.heard["clocks"].append(m.clock), 1000)
    spinner.start(node)
    yield node
    spinner.close()


def play(path, on_message=None, topics=(), **options):
    ros = context()
    node = Node("player", context=ros)
    bag = open_bag(path, topics)
    replay = Replay(node, bag, ReplayOptions(progress=False, wait_s=WAIT_S, topics=topics, **options), on_message)
    try:
        return replay.run()
    finally:
        bag.reader.close()
        ros.try_shutdown()


@pytest.mark.parametrize("bag_path", ["mcap", "sqlite3"], indirect=True)
def test_a_replayed_bag_arrives_whole_in_order_and_at_its_pace(bag_path, listener):
    assert play(bag_path) == 12
    heard = listener.heard
    wait_until(lambda: len(heard["clouds"]) == 10 and len(heard["transforms"]) == 2)
    assert [m.width for m in heard["clouds"]] == list(range(1, 11))
    np.testing.assert_allclose(cloud_to_xyz(heard["clouds"][3]), np.full((4, 3), 0.3), atol=1e-7)
    assert heard["clouds"][0].header.stamp.sec == 1_700_000_000
    assert heard["clouds"][0].header.stamp.nanosec == 250_000_000
    assert [m.child_frame_id for m in heard["transforms"]] == ["tool0", "tool5"]
    assert at_its_pace(bag_path, 0.45)


def at_its_pace(bag_path, seconds, **options):
    """A busy machine delays a message now and then, the first or the last: one play at the right pace counts."""
    for _ in range(20):
        sent = []
        play(bag_path, on_message=lambda *_, sent=sent: sent.append(time.monotonic()), topics=["/points"], **options)
        if 0.95 * seconds < sent[-1] - sent[0] < 1.3 * seconds:
            return True
    return False


def test_rate_topics_and_clock_are_obeyed(bag_path, listener):
    sent, start = [], time.monotonic()

    def on_message(topic, stamp_ns):
        sent.append((topic, time.monotonic()))

    assert play(bag_path, on_message=on_message, topics=["/points"], rate=2.0, clock_hz=100.0) == 10
    assert sent[0][1] - start < WAIT_S, "it did not wait in vain for somebody to listen"
    assert time.monotonic() - sent[-1][1] < bag_replay.DRAIN_S, "all was acknowledged before the player gave up waiting"
    wait_until(lambda: len(listener.heard["clouds"]) == 10 and len(listener.heard["clocks"]) >= 20)
    assert not listener.heard["transforms"]
    assert at_its_pace(bag_path, 0.225, rate=2.0)
    clocks = [m.sec + m.nanosec * 1e-9 for m in listener.heard["clocks"]]
    assert clocks == sorted(clocks)
    assert clocks[0] == pytest.approx(START_NS / 1e9, abs=0.1)
    assert [topic for topic, _ in sent] == ["/points"] * 10


def test_a_looped_bag_starts_over_until_it_is_interrupted(bag_path, listener, tmp_path):
    player = NodeProcess(tmp_path, str(bag_path), "--loop", "--rate", "4", "--clock", module="gapr_ros.bags.replay")
    wait_until(lambda: len(listener.heard["clouds"]) > 25, 60.0, player.log)
    assert player.stop() == 0, player.log
    clocks = [m.sec + m.nanosec * 1e-9 for m in listener.heard["clocks"]]
    assert min(np.diff(clocks)) < -0.3, "time goes back when the bag starts over"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_replay_that_waits_for_listeners_ends_without_a_traceback(tmp_path, number):
    with BagWriter(tmp_path / "bag") as bag:
        bag.write_cloud("/to_nobody", np.ones((1, 3)), "probe", START_NS)
    ros = context()
    node = Node("onlooker", context=ros)
    player = NodeProcess(tmp_path, str(tmp_path / "bag"), "--wait", "600", module="gapr_ros.bags.replay")
    try:
        wait_until(lambda: node.count_publishers("/to_nobody"), WAIT_S, lambda: player.log)
        assert player.stop(number) == 0, player.log
    finally:
        player.kill()
        ros.try_shutdown()
    assert "Traceback" not in player.log


def test_topics_that_nobody_hears_are_named(tmp_path, capfd):
    with BagWriter(tmp_path / "bag") as bag:
        bag.write_cloud("/to_nobody", np.ones((1, 3)), "probe", START_NS)
    ros, opened = context(), open_bag(tmp_path / "bag")
    assert Replay(Node("player", context=ros), opened, ReplayOptions(wait_s=0.1)).run() == 1
    opened.reader.close()
    ros.try_shutdown()
    assert "/to_nobody: fewer than 1 listeners after 0.1 s; it is played now" in capfd.readouterr().err


@pytest.mark.parametrize("reliable", [True, False])
def test_the_recorded_qos_is_offered(reliable, tmp_path, listener):
    with BagWriter(tmp_path / "bag", qos=offered(reliable=reliable, latched=True, depth=3)) as bag:
        bag.write_cloud("/qos", np.ones((1, 3)), "probe", START_NS)
    ros = context()
    node = Node("player", context=ros)
    opened = open_bag(tmp_path / "bag")
    Replay(node, opened, ReplayOptions())
    info = wait_until(lambda: listener.get_publishers_info_by_topic("/qos"))[0].qos_profile
    assert info.reliability is (ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT)
    assert info.durability is DurabilityPolicy.TRANSIENT_LOCAL
    opened.reader.close()
    ros.try_shutdown()


RECORDED = {
    "reliable, best effort": [offered(depth=5), offered(reliable=False, depth=5)],
    "best effort, reliable": [offered(reliable=False, depth=5), offered(depth=5)],
    "best effort, not known": [offered(reliable=False), None],
    "latched, volatile": [offered(latched=True, depth=1), offered(depth=1)],
    "latched twice": [offered(latched=True, depth=1), offered(reliable=False, latched=True, depth=1)],
}


def of_two_connections(path, storage, profiles, kinds=(PointCloud2, PointCloud2)):
    """A bag with two clouds, each of a connection of its own on one topic; an empty message of another type."""
    with Writer(path, version=9, storage_plugin=STORAGES[storage]) as bag:
        for number, (profile, kind) in enumerate(zip(profiles, kinds, strict=True)):
            message, types = kind(), get_typestore(Stores.ROS2_JAZZY)
            message.header.frame_id = str(number)
            given = {"typestore": types, "offered_qos_profiles": [profile] if profile else []}
            connection = bag.add_connection("/points", type_name(message), **given)
            bag.write(connection, START_NS + number, serialize_message(message))
    return path


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("case", ["reliable, best effort", "best effort, reliable", "best effort, not known"])
def test_two_recorded_publishers_of_one_topic_are_played_by_one_that_a_reliable_listener_hears(
    tmp_path, listener, storage, case
):
    assert play(of_two_connections(tmp_path / "bag", storage, RECORDED[case])) == 2
    wait_until(lambda: [m.header.frame_id for m in listener.heard["clouds"]] == ["0", "1"], WAIT_S)


@pytest.mark.parametrize("case", ["latched, volatile", "latched twice"])
def test_who_comes_late_hears_as_much_of_one_publisher_as_of_the_recorded_ones(tmp_path, case):
    ros, opened = context(), open_bag(of_two_connections(tmp_path / "bag", "mcap", RECORDED[case]))
    node = Node("player", context=ros)
    replay = Replay(node, opened, ReplayOptions(wait_s=0.0, progress=False))
    assert node.count_publishers("/points") == 1
    assert replay.run() == 2
    late, heard = Spinner(context()), []
    latecomer = Node("latecomer", context=late.context)
    latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    latecomer.create_subscription(PointCloud2, "/points", lambda m: heard.append(m.header.frame_id), latched)
    late.start(latecomer)
    wait_until(lambda: heard == ["0", "1"], WAIT_S)
    late.close()
    opened.reader.close()
    ros.try_shutdown()


def test_two_types_on_one_topic_are_refused(tmp_path):
    bag = of_two_connections(tmp_path / "bag", "mcap", [None, None], (PointCloud2, TransformStamped))
    kinds = "sensor_msgs/msg/PointCloud2 and geometry_msgs/msg/TransformStamped"
    with pytest.raises(BagError, match=f"/points has messages of {kinds}"):
        play(bag)


def test_a_type_that_is_not_installed_is_left_out_and_said(bag_path, tmp_path, capfd):
    with BagWriter(tmp_path / "bag") as bag:
        bag.write_cloud("/points", np.ones((1, 3)), "probe", START_NS)
        kind = "tf2_msgs/msg/TFMessage"
        bag.write_raw("/tf", kind, b"\x00\x01\x00\x00\x00\x00\x00\x00", START_NS)
    opened = open_bag(tmp_path / "bag")
    try:
        import tf2_msgs  # noqa: F401
    except ImportError:
        assert "tf2_msgs/msg/TFMessage" in opened.skipped["/tf"]
        assert [c.topic for c in opened.connections] == ["/points"]
    else:
        assert not opened.skipped
    opened.reader.close()


def test_a_bag_that_cannot_be_played_is_one_clear_line(tmp_path, bag_path, capsys):
    (tmp_path / "text.mcap").write_text("this is no bag")
    (tmp_path / "text.db3").write_text("this is no bag either")
    (tmp_path / "empty").mkdir()
    (tmp_path / "yaml").mkdir()
    (tmp_path / "yaml" / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 5}")
    with BagWriter(tmp_path / "nothing"):
        pass
    bad = [["absent"], ["text.mcap"], ["text.db3"], ["empty"], ["yaml"], ["nothing"]]
    for name, *arguments in [*bad, [str(bag_path), "--topics", "/other"]]:
        assert bag_replay.main([str(tmp_path / name), *arguments]) == 1
        error = capsys.readouterr().err
        assert error.startswith("bag_replay: ") and error.count("\n") == 1 and "Traceback" not in error, error
    assert "/points" in error, "an unknown topic is answered with the known ones"


def test_a_bag_may_be_named_by_its_metadata(bag_path, monkeypatch):
    monkeypatch.chdir(bag_path)
    for path in (bag_path / "metadata.yaml", "metadata.yaml"):
        opened = open_bag(path)
        assert opened.count == 12
        opened.reader.close()


@pytest.mark.parametrize("rate", ["0", "-1", "nan", "inf"])
def test_a_rate_that_is_not_positive_is_refused(rate, bag_path):
    with pytest.raises(SystemExit):
        bag_replay.parse_arguments([str(bag_path), "--rate", rate])


def test_an_existing_folder_is_not_overwritten_and_storages_are_named(tmp_path):
    with pytest.raises(Exception, match="exists"), BagWriter(tmp_path):
        pass
    with pytest.raises(ValueError, match="mcap, sqlite3"):
        BagWriter(tmp_path / "bag", "bag")
    assert QoSProfile(depth=1) and 1 <= DOMAIN <= 101
