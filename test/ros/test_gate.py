"""Time: clouds from the future, stragglers, and time that starts over."""

from __future__ import annotations

import time
from types import SimpleNamespace

import numpy as np
import pytest
from builtin_interfaces.msg import Time as TimeMessage
from geometry_msgs.msg import TransformStamped
from harness import accepted, node_in_thread, pose_mm, wait_until
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.time import Time as RosTime
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Header

from gapr_core.geometry import se3
from gapr_core.results import RegistrationResult, RegistrationStatus
from gapr_ros.node import frames
from gapr_ros.node.gate import BACK_NS, Gate
from gapr_ros.node.outcome import Found, Job, Outcome, Reason, RefusedError, normal
from gapr_ros.parameters import NodeParameters

GOOD = np.random.default_rng(1).normal(size=(1000, 3)) * 0.02
NS = 1_000_000_000
MOVED = pose_mm([0, 0, 0], [50.0, 0, 0])

NEEDS_TF2 = "the real tf2 buffer comes with a ROS installation: apt install ros-jazzy-tf2-py"


def header_of(stamp_s, frame="probe"):
    return Header(frame_id=frame, stamp=RosTime(nanoseconds=int(stamp_s * NS)).to_msg())


def judged(gate, stamp_s, now_s=0.0, alone=False, **parameters):
    """True for time that starts over, False for a cloud of now, the reason for a refusal."""
    try:
        return gate.admit(header_of(stamp_s), int(now_s * NS), NodeParameters(**parameters), alone)
    except RefusedError as refusal:
        return refusal.reason


def test_a_cloud_from_the_future_is_refused_and_leaves_no_trace():
    gate = Gate()
    assert judged(gate, 9999.0, now_s=0.0) is False, "the clock does not run yet"
    gate.forget_time()
    assert judged(gate, 100.4, now_s=100.0) is False
    gate.forget_time()
    assert judged(gate, 100.0, now_s=100.0) is False
    assert judged(gate, 500.0, now_s=100.1) is Reason.FUTURE
    assert judged(gate, 100.2, now_s=100.2) is False


def test_a_cloud_is_too_old_beyond_the_limit_and_not_within_it():
    assert judged(Gate(), 99.1, now_s=100.0, max_cloud_age=1.0) is False
    assert judged(Gate(), 98.9, now_s=100.0, max_cloud_age=1.0) is Reason.STALE
    assert judged(Gate(), 1.0, now_s=100.0, max_cloud_age=0.0) is False, "0 is off"
    assert judged(Gate(), 0.0, now_s=100.0, max_cloud_age=1.0) is False, "it has no stamp"
    assert judged(Gate(), 1.0, now_s=0.0, max_cloud_age=1.0) is False, "the clock does not run yet"


def test_an_answer_that_came_too_late_is_refused():
    assert answered(Gate(), 99.5, now_s=100.0, max_cloud_age=1.0) is None
    assert answered(Gate(), 98.5, now_s=100.0, max_cloud_age=1.0).startswith("stale: the cloud is 1.5 s old")


def test_a_cloud_that_is_old_by_age_leaves_no_trace():
    gate = Gate()
    assert judged(gate, 100.0, now_s=100.0) is False
    for behind in range(5):
        assert judged(gate, 50.0 + behind, now_s=100.1, max_cloud_age=1.0) is Reason.STALE
    assert judged(gate, 100.1, now_s=100.1, max_cloud_age=1.0) is False


def test_one_straggler_is_refused_and_the_third_of_a_row_starts_time_over():
    gate = Gate()
    assert judged(gate, 100.0) is False
    assert judged(gate, 90.0) is Reason.STALE
    assert judged(gate, 100.1) is False, "the row is broken by a cloud of now"
    assert [judged(gate, s) for s in (90.0, 90.1, 90.2)] == [Reason.STALE, Reason.STALE, True]
    assert judged(gate, 90.3) is False
    assert judged(gate, 90.0) is False, "within a second"


def test_stragglers_whose_stamps_do_not_go_forward_never_start_time_over():
    gate = Gate()
    judged(gate, 100.0)
    assert {judged(gate, stamp_s) for stamp_s in (90.0, 89.0, 88.0, 87.0)} == {Reason.STALE}
    assert {judged(gate, 80.0) for _ in range(9)} == {Reason.STALE}


def test_small_steps_back_do_not_add_up():
    gate = Gate()
    judged(gate, 100.0)
    answers = [judged(gate, 100.0 - 0.6 * i) for i in range(4)]
    assert answers == [False, False, Reason.STALE, Reason.STALE]


def test_the_stamp_with_which_a_round_began_starts_time_over_where_one_publisher_sends():
    gate = Gate()
    played = [judged(gate, stamp_s, alone=True) for stamp_s in (100.0, 104.0, 108.0) * 3]
    assert played == [False, False, False, True, False, False, True, False, False]
    assert judged(gate, 104.0, alone=True) is Reason.STALE, "another stamp of the round"
    assert judged(gate, 90.0, alone=True) is Reason.STALE, "a stamp from before the round"
    assert judged(gate, 100.0, alone=False) is Reason.STALE, "of two publishers"
    assert judged(gate, 100.0, alone=True) is True


def test_a_cloud_that_comes_twice_at_the_start_of_a_round_does_not_start_time_over():
    gate = Gate()
    assert [judged(gate, stamp_s, alone=True) for stamp_s in (100.0, 104.0, 100.0)] == [False, False, Reason.STALE]


def test_a_bag_that_was_heard_from_its_middle_loses_two_clouds_once():
    gate = Gate()
    judged(gate, 108.0, alone=True)
    rounds = [judged(gate, stamp_s, alone=True) for stamp_s in (100.0, 104.0, 106.0, 108.0, 109.0) * 2]
    assert rounds == [Reason.STALE, Reason.STALE, True, False, False, True, False, False, False, False]


LAST = 2**31 - 1, 2**32 - 1


@pytest.mark.parametrize(("given", "expected"), [((5, 2000000003), (7, 3)), ((-1, 0), (0, 0)), (LAST, (0, 0))])
def test_the_stamp_of_a_refusal_is_normal(given, expected):
    stamp = normal(Header(stamp=TimeMessage(sec=given[0], nanosec=given[1]))).stamp
    assert (stamp.sec, stamp.nanosec) == expected


def answered(gate, stamp_s, x_m=0.0, frame="probe", now_s=0.0, **parameters):
    """The pose goes out: None; else the text of the refusal."""
    T = se3.from_rotation_translation(np.eye(3), [x_m, 0, 0])
    outcome = Outcome(Job(b"", gate.epoch, 0), frame, header_of(stamp_s, frame), result=accepted())
    outcome.found = Found(T, np.eye(6))
    gate.decide(outcome, GOOD, int(now_s * NS), NodeParameters(**parameters))
    return None if outcome.ok else f"{outcome.reason}: {outcome.text}"


def test_a_cloud_a_little_older_than_the_last_answer_is_refused_and_never_starts_time_over():
    gate = Gate()
    assert judged(gate, 100.0) is False and answered(gate, 100.0) is None
    with pytest.raises(RefusedError, match="0.4 s older than the last pose$"):
        gate.admit(header_of(99.6), 0, NodeParameters())
    assert judged(gate, 100.0) is False, "the same cloud once more"
    late = [judged(gate, 99.1 + 0.1 * i) for i in range(9)]
    assert late == [Reason.STALE] * 9, "a second camera, and a clock that was set back: until time has caught up"
    assert judged(gate, 100.05) is False and answered(gate, 100.05, 1.0) is None


def test_small_steps_back_break_the_row_of_those_that_start_time_over_no_more_than_they_are_one():
    gate = Gate()
    assert judged(gate, 100.0) is False and answered(gate, 100.0) is None
    assert [judged(gate, s) for s in (90.0, 90.1, 99.5, 90.2)] == [Reason.STALE] * 3 + [True]


def test_an_answer_behind_a_newer_one_is_refused_however_early_its_cloud_was_let_in():
    gate = Gate()
    assert judged(gate, 100.0) is False and judged(gate, 99.6) is False
    assert answered(gate, 100.0) is None
    assert answered(gate, 99.6).startswith("stale: the stamp is 0.4 s older than the last pose")


def test_one_stamp_has_one_pose():
    gate = Gate()
    assert answered(gate, 100.0) is None
    assert answered(gate, 100.0, 1e-6) is None, "the same but for rounding"
    assert answered(gate, 100.0, 1e-3).startswith("stale: another pose was sent for this stamp")
    assert "another pose was sent" in answered(gate, 100.0, frame="other")
    gate.forget_time()
    assert answered(gate, 100.0, 1e-3) is None
    assert [answered(Gate(), 0.0, x) for x in (0.0, 1.0)] == [None, None], "no stamp, no clock"


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 400), st.integers(0, 2)), min_size=1, max_size=30))
def test_poses_go_out_in_the_order_of_their_stamps_unless_time_starts_over(clouds):
    gate, last = Gate(), (0, 0)
    for tenths, x in clouds:
        answer = judged(gate, tenths / 10)
        last = (0, 0) if answer is True else last
        if isinstance(answer, bool) and answered(gate, tenths / 10, float(x)) is None:
            assert tenths > last[0] or (tenths, x) == last
            last = (tenths, x)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.integers(1, 40), min_size=1, max_size=30))
def test_stamps_never_go_back_more_than_a_second_unless_time_starts_over(stamps):
    gate, newest = Gate(), 0
    for stamp in stamps:
        answer = judged(gate, stamp)
        if answer is False:
            assert stamp * NS >= newest - BACK_NS
            newest = max(newest, stamp * NS)
        elif answer is True:
            newest = stamp * NS


class Model:
    """What a tf2 buffer does with what it is sent.

    From tf2's TimeCache: the latest transform is that with the newest stamp, whenever it was inserted; data older than
    the newest by more than the length of the cache (10 s) is ignored.
    """

    CACHE_S = 10.0

    def __init__(self):
        self.stored = {}

    def insert(self, transform):
        stamp_s = transform.header.stamp.sec + transform.header.stamp.nanosec * 1e-9
        if stamp_s >= max(self.stored, default=0.0) - self.CACHE_S:
            self.stored[stamp_s] = transform.transform.translation.x

    def latest(self):
        return self.stored[max(self.stored)]

    def at(self, stamp_s):
        return self.stored[stamp_s]

    def clear(self):
        self.stored.clear()


class Real:
    """The buffer of tf2 itself."""

    def __init__(self):
        self._buffer = pytest.importorskip("tf2_py", reason=NEEDS_TF2).BufferCore()

    def insert(self, transform):
        self._buffer.set_transform(transform, "register_node")

    def latest(self):
        return self.at(0.0)

    def at(self, stamp_s):
        found = self._buffer.lookup_transform_core("probe", "bone_preop", RosTime(nanoseconds=round(stamp_s * 1e9)))
        return found.transform.translation.x

    def clear(self):
        self._buffer.clear()


@pytest.fixture(params=[Model, Real])
def tf2(monkeypatch, request):
    """A buffer that gets what the node sends to /tf; `sent` are the stamps, s."""
    buffer, sent = request.param(), []

    class Broadcaster:
        def __init__(self, node):
            self.pub_tf = node.create_publisher(TransformStamped, "unused", 1)

        def sendTransform(self, transform):
            sent.append(transform.header.stamp.sec + transform.header.stamp.nanosec * 1e-9)
            buffer.insert(transform)

    buffer.sent = sent
    monkeypatch.setattr(frames, "_import_tf2", lambda: SimpleNamespace(TransformBroadcaster=Broadcaster))
    return buffer


def test_one_cloud_from_the_future_does_not_hold_back_what_tf2_says(blob_path, client, method, tf2):
    with node_in_thread(method, blob_path, publish_tf=True):
        client.wait_for_state("active")
        assert client.ask(GOOD)["level"] == 0
        method.answer = accepted(MOVED)
        refused = client.ask(GOOD, stamp_s=time.time() + 30.0)
        assert refused["last_refusal"].startswith("future: the stamp is") and "synchronise" in refused["last_refusal"]
        assert client.ask(GOOD)["level"] == 0
        wait_until(lambda: len(client.poses) == 2)
        assert tf2.latest() == pytest.approx(client.poses[-1].pose.pose.position.x) == pytest.approx(-0.05)


def test_a_straggler_changes_neither_the_jump_guard_nor_the_epoch_nor_tf(blob_path, client, method, tf2):
    with node_in_thread(method, blob_path, publish_tf=True, max_jump_translation=0.01) as node:
        client.wait_for_state("active")
        client.ask(GOOD, stamp_s=1000.0)
        epoch, calls = node.session.gate.epoch, len(method.calls)
        assert client.ask(GOOD, stamp_s=980.0)["last_refusal"].startswith("stale: the stamp is 20 s behind")
        assert (node.session.gate.epoch, len(method.calls), len(tf2.sent)) == (epoch, calls, 1)
        method.answer = accepted(MOVED)
        assert client.ask(GOOD, stamp_s=1000.5)["last_refusal"].startswith("jump"), "the guard still stands"


@pytest.mark.parametrize("publish_tf", [True, False])
def test_a_cloud_older_than_the_last_pose_gets_none_that_tf2_would_not_have(blob_path, client, method, tf2, publish_tf):
    with node_in_thread(method, blob_path, publish_tf=publish_tf):
        client.wait_for_state("active")
        for stamp_s in (998.8, 1000.0):
            assert client.ask(GOOD, stamp_s=stamp_s)["level"] == 0
        method.answer = accepted(MOVED)
        older = client.ask(GOOD, stamp_s=999.4)
        assert older["last_refusal"].startswith("stale: the stamp is 0.6 s older than the last pose")
        same = client.ask(GOOD, stamp_s=1000.0)
        assert same["last_refusal"].startswith("stale: another pose was sent for this stamp")
        method.answer = accepted()
        assert client.ask(GOOD, stamp_s=1000.0)["level"] == 0
        stamps = [pose.header.stamp.sec + pose.header.stamp.nanosec * 1e-9 for pose in client.poses]
        assert stamps == [998.8, 1000.0, 1000.0]
        assert tf2.sent == ([998.8, 1000.0] if publish_tf else [])


def test_an_older_cloud_that_was_let_in_before_the_newer_one_was_answered_gets_no_pose(blob_path, client, method, tf2):
    with node_in_thread(method, blob_path, publish_tf=True) as node:
        client.wait_for_state("active")
        method.gate.clear()
        calls = len(method.calls)
        client.send(GOOD, stamp_s=1000.0)
        wait_until(lambda: len(method.calls) > calls)
        client.send(GOOD, stamp_s=999.5)
        wait_until(lambda: node.counters.received == 2)
        method.gate.set()
        wait_until(lambda: node.counters.accepted + node.counters.refused == 2)
        assert "0.5 s older than the last pose" in node.counters.last_refusal
        assert tf2.sent == [1000.0]


def test_a_short_bag_that_is_looped_without_simulated_time_goes_on_and_tf2_never_mixes_its_rounds(
    blob_path, client, method, tf2
):
    with node_in_thread(method, blob_path, publish_tf=True):
        client.wait_for_state("active")
        stamps = [1000.0 + 0.25 * i for i in range(4)]
        for _ in range(3):
            assert [client.ask(GOOD, stamp_s=stamp_s)["level"] for stamp_s in stamps] == [0] * 4
            method.answer = accepted(MOVED)  # with an old transform of the same stamp, tf2 would give neither
        assert [pose.header.stamp.sec + pose.header.stamp.nanosec * 1e-9 for pose in client.poses] == stamps * 3
        assert tf2.sent == stamps and tf2.at(1000.25) == tf2.latest() == pytest.approx(0.0)
        conflicts = client.values("input")["conflicts"]
        assert "the stamps of the clouds went back: time starts over" in conflicts
        assert "/tf waits for stamps 10 s newer than those it had before" in conflicts and "--clock" in conflicts
        for stamp_s in (1001.0, 1010.75):
            assert client.ask(GOOD, stamp_s=stamp_s)["level"] == 0
            assert "/tf waits" in client.values("input")["conflicts"], "a buffer keeps what is just 10 s old"
        assert client.ask(GOOD, stamp_s=1011.0)["level"] == 0
        wait_until(lambda: tf2.sent == [*stamps, 1011.0] and "/tf" not in client.values("input")["conflicts"])


def test_a_round_without_a_pose_holds_nothing_back(blob_path, client, method, tf2):
    """Stamps of the first seconds, as a simulator has them: no buffer holds anything of the round before."""
    with node_in_thread(method, blob_path, publish_tf=True):
        client.wait_for_state("active")
        method.answer = RegistrationResult(RegistrationStatus.LOW_CONFIDENCE, reason="for the test")
        stamps = [2.0, 4.0, 6.0]
        assert [client.ask(GOOD, stamp_s=stamp_s)["level"] for stamp_s in stamps] == [1] * 3
        method.answer = accepted()
        assert [client.ask(GOOD, stamp_s=stamp_s)["level"] for stamp_s in stamps] == [0] * 3
        wait_until(lambda: tf2.sent == stamps, what=tf2.sent)


def test_clouds_without_stamp_and_clock_go_to_tf_like_their_poses(blob_path, client, method, tf2):
    with node_in_thread(method, blob_path, publish_tf=True, use_sim_time=True):
        client.wait_for_state("active")
        assert client.ask(GOOD, stamp_s=0.0)["level"] == 0
        method.answer = accepted(MOVED)
        assert client.ask(GOOD, stamp_s=0.0)["level"] == 0
        wait_until(lambda: tf2.sent == [0.0, 0.0], what=tf2.sent)
        assert tf2.latest() == pytest.approx(-0.05)


def test_a_straggler_does_not_push_a_good_cloud_out_of_the_mailbox(blob_path, client, method):
    with node_in_thread(method, blob_path, continuous=False) as node:
        client.wait_for_state("active")
        client.send(GOOD, stamp_s=1000.0)
        wait_until(lambda: node.counters.received == 1)
        client.ask(GOOD, stamp_s=900.0)
        answer = client.call("register")
        assert answer.success and node.counters.dropped == 0


def test_a_bag_that_is_looped_without_simulated_time_clears_the_track_and_goes_on(blob_path, client, method, tf2):
    with node_in_thread(method, blob_path, publish_tf=True, max_jump_translation=0.01) as node:
        client.wait_for_state("active")
        for stamp_s in (1000.0, 1001.0):
            assert client.ask(GOOD, stamp_s=stamp_s)["level"] == 0
        epoch = node.session.gate.epoch
        method.answer = accepted(MOVED)
        answers = [client.ask(GOOD, stamp_s=995.0 + i) for i in range(4)]
        assert [answer["level"] for answer in answers] == [1, 1, 0, 0]
        assert node.session.gate.epoch == epoch + 1
        assert tf2.sent == [1000.0, 1001.0], "a buffer would give poses between those of both rounds"
        assert client.call("reset").success
        wait_until(lambda: "/tf waits" not in client.values("input")["conflicts"])
        assert client.ask(GOOD, stamp_s=999.0)["level"] == 0
        wait_until(lambda: tf2.sent == [1000.0, 1001.0, 999.0], what=tf2.sent)


def test_stamps_of_before_go_to_tf_after_a_reset(blob_path, client, method, tf2):
    """Somebody plays a bag once more and calls ~/reset: /tf must not wait until the stamps are those of before."""
    with node_in_thread(method, blob_path, publish_tf=True):
        client.wait_for_state("active")
        assert client.ask(GOOD, stamp_s=1005.0)["level"] == 0
        assert client.call("reset").success
        method.answer = accepted(MOVED)
        assert client.ask(GOOD, stamp_s=1000.0)["level"] == 0
        wait_until(lambda: tf2.sent == [1005.0, 1000.0], what=tf2.sent)
        assert tf2.at(1000.0) == pytest.approx(-0.05)


def test_a_bag_that_is_looped_with_simulated_time_never_blinds_a_buffer(blob_path, client, method, tf2):
    """Far more than a buffer's 10 s back: buffers clear themselves with the clock, and the node starts over with it."""
    with node_in_thread(method, blob_path, publish_tf=True, use_sim_time=True) as node:
        client.wait_for_state("active")

        def at(seconds):
            now = Clock(clock=RosTime(nanoseconds=int(seconds * NS)).to_msg())

            def is_heard():
                client.clock.publish(now)  # best effort: the first one may come before the node hears it
                return node.now_ns() == int(seconds * NS)

            wait_until(is_heard, what="the clock")

        for second in (1000.0, 1030.0, 1060.0):
            at(second)
            assert client.ask(GOOD, stamp_s=second)["level"] == 0
        method.answer = accepted(MOVED)
        at(1000.5)
        tf2.clear()  # as tf2_ros does when its clock goes back
        assert client.ask(GOOD, stamp_s=1000.5)["level"] == 0, "the first cloud of the new round"
        wait_until(lambda: tf2.sent[-1] == 1000.5)
        assert tf2.latest() == tf2.at(1000.5) == pytest.approx(-0.05)
