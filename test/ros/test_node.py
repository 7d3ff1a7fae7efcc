"""The node with a registration method of the tests' own: topics, services, lifecycle, QoS, time."""

from __future__ import annotations

import itertools
import re
import threading
import time
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
from builtin_interfaces.msg import Time as TimeMessage
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from harness import NODE, Client, Collecting, accepted, node_in_thread, pose_mm, wait_until
from lifecycle_msgs.msg import Transition
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger

from gapr_core import Accumulator
from gapr_core.geometry import se3
from gapr_core.results import RegistrationResult, RegistrationStatus
from gapr_ros.node import diagnostics, frames
from gapr_ros.node.collection import MOST_LATE, Late
from gapr_ros.node.refusal import Reason, RefusedError
from gapr_ros.node.session import OUTLIVED_AFTER
from gapr_ros.node.worker import Job
from msg_adapters import cloud_to_xyz, list_to_covariance, pose_to_matrix, transform_to_matrix, xyz_to_cloud

GOOD = np.random.default_rng(1).normal(size=(1000, 3)) * 0.02
T_TARGET_SOURCE = pose_mm([0.3, -1.1, 0.7], [120.0, -40.0, 300.0])
REGISTRATION_KEYS = set(
    "state model_path model_points cloud_stamp cloud_frame points_in points_used cloud_age_s confidence tre_mm"
    " inlier_ratio found_by seen_from exec_ms frames_received frames_dropped frames_refused consecutive_refusals"
    " last_refusal"
    " cloud_qos publishers_on_points".split()
)


@pytest.fixture
def live(blob_path, client, method):
    with node_in_thread(method, blob_path) as node:
        client.wait_for_state("active")
        yield node, client, method


def test_an_accepted_cloud_gives_the_inverse_pose_in_metres_with_its_stamp_and_frame(live):
    node, client, method = live
    method.answer = accepted(T_TARGET_SOURCE)
    client.send(GOOD, frame="probe", stamp_s=1234.5)
    wait_until(lambda: client.poses and client.transforms and client.confidences)
    pose, transform = client.poses[0], client.transforms[0]
    expected = se3.inverse(T_TARGET_SOURCE)
    expected[:3, 3] /= 1000.0
    np.testing.assert_allclose(pose_to_matrix(pose), expected, atol=1e-12)
    np.testing.assert_allclose(transform_to_matrix(transform), expected, atol=1e-12)
    assert pose.header == transform.header == Header(frame_id="probe", stamp=TimeMessage(sec=1234, nanosec=500_000_000))
    assert transform.child_frame_id == "bone_preop"
    assert client.confidences == [0.9]
    covariance = list_to_covariance(pose.pose.covariance)
    np.linalg.cholesky(covariance)
    assert 1e-4 < np.sqrt(covariance[0, 0]) < 1e-2
    np.testing.assert_allclose(method.calls[-1]["source"], GOOD * 1000.0, atol=1e-3)


def test_the_model_is_latched_in_metres_and_the_aligned_bone_is_sent_when_somebody_listens(live):
    node, client, method = live
    wait_until(lambda: client.models)
    model = client.models[0]
    assert model.header.frame_id == "bone_preop"
    bone_mm = method.calls[0]["target"].points
    np.testing.assert_allclose(cloud_to_xyz(model) * 1000.0, bone_mm, atol=1e-4)

    aligned = []
    client.node.create_subscription(PointCloud2, "/register_node/aligned", aligned.append, 1)
    wait_until(node.session._publishers._topics["aligned"].get_subscription_count)
    wait_until(lambda: client.node.count_publishers("/register_node/aligned"))
    method.answer = accepted(T_TARGET_SOURCE)
    client.ask(GOOD)
    wait_until(lambda: aligned)
    assert aligned[0].header.frame_id == "probe"
    np.testing.assert_allclose(
        cloud_to_xyz(aligned[0]) * 1000.0, se3.apply(se3.inverse(T_TARGET_SOURCE), bone_mm), atol=1e-3
    )


def test_a_late_listener_gets_the_last_pose(live):
    node, client, method = live
    client.ask(GOOD)
    late = Client()
    wait_until(lambda: late.poses and late.models)
    late.close()


@pytest.mark.parametrize("service", ["reset", "reload_model"])
def test_a_late_listener_does_not_get_a_pose_from_before_a_reset_or_of_another_bone(live, service):
    node, client, method = live
    client.ask(GOOD)
    wait_until(lambda: client.poses)
    assert client.call(service).success
    late = Client()
    wait_until(lambda: late.models and late.node.count_publishers("/register_node/pose"))
    time.sleep(0.5)
    assert not late.poses
    client.poses.clear()
    client.ask(GOOD)
    wait_until(lambda: late.poses and client.poses, what="the new pose, by old and new listeners")
    late.close()


def latched_for_a_late_listener():
    """How many poses and bones come without a cloud, while both topics are advertised."""
    late = Client()
    wait_until(lambda: all(late.node.count_publishers(f"/register_node/{name}") for name in ("pose", "model")))
    time.sleep(0.5)
    counts = len(late.poses), len(late.models)
    late.close()
    return counts


def test_a_late_listener_gets_nothing_from_an_inactive_node_and_no_pose_of_before_when_it_is_active_again(live):
    node, client, method = live
    client.ask(GOOD)
    assert latched_for_a_late_listener() == (1, 1)
    assert client.change_state(Transition.TRANSITION_DEACTIVATE)
    assert latched_for_a_late_listener() == (0, 0)
    assert client.change_state(Transition.TRANSITION_ACTIVATE)
    client.wait_for_state("active")
    assert latched_for_a_late_listener() == (0, 1)
    heard = len(client.poses), len(client.models)
    assert client.ask(GOOD)["level"] == 0
    wait_until(lambda: (len(client.poses), len(client.models)) == (heard[0] + 1, heard[1]), what="an earlier listener")


def test_a_late_listener_does_not_get_a_pose_that_many_refusals_have_outlived(live):
    node, client, method = live
    client.ask(GOOD)
    method.answer = RegistrationResult(RegistrationStatus.LOW_CONFIDENCE, reason="for the test")
    for _ in range(OUTLIVED_AFTER - 1):
        client.ask(GOOD)
    assert latched_for_a_late_listener() == (1, 1)
    client.ask(GOOD)
    assert latched_for_a_late_listener() == (0, 1)
    method.answer = accepted()
    client.ask(GOOD)
    wait_until(lambda: len(client.poses) == 2, what="an earlier listener")
    assert latched_for_a_late_listener() == (1, 1)


def test_a_disabled_node_keeps_its_last_pose_for_late_listeners(live):
    node, client, method = live
    client.ask(GOOD)
    assert client.call("set_enabled", SetBool.Request(data=False)).success
    late = Client()
    wait_until(lambda: late.poses)
    late.close()


def test_diagnostics_come_as_often_as_asked_for_while_running(live):
    node, client, method = live
    wait_until(lambda: len(client.diagnostics) > 3)
    assert node.set_parameters([Parameter("diagnostics_period", value=30.0)])[0].successful

    def is_quiet():
        count = len(client.diagnostics)
        time.sleep(1.0)  # ten of the periods before
        return len(client.diagnostics) == count

    wait_until(is_quiet, what="a second without diagnostics, after those that were on their way")
    count = len(client.diagnostics)
    assert node.set_parameters([Parameter("diagnostics_period", value=0.05)])[0].successful
    wait_until(lambda: len(client.diagnostics) > count + 3)


def test_diagnostics_have_every_key_and_come_when_idle(live):
    node, client, method = live
    client.ask(GOOD)
    assert REGISTRATION_KEYS <= set(client.values())
    count = len(client.diagnostics)
    wait_until(lambda: len(client.diagnostics) >= count + 2)
    wait_until(lambda: client.values("input")["message"].startswith("no cloud for"))
    assert client.values("input")["level"] == 1


@pytest.mark.parametrize(
    ("qos", "received", "may_be_lost"),
    [
        ("best_effort", 0, True),
        ("reliable and best_effort", 0, True),
        ("reliable", 0, False),
        ("best_effort", 3, True),
        ("reliable", 3, False),
    ],
)
def test_where_clouds_of_a_best_effort_publisher_do_not_come_they_may_be_too_large(qos, received, may_be_lost):
    """Whatever came before: clouds may have grown since."""
    now_s = time.monotonic()
    for lost_s, text in ((60.0, "no cloud for 9 s"), (1.0, "2 clouds were sent and never came: crop or thin clouds")):
        counters = SimpleNamespace(received=received, lost=2, last_cloud_at=now_s - 9.0, last_lost_at=now_s - lost_s)
        now = SimpleNamespace(counters=counters, topic=diagnostics.CloudTopic(qos, 1), listening=True, last=None,
                              conflicts=(), name="node", hardware_id="")  # fmt: skip
        said = diagnostics.input_status(now).message
        assert said.startswith(text) and said.endswith(diagnostics.LARGE) == may_be_lost


def test_the_newest_cloud_wins_and_every_other_is_counted(live):
    node, client, method = live
    client.ask(GOOD)
    method.gate.clear()
    for i in range(10):
        client.send(np.full((300, 3), 0.01) + GOOD[:300] * (i + 1))
        wait_until(lambda i=i: node.counters.received == i + 2)
    method.gate.set()
    wait_until(lambda: int(client.values()["frames_accepted"]) == 3)
    values = client.values()
    assert (values["frames_received"], values["frames_dropped"], values["frames_lost"]) == ("11", "8", "0")
    np.testing.assert_allclose(method.calls[-1]["source"], (0.01 + GOOD[:300] * 10) * 1000.0, atol=1e-3)


def test_clouds_that_are_accumulated_are_merged_into_the_newest_and_counted(blob_path, client):
    method = Collecting()
    with node_in_thread(method, blob_path, accumulate=4) as node:
        client.wait_for_state("active")
        assert client.ask(GOOD[:150])["last_refusal"].startswith("too_few_points: 150 usable points, min_points is 200")
        method.gate.clear()
        client.send(GOOD[:300])
        wait_until(lambda: len(method.calls) == 2 and node.counters.received == 2)
        for i in range(6):
            client.send(GOOD[:100] * (i + 1) if i != 4 else np.full((100, 3), np.nan))
            wait_until(lambda i=i: node.counters.received == i + 3)
        method.gate.set()
        wait_until(lambda: int(client.values()["frames_accepted"]) == 2)
        wait_until(lambda: int(client.values()["frames_merged"]) == 4)
        values, kept = client.values(), list(method.kept)
    counts = {key: int(values[f"frames_{key}"]) for key in ("received", "accepted", "refused", "merged", "dropped")}
    assert counts == {"received": 8, "accepted": 2, "refused": 1, "merged": 4, "dropped": 1}
    assert [len(source) for source in kept] == [150, 300, 100, 100, 100, 100, 100]
    np.testing.assert_allclose(kept[-2], GOOD[:100] * 4 * 1000.0, atol=1e-3)
    np.testing.assert_allclose(kept[-1], GOOD[:100] * 6 * 1000.0, atol=1e-3)
    assert int(values["points_used"]) == 700, "distinct ones: the clouds share some"


def test_clouds_from_before_a_reset_are_not_merged(blob_path, client):
    method = Collecting()
    with node_in_thread(method, blob_path, accumulate=4, continuous=False) as node:
        client.wait_for_state("active")
        for i in range(3):
            client.send(GOOD * (i + 1))
            wait_until(lambda i=i: node.counters.received == i + 1)
        wait_until(lambda: len(method.kept) == 2, what="those that were pushed out")
        assert client.call("reset").success
        client.send(GOOD * 9)
        wait_until(lambda: node.counters.received == 4)
        assert client.call("register").success
        np.testing.assert_allclose(method.kept, [GOOD * 9 * 1000.0], atol=1e-3)


def test_a_pause_keeps_what_was_collected_and_a_log_line_says_what_ends_a_collection(blob_path, client, capfd):
    made = []
    options = {"factory": lambda _: made.append(Collecting()) or made[-1], "accumulate": 9, "continuous": False}
    with node_in_thread(None, blob_path, **options) as node:
        client.wait_for_state("active")
        (method,) = made
        for i in range(4):
            client.send(GOOD * (i + 1))
            wait_until(lambda i=i: node.counters.received == i + 1)
        for enabled in (False, True):
            assert client.call("set_enabled", SetBool.Request(data=enabled)).success
        wait_until(lambda: node.counters.merged == 4, what=node.counters)
        assert [len(points) for points in method.kept] == [1000] * 4 and node.counters.dropped == 0
        assert "are forgotten" not in capfd.readouterr().err
        assert client.call("reset").success
        wait_until(lambda: not method.kept)
        client.send(GOOD)
        wait_until(lambda: node.counters.received == 5)
        assert client.call("register").success
        wait_until(client.seeds.get_subscription_count)
        client.seeds.publish(PoseWithCovarianceStamped(header=Header(frame_id="probe")))
        wait_until(lambda: not method.kept)
        client.send(GOOD)
        wait_until(lambda: node.counters.received == 6)
        assert client.call("register").success
        assert client.call("reload_model").success
        wait_until(lambda: not method.kept and node.session._ready.method is made[1])
    lines = capfd.readouterr().err
    for why, count in (("a reset", 4000), ("an initialpose", 1000), ("another bone", 1000)):
        assert f"{why}: the {count} points collected so far are forgotten" in lines


def test_clouds_whose_transform_comes_later_are_collected_then(blob_path, client, monkeypatch):
    """Their transforms lag behind the clouds, and many come while one is registered."""
    tf2, method = LaggingTf2(), Collecting()
    monkeypatch.setattr(frames, "_import_tf2", lambda: tf2)
    options = {"output_frame": "tracker", "accumulate": 20, "tf_timeout": 60.0}
    with node_in_thread(method, blob_path, **options) as node:
        client.wait_for_state("active")
        method.gate.clear()
        calls, tf2.known_s = len(method.calls), 100.0
        client.send(GOOD, stamp_s=100.0)
        wait_until(lambda: len(method.calls) > calls)
        for i in range(1, 9):
            client.send(GOOD * (1.0 + 0.01 * i), stamp_s=100.0 + i)
            wait_until(lambda i=i: node.counters.received == i + 1)
        method.gate.set()
        wait_until(lambda: node.counters.accepted == 1)
        time.sleep(0.3)  # the newest waits for its transform now
        assert (node.counters.merged, node.counters.dropped) == (0, 0)
        tf2.known_s = 109.0
        wait_until(lambda: node.counters.merged + node.counters.accepted == 9, what=node.counters)
        assert node.counters.dropped == 0
        assert [round(float(points[0, 0] / GOOD[0, 0])) for points in method.kept] == [1000] + [
            round(1000 + 10 * i) for i in range(1, 9)
        ]


def test_clouds_whose_transform_never_comes_are_dropped_counted_and_logged(blob_path, client, monkeypatch, capfd):
    tf2, method = LaggingTf2(), Collecting()
    monkeypatch.setattr(frames, "_import_tf2", lambda: tf2)
    with node_in_thread(method, blob_path, output_frame="tracker", accumulate=20, tf_timeout=0.05) as node:
        client.wait_for_state("active")
        method.gate.clear()
        calls, tf2.known_s = len(method.calls), 100.5
        client.send(GOOD, stamp_s=100.0)
        wait_until(lambda: len(method.calls) > calls)
        for i in range(3):
            client.send(GOOD, stamp_s=100.6 + 0.1 * i)
            wait_until(lambda i=i: node.counters.received == i + 2)
        method.gate.set()
        wait_until(lambda: node.counters.accepted + node.counters.refused == 2)
        time.sleep(0.1)
        assert client.ask(GOOD * 1.1, stamp_s=100.3)["level"] == 0
        wait_until(lambda: node.counters.dropped == 2)
        assert (node.counters.merged, node.counters.accepted, len(method.kept)) == (0, 2, 2)
    assert (
        "a cloud is not registered with the newer ones: tf_missing: output_frame: tracker <- probe"
        in capfd.readouterr().err
    )


def test_clouds_that_wait_for_their_transforms_are_counted_as_dropped_when_the_node_is_cleaned_up(
    blob_path, client, monkeypatch, capfd
):
    tf2, method = LaggingTf2(), Collecting()
    monkeypatch.setattr(frames, "_import_tf2", lambda: tf2)
    with node_in_thread(method, blob_path, output_frame="tracker", accumulate=20, tf_timeout=60.0) as node:
        client.wait_for_state("active")
        method.gate.clear()
        calls, tf2.known_s = len(method.calls), 100.5
        for i in range(4):
            client.send(GOOD, stamp_s=100.0 + i)
            wait_until(lambda i=i: node.counters.received == i + 1 and len(method.calls) > calls)
        for transition in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP):
            assert client.change_state(transition)
        method.gate.set()
        wait_until(lambda: node.counters.dropped == 3 and node.counters.refused == 1, what=lambda: node.counters)
    assert "a cloud is not registered with the newer ones: the node stopped" in capfd.readouterr().err


def test_few_clouds_wait_for_their_transforms_and_those_of_before_a_reset_do_not():
    tries, left = [], []

    def collect(job):
        tries.append(job)
        raise RefusedError(Reason.TF_MISSING if job.epoch else Reason.SUPERSEDED_BY_RESET, "for the test")

    late = Late(collect, lambda collected, why: left.append(why))
    for epoch in (0, *[1] * (MOST_LATE + 2)):
        late.add(Job(b"", epoch, 0))
        late.take(60.0)
    assert left == ["superseded_by_reset: for the test", *["more than 100 clouds wait for their transforms"] * 2]
    late.take(0.0)
    assert left[3:] == ["tf_missing: for the test"] * MOST_LATE
    tries.clear()
    late.take(0.0)
    assert not tries


def test_clouds_that_are_metres_away_are_left_out_until_they_are_three_in_a_row(blob_path, client, method):
    method.answer = RegistrationResult(RegistrationStatus.LOW_CONFIDENCE, reason="for the test")
    accumulator = Accumulator(method, most=9)
    with node_in_thread(accumulator, blob_path, accumulate=9):
        client.wait_for_state("active")
        for cloud, refusal in ((GOOD, "low_confidence"), (GOOD + 5.0, "unit_mismatch"), (GOOD * 1.1, "low_confidence"),
                               (GOOD + 5.0, "unit_mismatch"), (GOOD + 5.1, "unit_mismatch"),
                               (GOOD + 5.2, "low_confidence")):  # fmt: skip
            assert client.ask(cloud)["last_refusal"].startswith(refusal)
        np.testing.assert_allclose(accumulator.collected, (GOOD + 5.2) * 1000.0, atol=1e-2)


def test_another_frame_and_stamps_that_go_back_start_a_new_collection(blob_path, client):
    method = Collecting()
    with node_in_thread(method, blob_path, accumulate=9):
        client.wait_for_state("active")
        for count, (frame, stamp_s) in enumerate([("probe", 10.0), ("probe", 11.0)], 1):
            client.ask(GOOD, frame=frame, stamp_s=stamp_s)
            assert len(method.kept) == count
        client.ask(GOOD, frame="other", stamp_s=12.0)
        assert len(method.kept) == 1
        client.ask(GOOD, frame="other", stamp_s=13.0)
        for stamp_s in (3.0, 3.1, 3.2):
            client.ask(GOOD, frame="other", stamp_s=stamp_s)
        assert len(method.kept) == 1


def test_a_registration_that_does_not_end_is_said_while_it_lasts(blob_path, client, method):
    """The last pose stays latched meanwhile, and nothing else says that it is an old one."""
    with node_in_thread(method, blob_path, timeout=0.3, tf_timeout=0.1):
        client.wait_for_state("active")
        assert client.ask(GOOD)["level"] == 0
        method.gate.clear()
        client.send(GOOD)
        wait_until(lambda: "a cloud has been registered for 1 s, beyond timeout" in client.values()["message"])
        assert client.values()["level"] == 1
        method.gate.set()
        wait_until(lambda: client.values()["message"].startswith("refused: timeout"))
        assert client.ask(GOOD)["level"] == 0


def test_clouds_that_the_middleware_pushes_out_are_counted_as_lost(live):
    node, client, method = live
    client.ask(GOOD)
    busy, go_on = threading.Event(), threading.Event()
    node.call_soon(lambda: (busy.set(), go_on.wait(60.0)))
    assert busy.wait(60.0)
    for _ in range(5):
        client.send(GOOD)
    wait_until(lambda: client.points.wait_for_all_acked(Duration()))
    go_on.set()
    wait_until(lambda: node.counters.lost + node.counters.received == 6, what=node.counters)
    assert node.counters.lost >= 1
    settled = ("frames_accepted", "frames_refused", "frames_dropped", "frames_lost")
    wait_until(lambda: sum(int(client.values()[name]) for name in settled) == 6)
    assert client.ask(GOOD)["frames_lost"] == str(node.counters.lost)
    wait_until(lambda: "were sent and never came: crop or thin" in client.values("input")["message"])
    node.counters.last_lost_at -= 10.0
    wait_until(lambda: "never came" not in client.values("input")["message"])


def test_register_processes_the_newest_cloud_and_answers_with_what_became_of_it(blob_path, client, method):
    with node_in_thread(method, blob_path, continuous=False) as node:
        client.wait_for_state("active")
        nothing = client.call("register")
        assert not nothing.success and nothing.message.startswith("no cloud has come yet")
        for i in range(3):
            client.send(GOOD)
            wait_until(lambda i=i: node.counters.received == i + 1)
        time.sleep(0.1)
        calls = len(method.calls)
        answer = client.call("register")
        assert answer.success and answer.message.startswith("OK  confidence 0.90  TRE 0.7 mm")
        assert len(method.calls) == calls + 1, "continuous is off: one cloud, on request"
        client.send(np.empty((0, 3)))
        wait_until(lambda: node.counters.received == 4)
        answer = client.call("register")
        assert not answer.success and answer.message.startswith("refused: empty_cloud")
        assert node.counters.dropped == 2


def test_an_answer_on_request_says_how_old_its_cloud_is(blob_path, client, method):
    """A camera that was dead for a quarter of a minute gave OK, and nothing said that the pose was of then."""
    with node_in_thread(method, blob_path, continuous=False) as node:
        client.wait_for_state("active")
        client.send(GOOD, stamp_s=time.time() - 16.6)
        wait_until(lambda: node.counters.received == 1)
        answer = client.call("register")
        assert answer.success and re.search(r"  the cloud is 1[67]\.\d s old$", answer.message)
        client.send(GOOD)
        wait_until(lambda: node.counters.received == 2)
        assert "old" not in client.call("register").message


def test_the_status_of_a_cloud_that_waited_when_a_reset_came_has_its_stamp_and_frame(blob_path, client, method):
    heard = []
    client.do(lambda: client.node.create_subscription(DiagnosticStatus, f"{NODE}/status", heard.append, 10))
    with node_in_thread(method, blob_path) as node:
        client.wait_for_state("active")
        wait_until(lambda: client.node.count_publishers(f"{NODE}/status"))
        client.ask(GOOD)
        method.gate.clear()
        registered = len(method.calls)
        client.send(GOOD)
        wait_until(lambda: len(method.calls) > registered)
        stamp = client.send(GOOD, frame="waiting")
        wait_until(lambda: node.counters.received == 3)
        assert client.call("reset").success
        method.gate.set()
        wait_until(lambda: len(heard) >= 3)
    values = {pair.key: pair.value for pair in heard[2].values}
    assert "superseded_by_reset" in heard[2].message
    assert (values["stamp"], values["frame"]) == (stamp, "waiting")


@contextmanager
def node_with_a_cloud(method, blob_path, client):
    """A node that has a cloud and registers on request, and a client for many calls of ~/register at once."""
    deep = QoSProfile(depth=100)
    asking = client.do(lambda: client.node.create_client(Trigger, "/register_node/register", qos_profile=deep))
    with node_in_thread(method, blob_path, continuous=False) as node:
        client.wait_for_state("active")
        client.send(GOOD)
        wait_until(lambda: node.counters.received == 1 and asking.service_is_ready())
        yield node, asking


def test_many_who_ask_at_once_all_get_an_answer_in_order_while_the_node_does_other_things(blob_path, client, method):
    """More than the 10 that a service keeps by default, and rclpy resumes those that wait in the reverse order."""
    with node_with_a_cloud(method, blob_path, client) as (node, asking):
        method.gate.clear()
        node.call_soon(lambda: time.sleep(1.0))  # the calls come while the executor is busy
        answered, calls = [], [asking.call_async(Trigger.Request()) for _ in range(30)]
        for number, call in enumerate(calls):
            call.add_done_callback(lambda _, number=number: answered.append(number))
        assert client.call("set_enabled", SetBool.Request(data=True)).success, "no answer waits for a registration"
        seen = len(client.diagnostics)
        wait_until(lambda: len(client.diagnostics) > seen + 2, what="diagnostics")
        assert not answered
        method.gate.set()
        wait_until(lambda: len(answered) == len(calls), what=lambda: f"30 answers, {len(answered)} came")
        assert answered == sorted(answered) and all(call.result().success for call in calls)


def test_answers_of_one_moment_go_out_one_after_the_other(blob_path, client, method):
    """A client keeps 10 by default, and those to other clients are among them."""
    turns, at_once = [Future() for _ in range(3)], []
    with node_in_thread(method, blob_path) as node:

        def line_up():
            for turn in turns:
                node._services_offered._answers._line_up(turn)
            at_once.extend(turn.done() for turn in turns)

        node.call_soon(line_up)
        wait_until(lambda: turns[-1].done() and node._services_offered._answers._pause is None)
        assert at_once == [True, False, False]
    node._services_offered._answers._line_up(Future())  # of a node that has ended: nobody to answer, and no exception


@pytest.mark.parametrize("end", ["reset", "deactivate"])
def test_many_who_wait_get_an_answer_when_a_reset_or_a_pause_comes_first(blob_path, client, method, end):
    with node_with_a_cloud(method, blob_path, client) as (node, asking):
        method.gate.clear()
        registered, worker = len(method.calls), node.session.worker
        calls = [asking.call_async(Trigger.Request())]
        wait_until(lambda: len(method.calls) > registered)
        calls += [asking.call_async(Trigger.Request()) for _ in range(11)]
        wait_until(lambda: worker._slot and len(worker._slot.waiters) == 11)
        if end == "reset":
            assert client.call("reset").success
        else:
            assert client.change_state(Transition.TRANSITION_DEACTIVATE)
        method.gate.set()
        wait_until(lambda: all(call.done() for call in calls))
        assert {call.result().message.split(":")[1] for call in calls} == {" superseded_by_reset"}


@pytest.mark.parametrize("service", ["reset", "reload_model"])
def test_a_cloud_from_before_a_reset_or_another_bone_is_not_registered_on_request(blob_path, client, method, service):
    with node_in_thread(method, blob_path, continuous=False) as node:
        client.wait_for_state("active")
        client.send(GOOD)
        wait_until(lambda: node.counters.received == 1)
        assert client.call("register").success
        assert client.call("register").success, "once more, on the same cloud"
        assert client.call(service).success
        answer = client.call("register")
        why = "no cloud has come yet, or none since the last reset, reload or pause"
        assert not answer.success and answer.message == why
        client.send(GOOD)
        wait_until(lambda: node.counters.received == 2)
        assert client.call("register").success


def test_a_waiting_cloud_is_registered_with_a_seed_that_came_after_it(blob_path, client, method):
    with node_in_thread(method, blob_path, continuous=False) as node:
        client.wait_for_state("active")
        client.send(GOOD)
        wait_until(lambda: node.counters.received == 1 and client.seeds.get_subscription_count())
        seed = PoseWithCovarianceStamped(header=Header(frame_id="probe"))
        client.seeds.publish(seed)
        wait_until(lambda: node.session.course.initial_pose)
        assert client.call("register").success
        np.testing.assert_allclose(method.calls[-1]["initial"], np.eye(4), atol=1e-12)


def test_a_reload_that_a_cleanup_overtakes_is_answered(live):
    node, client, method = live
    method.gate.clear()
    reload_model = client.ready(Trigger, "/register_node/reload_model").call_async(Trigger.Request())
    wait_until(lambda: node._loader.busy)
    for transition in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP):
        assert client.change_state(transition)
    method.gate.set()
    wait_until(reload_model.done, what="the answer of reload_model")
    assert not reload_model.result().success and "cleaned up" in reload_model.result().message


def test_other_settings_of_how_clouds_are_read_forget_what_was_collected(blob_path, client):
    method = Collecting()
    with node_in_thread(method, blob_path, accumulate=9) as node:
        client.wait_for_state("active")
        client.ask(GOOD)
        assert len(method.kept) == 1
        assert node.set_parameters([Parameter("range_max", value=3.0)])[0].successful
        client.ask(GOOD * 2)
        np.testing.assert_allclose(method.kept, [GOOD * 2 * 1000.0], atol=1e-3)


def test_reload_keeps_the_old_bone_until_the_new_one_is_ready(live, tmp_path, blob_path):
    node, client, method = live
    node.set_parameters([Parameter("model_path", value=str(tmp_path / "absent.stl"))])
    wait_until(lambda: "the bone is not that of model_path: call ~/reload_model" in client.values("input")["conflicts"])
    answer = client.call("reload_model")
    assert not answer.success and answer.message.startswith("the old bone stays: expected a file that exists")
    wait_until(lambda: "~/reload_model failed, the old bone stays" in client.values("input")["conflicts"])
    assert client.ask(GOOD)["model_path"] == str(blob_path)
    assert {entry.hardware_id for entry in client.diagnostics[-1].status} == {"blob.npy"}

    np.save(tmp_path / "new.npy", np.random.default_rng(5).normal(size=(700, 3)) * 40.0)
    node.set_parameters([Parameter("model_path", value=str(tmp_path / "new.npy"))])
    answer = client.call("reload_model")
    assert answer.success and "700 points" in answer.message
    values = client.ask(GOOD)
    assert values["level"] == 0 and values["model_points"] == "700"
    wait_until(lambda: client.models[-1].width == 700)
    wait_until(lambda: client.values("input")["conflicts"] == "")


def test_a_disabled_node_counts_clouds_and_answers_none(live):
    node, client, method = live
    assert client.call("set_enabled", SetBool.Request(data=False)).success
    client.send(GOOD)
    values = wait_until(lambda: client.values() if int(client.values()["frames_dropped"]) == 1 else None)
    assert values["level"] == 1 and values["message"] == "disabled: clouds are dropped until ~/set_enabled"
    assert not client.call("register").success
    assert not client.confidences
    assert client.call("set_enabled", SetBool.Request(data=True)).success
    assert client.ask(GOOD)["level"] == 0


def test_a_failed_transition_is_over_once_one_succeeds(live, monkeypatch):
    node, client, method = live
    assert client.change_state(Transition.TRANSITION_DEACTIVATE)
    with monkeypatch.context() as broken:
        broken.setattr(node.session, "send_model", lambda: 1 / 0)
        assert not client.change_state(Transition.TRANSITION_ACTIVATE)
        wait_until(lambda: client.values()["message"].startswith("activate failed: ZeroDivisionError"))
    assert client.change_state(Transition.TRANSITION_ACTIVATE)
    values = client.ask(GOOD)
    assert values["level"] == 0 and "failed" not in values["message"]


def test_a_node_that_is_configured_again_has_refused_nothing_yet(live):
    node, client, method = live
    method.answer = RegistrationResult(RegistrationStatus.LOW_CONFIDENCE, reason="nope")
    assert "nope" in client.ask(GOOD)["last_refusal"]
    for name in ("DEACTIVATE", "CLEANUP", "CONFIGURE", "ACTIVATE"):
        assert client.change_state(getattr(Transition, f"TRANSITION_{name}"))
    values = wait_until(lambda: values if (values := client.values())["state"] == "active" else None)
    assert values["last_refusal"] == "" and "nope" not in values["message"]
    assert values["frames_refused"] == "1"  # the counts go on


def test_a_seed_reaches_the_method_until_a_pose_is_accepted(live):
    node, client, method = live
    seed = PoseWithCovarianceStamped(header=Header(frame_id="probe"))
    seed.pose.pose.position.x = 0.1
    wait_until(client.seeds.get_subscription_count)
    epoch = node.session.course.epoch
    client.seeds.publish(seed)
    wait_until(lambda: node.session.course.epoch > epoch)
    client.ask(np.empty((0, 3)))
    client.ask(GOOD)
    client.ask(GOOD)
    first, second = method.calls[-2]["initial"], method.calls[-1]["initial"]
    np.testing.assert_allclose(first, se3.from_rotation_translation(np.eye(3), [-100.0, 0.0, 0.0]), atol=1e-9)
    assert second is None

    bad = PoseWithCovarianceStamped(header=Header(frame_id="probe"))
    bad.pose.pose.orientation.w = 0.0
    client.seeds.publish(bad)
    time.sleep(0.2)
    client.ask(GOOD)
    assert method.calls[-1]["initial"] is None


@pytest.mark.parametrize("service", ["reset", "reload_model"])
def test_the_diagnostics_say_nothing_of_the_bone_or_the_time_before(live, service):
    _, client, _ = live
    assert client.ask(GOOD)["level"] == 0
    assert client.ask(np.empty((0, 3)))["last_refusal"].startswith("empty_cloud")
    assert client.values()["cloud_stamp"]
    assert client.call(service).success
    wait_until(lambda: client.values()["last_refusal"] == "")
    values = client.values()
    assert not {"confidence", "tre_mm", "found_by", "cloud_stamp"} & {key for key, value in values.items() if value}
    assert values["level"] == 0
    assert (values["frames_accepted"], values["frames_refused"]) == ("1", "1"), "the counts go on"


def test_who_sends_a_stream_of_guesses_learns_why_no_pose_comes(live):
    node, client, method = live
    wait_until(client.seeds.get_subscription_count)
    method.gate.clear()
    calls = len(method.calls)
    client.send(GOOD)
    wait_until(lambda: len(method.calls) > calls)
    for _ in range(5):
        epoch = node.session.course.epoch
        client.seeds.publish(PoseWithCovarianceStamped(header=Header(frame_id="probe")))
        wait_until(lambda epoch=epoch: node.session.course.epoch > epoch)
    method.gate.set()
    wait_until(
        lambda: client.values()["last_refusal"].endswith(
            "5 came since the last answer: send one guess, not a stream of them"
        )
    )
    assert client.ask(GOOD)["level"] == 0
    client.seeds.publish(PoseWithCovarianceStamped(header=Header(frame_id="probe")))
    wait_until(lambda: node.session.course.initial_pose)
    assert node.session.course.why == "an initialpose", "after an answer they are counted from the start"


def test_a_method_that_remembers_poses_forgets_that_of_the_warm_up_and_with_every_reset(blob_path, client, method):
    method.forgotten_after = []
    method.reset = lambda: method.forgotten_after.append(len(method.calls))
    with node_in_thread(method, blob_path):
        client.wait_for_state("active")
        assert method.forgotten_after == [1]
        client.ask(GOOD)
        assert client.call("reset").success
        wait_until(lambda: method.forgotten_after == [1, 2])


@pytest.mark.parametrize("chosen", ["auto", "best_effort"])
def test_best_effort_publishers_are_heard(blob_path, method, chosen):
    client = Client(ReliabilityPolicy.BEST_EFFORT)
    with node_in_thread(method, blob_path, cloud_reliability=chosen):
        client.wait_for_state("active")
        wait_until(lambda: "best_effort" in client.values()["cloud_qos"])

        def is_heard():  # what is sent before both ends know each other is lost
            client.send(GOOD)
            time.sleep(0.1)
            return client.values()["frames_accepted"] != "0"

        wait_until(is_heard)
        assert client.values("input")["level"] == 0
    client.close()


def test_a_qos_mismatch_that_was_asked_for_is_an_error_in_the_diagnostics(blob_path, method):
    client = Client(ReliabilityPolicy.BEST_EFFORT)
    with node_in_thread(method, blob_path, cloud_reliability="reliable"):
        wait_until(lambda: client.values("input").get("level") == 2)
        assert "incompatible RELIABILITY" in client.values("input")["message"]
    client.close()


def test_time_that_goes_back_clears_the_track(blob_path, client, method):
    with node_in_thread(method, blob_path, use_sim_time=True, require_consecutive=2) as node:
        client.wait_for_state("active")
        set_clock(client, node, 1000)
        assert "1 of 2" in client.ask(GOOD, stamp_s=1000.0)["last_refusal"]
        assert client.ask(GOOD, stamp_s=1000.1)["level"] == 0
        set_clock(client, node, 990)
        assert "1 of 2" in client.ask(GOOD, stamp_s=990.1)["last_refusal"], "the track restarts"


def test_another_clock_clears_the_track_and_the_log_says_so(blob_path, client, method, monkeypatch):
    with node_in_thread(method, blob_path, require_consecutive=2) as node:
        client.wait_for_state("active")
        said = []
        monkeypatch.setattr(node.session._admission._host.ros.get_logger(), "warning", said.append, raising=False)
        assert "1 of 2" in client.ask(GOOD)["last_refusal"]
        assert node.set_parameters([Parameter("use_sim_time", value=True)])[0].successful
        set_clock(client, node, 1000)
        assert "1 of 2" in client.ask(GOOD, stamp_s=1000.0)["last_refusal"], "the track restarts"
        set_clock(client, node, 990)
        assert "1 of 2" in client.ask(GOOD, stamp_s=990.1)["last_refusal"]
    assert [text.partition(":")[0] for text in said] == ["the node's clock is another one now", "the clock jumped back"]


def set_clock(client, node, seconds):
    wait_until(client.clock.get_subscription_count)

    def arrived():
        client.clock.publish(Clock(clock=TimeMessage(sec=seconds)))
        time.sleep(0.02)
        return abs(node.now_ns() - seconds * 1e9) < 1e6

    wait_until(arrived)


def test_before_the_clock_runs_clouds_have_no_age_and_are_not_stale(blob_path, client, method):
    with node_in_thread(method, blob_path, use_sim_time=True, max_cloud_age=0.5):
        client.wait_for_state("active")
        values = client.ask(GOOD, stamp_s=1000.0)
        assert values["level"] == 0 and values["cloud_age_s"] == ""


def test_a_cloud_without_a_stamp_gets_the_time_of_its_arrival(live):
    node, client, method = live
    before = time.time()
    client.ask(xyz_to_cloud(GOOD, Header(frame_id="probe")))
    wait_until(lambda: client.poses)
    assert before - 1.0 <= client.poses[0].header.stamp.sec <= time.time()


def test_a_failed_configuration_leaves_nothing_running(blob_path, client):
    """Its method prepares something that is no bone; three tries left three workers, and parameters that held fast."""

    class Strange(Collecting):
        def prepare(self, target, units="mm"):
            return SimpleNamespace(name="no points")

    workers = sum(thread.name == "registration" for thread in threading.enumerate())
    with node_in_thread(Strange(), blob_path) as node:
        for _ in range(3):
            assert not client.change_state(Transition.TRANSITION_CONFIGURE)
        assert node.session is None
        assert node.set_parameters([Parameter("sensor", value="pointer")])[0].successful
        assert sum(thread.name == "registration" for thread in threading.enumerate()) == workers


@pytest.mark.parametrize("path", ["", "/absent/bone.stl", "text.ply", "empty.stl", "metres.npy", "bone.docx"])
def test_a_model_that_cannot_be_used_fails_configure_with_its_reason_and_the_node_lives(
    path, tmp_path, blob_path, client, method
):
    (tmp_path / "text.ply").write_text("this is not a mesh")
    (tmp_path / "empty.stl").write_bytes(b"")
    np.save(tmp_path / "metres.npy", np.random.default_rng(0).normal(size=(100, 3)) * 0.05)
    given = str(tmp_path / path) if path and not path.startswith("/") else path
    with node_in_thread(method, given) as node:
        wait_until(lambda: client.values().get("level") == 2)
        values = client.values()
        assert values["state"] == "unconfigured" and values["message"].startswith("configure failed: expected")
        node.set_parameters([Parameter("model_path", value=str(blob_path))])
        assert client.change_state(Transition.TRANSITION_CONFIGURE)
        assert client.change_state(Transition.TRANSITION_ACTIVATE)
        client.wait_for_state("active")
        assert client.ask(GOOD)["level"] == 0


def test_the_lifecycle_goes_round_and_the_node_works_after_it(live):
    node, client, method = live
    client.ask(GOOD)
    assert client.change_state(Transition.TRANSITION_DEACTIVATE)
    wait_until(lambda: client.points.get_subscription_count() == 0)  # or the next cloud would go to the old one
    assert not client.call("register").success
    assert client.change_state(Transition.TRANSITION_CLEANUP)
    answer = client.call("reload_model")
    assert not answer.success and "unconfigured" in answer.message
    assert client.change_state(Transition.TRANSITION_CONFIGURE)
    assert client.change_state(Transition.TRANSITION_ACTIVATE)
    client.wait_for_state("active")
    assert client.ask(GOOD)["level"] == 0
    assert client.change_state(Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert node.state == "finalized"


def test_deactivating_tells_those_who_wait_and_sends_nothing_more(live):
    node, client, method = live
    client.ask(GOOD)
    method.gate.clear()
    calls = len(method.calls)
    client.send(GOOD)
    wait_until(lambda: len(method.calls) > calls)
    poses = len(client.poses)
    assert client.change_state(Transition.TRANSITION_DEACTIVATE)
    method.gate.set()
    wait_until(lambda: client.values()["last_refusal"].startswith("superseded_by_reset"))
    assert len(client.poses) == poses


def test_without_autostart_the_node_waits_and_says_for_what(blob_path, client, method, capfd):
    with node_in_thread(method, blob_path, autostart=False):
        wait_until(lambda: client.values().get("state") == "unconfigured")
        assert client.values()["level"] == 1 and not method.prepared
    how = "configure and activate it, e.g. ros2 lifecycle set /register_node configure, then activate"
    assert f"unconfigured (autostart is false): {how}" in capfd.readouterr().err


def test_without_tf_another_output_frame_is_refused_and_never_taken_as_identity(blob_path, client, method, monkeypatch):
    monkeypatch.setattr(frames, "_import_tf2", lambda: None)
    with node_in_thread(method, blob_path, output_frame="tracker"):
        client.wait_for_state("active")
        values = client.ask(GOOD, frame="probe")
        assert values["last_refusal"].startswith("tf_missing: output_frame: tracker <- probe: tf2_ros is not installed")
        assert client.ask(GOOD, frame="tracker")["level"] == 0, "the cloud is in the output frame already"


class FakeTf2:
    """What the node uses of tf2_ros: one known transform, and what was sent."""

    class TransformException(Exception):
        pass

    def __init__(self, T_tracker_probe):
        self.sent, self.T_tracker_probe = [], T_tracker_probe
        self.delay = itertools.count()

    def TransformBroadcaster(self, node):
        fake = self

        class Broadcaster:
            pub_tf = node.create_publisher(TransformStamped, "unused", 1)

            def sendTransform(self, transform):
                fake.sent.append(transform)

        return Broadcaster()

    class Listener:
        def unregister(self):
            pass

    def TransformListener(self, buffer, node):
        return self.Listener()

    def Buffer(self, node):
        fake = self

        class Buffer:
            srv, jump_handle = None, fake.Listener()

            def can_transform(self, parent, child, stamp):
                return child == "probe" and next(fake.delay) > 3

            def lookup_transform(self, parent, child, stamp):
                if child != "probe":
                    raise fake.TransformException(f"{child} does not exist")
                from msg_adapters import matrix_to_transform

                T = fake.T_tracker_probe if parent == "tracker" else se3.inverse(fake.T_tracker_probe)
                return TransformStamped(transform=matrix_to_transform(T))

        return Buffer()


class LaggingTf2(FakeTf2):
    """Knows transforms up to a time."""

    def __init__(self):
        super().__init__(np.eye(4))
        self.known_s = 0.0

    def Buffer(self, node):
        buffer, fake = super().Buffer(node), self
        known = buffer.lookup_transform
        buffer.can_transform = lambda parent, child, stamp: stamp.nanoseconds <= fake.known_s * 1e9

        def lookup_transform(parent, child, stamp):
            if not buffer.can_transform(parent, child, stamp):
                raise fake.TransformException("into the future")
            return known(parent, child, stamp)

        buffer.lookup_transform = lookup_transform
        return buffer


def test_with_tf_poses_go_to_the_output_frame_and_to_tf_once_for_each_newer_stamp(
    blob_path, client, method, monkeypatch
):
    T_tracker_probe = pose_mm([0.0, 0.0, 1.2], [0.5, 0.1, 0.2])  # metres
    tf2 = FakeTf2(T_tracker_probe)
    monkeypatch.setattr(frames, "_import_tf2", lambda: tf2)
    method.answer = accepted(T_TARGET_SOURCE)
    with node_in_thread(method, blob_path, output_frame="tracker", publish_tf=True):
        client.wait_for_state("active")
        levels = [client.ask(GOOD, frame="probe", stamp_s=stamp_s)["level"] for stamp_s in (10.0, 10.0, 9.5, 11.0)]
        assert levels == [0, 0, 1, 0]
        wait_until(lambda: len(client.transforms) == 3)
        in_tracker_mm = se3.apply(T_tracker_probe, GOOD.astype(np.float32)) * 1000.0
        np.testing.assert_allclose(method.calls[-1]["source"], in_tracker_mm, atol=1e-3)
        T_tracker_model = se3.inverse(T_TARGET_SOURCE)
        T_tracker_model[:3, 3] /= 1000.0
        np.testing.assert_allclose(transform_to_matrix(client.transforms[0]), T_tracker_model, atol=1e-12)
        assert [t.header.stamp.sec for t in tf2.sent] == [10, 11]
        assert tf2.sent[0].header.frame_id == "tracker" and tf2.sent[0].child_frame_id == "bone_preop"
        refused = client.ask(GOOD, frame="unknown", stamp_s=12.0)
        assert refused["last_refusal"] == "tf_missing: output_frame: tracker <- unknown: unknown does not exist"


def test_a_look_up_that_fails_raises_tf_missing_even_while_simulated_time_stands_still(monkeypatch):
    tf2 = FakeTf2(np.eye(4))
    monkeypatch.setattr(frames, "_import_tf2", lambda: tf2)
    looked_up = frames.Frames(None, publish=False, listen=True)
    start = time.monotonic()
    with pytest.raises(RefusedError) as caught:
        looked_up.lookup("tracker", "unknown", Time(), 0.1)
    assert caught.value.reason is Reason.TF_MISSING
    assert 0.1 <= time.monotonic() - start < 30.0


def test_a_look_up_that_has_begun_goes_on_while_the_node_ends(monkeypatch):
    tf2 = FakeTf2(np.eye(4))
    monkeypatch.setattr(frames, "_import_tf2", lambda: tf2)
    node = SimpleNamespace(destroy_service=lambda service: None)
    looked_up = frames.Frames(node, publish=False, listen=True)
    buffer, known = looked_up._buffer, looked_up._buffer.can_transform
    buffer.can_transform = lambda *names: looked_up.close() or known(*names)
    np.testing.assert_array_equal(looked_up.lookup("tracker", "probe", Time(), 1.0), np.eye(4))


@pytest.mark.parametrize(("unit", "mm"), [("m", 1000.0), ("cm", 10.0)])
def test_the_model_is_scaled_turned_and_converted_before_it_is_prepared(tmp_path, client, method, unit, mm):
    points_mm = np.random.default_rng(2).normal(size=(400, 3)) * [60.0, 20.0, 15.0]
    np.save(tmp_path / "bone.npy", points_mm / mm)
    options = {"model_unit": unit, "model_scale": 1.1, "model_axes": "lps_to_ras"}
    with node_in_thread(method, tmp_path / "bone.npy", **options):
        client.wait_for_state("active")
        prepared = method.calls[0]["target"].points
    np.testing.assert_allclose(prepared, points_mm * 1.1 * [-1.0, -1.0, 1.0], atol=1e-9)


def test_a_guessed_model_unit_is_warned_about(tmp_path, client, method, capfd):
    np.save(tmp_path / "unknown.npy", np.random.default_rng(2).normal(size=(400, 3)) * 0.05)
    with node_in_thread(method, tmp_path / "unknown.npy", model_unit="auto"):
        client.wait_for_state("active")
    assert "taken to be in m; name the unit to be sure" in capfd.readouterr().err


def test_the_log_says_what_is_loaded_and_where_clouds_are_waited_for(blob_path, client, method, capfd):
    with node_in_thread(method, blob_path, namespace="/left"):
        wait_until(lambda: client.values().get("state") == "active")
    lines = capfd.readouterr().err
    assert f"loading {blob_path}" in lines and "active, waits for clouds on /left/points (PointCloud2, in m)" in lines


def test_clouds_in_millimetres_are_taken_as_such(blob_path, client, method):
    with node_in_thread(method, blob_path, cloud_unit="mm"):
        client.wait_for_state("active")
        assert client.ask(GOOD * 1000.0)["level"] == 0
    np.testing.assert_allclose(method.calls[-1]["source"], GOOD * 1000.0, atol=1e-3)


def test_thinning_is_seeded(blob_path, client, method):
    with node_in_thread(method, blob_path, max_points=300, seed=7):
        client.wait_for_state("active")
        client.ask(GOOD)
        client.ask(GOOD)
    first, second = method.calls[-2]["source"], method.calls[-1]["source"]
    assert len(first) == 300
    np.testing.assert_array_equal(first, second)


def test_no_exception_of_a_callback_ends_the_node(live):
    node, client, method = live

    def broken():
        raise RuntimeError("broken call")

    node.call_soon(broken)
    node.session._publishers.send, send = broken, node.session._publishers.send
    client.send(GOOD)
    wait_until(lambda: client.values()["frames_accepted"] == "1")
    node.session._publishers.send = send
    assert client.ask(GOOD)["level"] == 0


def test_a_seed_in_another_frame_is_looked_up_though_nothing_goes_to_tf(monkeypatch):
    monkeypatch.setattr(frames, "_import_tf2", lambda: FakeTf2(np.eye(4)))
    looked_up = frames.Frames(None, publish=False, listen=False)
    looked_up.listen()
    np.testing.assert_array_equal(looked_up.lookup("tracker", "probe", Time(), 1.0), np.eye(4))
