"""The node with a registration method of the tests' own: topics, services, lifecycle, QoS, time."""

from __future__ import annotations

import threading
import time
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
from builtin_interfaces.msg import Time as TimeMessage
from geometry_msgs.msg import PoseWithCovarianceStamped
from harness import NODE, Client, Collecting, accepted, node_in_thread, pose_mm, wait_until
from lifecycle_msgs.msg import Transition
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.task import Future
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger

from gapr_core import Accumulator
from gapr_core.geometry import se3
from gapr_core.results import Effect, Finding, RegistrationResult, RegistrationStatus, ResultWarning
from gapr_ros.node import frames
from msg_adapters import cloud_to_xyz, list_to_covariance, pose_to_matrix, transform_to_matrix, xyz_to_cloud

GOOD = np.random.default_rng(1).normal(size=(1000, 3)) * 0.02
T_TARGET_SOURCE = pose_mm([0.3, -1.1, 0.7], [120.0, -40.0, 300.0])
REFUSED = RegistrationResult(RegistrationStatus.LOW_CONFIDENCE, reason="nope")


@pytest.fixture
def live(blob_path, client, method):
    with node_in_thread(method, blob_path) as node:
        client.wait_for_state("active")
        yield node, client, method


def test_an_accepted_cloud_gives_pose_covariance_confidence_and_bound_under_one_header(live):
    node, client, method = live
    warning = ResultWarning("sensor_unknown", "the sensor is not named")
    method.answer = accepted(
        T_TARGET_SOURCE, tre95_mm=1.4, pose_probability=0.95, bone_evidence=2.0, warnings=(warning,)
    )
    values = client.ask(GOOD, frame="probe", stamp_s=1234.5)
    wait_until(lambda: client.poses and client.transforms)
    pose, transform, status = client.poses[0], client.transforms[0], client.statuses[0]
    expected = se3.inverse(T_TARGET_SOURCE)
    expected[:3, 3] /= 1000.0
    np.testing.assert_allclose(pose_to_matrix(pose), expected, atol=1e-12)
    np.testing.assert_allclose(transform_to_matrix(transform), expected, atol=1e-12)
    header = Header(frame_id="probe", stamp=TimeMessage(sec=1234, nanosec=500_000_000))
    assert pose.header == transform.header == status.header == header
    assert transform.child_frame_id == "bone_preop"
    covariance = list_to_covariance(pose.pose.covariance)
    np.linalg.cholesky(covariance)
    assert 1e-4 < np.sqrt(covariance[0, 0]) < 1e-2
    np.testing.assert_allclose(method.calls[-1]["source"], GOOD * 1000.0, atol=1e-3)
    numbers = {"confidence": 0.9, "pose_probability": 0.95, "bone_evidence": 2.0, "tre": 0.0007, "tre95": 0.0014}
    assert {key: float(values[key]) for key in numbers} == numbers, "one unit: metres"
    said = np.array(values["covariance"].split(), dtype=float)
    np.testing.assert_allclose(said, pose.pose.covariance, rtol=1e-5, atol=1e-12)
    p, q = pose.pose.pose.position, pose.pose.pose.orientation
    np.testing.assert_allclose(np.array(values["pose"].split(), dtype=float), [p.x, p.y, p.z, q.x, q.y, q.z, q.w], 1e-6)
    assert values["warnings"] == "sensor_unknown: the sensor is not named" and values["reason"] == ""
    assert values["line"] == "pose with confidence 0.90, tre95 0.0014 m"
    wait_until(lambda: client.values()["warnings"] == values["warnings"])


LATE = {  # what was done after an accepted cloud: what a late joiner gets of pose and model; whether it is withdrawn
    "nothing": ((1, 1), False),
    "pause": ((1, 1), False),
    "refusal": ((1, 1), False),
    "age": ((0, 1), True),
    "reset": ((0, 1), True),
    "reload_model": ((0, 1), True),
    "deactivate": ((0, 0), True),
}


@pytest.mark.parametrize("event", LATE)
def test_a_late_joiner_gets_a_pose_only_while_it_stands_and_never_without_its_status(blob_path, client, method, event):
    counts, withdrawn = LATE[event]
    with node_in_thread(method, blob_path, pose_lifetime=0.3 if event == "age" else 0.0):
        client.wait_for_state("active")
        client.ask(GOOD)
        if event == "pause":
            assert client.call("set_enabled", SetBool.Request(data=False)).success
        elif event == "refusal":
            method.answer = REFUSED
            client.ask(GOOD)
        elif event == "deactivate":
            assert client.change_state(Transition.TRANSITION_DEACTIVATE)
        elif event in ("reset", "reload_model"):
            assert client.call(event).success
        if withdrawn:
            wait_until(lambda: "withdrawn" in client.statuses[-1].status[0].message, what="the status that says so")
        late = Client()
        wait_until(lambda: all(late.node.count_publishers(f"{NODE}/{name}") for name in ("pose", "model")))
        time.sleep(0.5)
        assert (len(late.poses), len(late.models)) == counts
        assert len(late.statuses) == (event != "deactivate")
        late.close()


def test_poses_that_stop_are_withdrawn_logged_and_an_error_until_they_come_back(blob_path, client, method, capfd):
    with node_in_thread(method, blob_path, pose_lifetime=0.3):
        client.wait_for_state("active")
        assert client.ask(GOOD)["level"] == 0
        wait_until(lambda: client.values()["level"] == 2)
        assert client.values()["message"].startswith("the pose was withdrawn: no newer one for 0.3 s (pose_lifetime)")
        assert client.ask(GOOD)["level"] == 0
    lines = [line.split("]: ")[1] for line in capfd.readouterr().err.splitlines() if "pose" in line and "]: " in line]
    kinds = [line.split(":")[0] for line in lines if line.startswith(("first pose", "poses"))]
    assert kinds[:3] == ["first pose", "poses stopped", "poses are back"]


def test_refusals_in_a_row_are_an_error_from_error_after_on_until_a_pose_comes(blob_path, client, method):
    with node_in_thread(method, blob_path, error_after=3):
        client.wait_for_state("active")
        method.answer = REFUSED
        assert [client.ask(GOOD)["level"] for _ in range(4)] == [1, 1, 2, 2]
        assert client.values()["message"].startswith("4 refusals in a row: low_confidence")
        method.answer = accepted()
        assert client.ask(GOOD)["level"] == 0


def test_clouds_that_stop_are_an_error_of_the_input_and_said_in_the_log(blob_path, client, method, capfd, monkeypatch):
    monkeypatch.setattr("gapr_ros.node.report.SILENCE_S", 0.5)
    monkeypatch.setattr("gapr_ros.node.subscription.SILENCE_S", 0.5)
    with node_in_thread(method, blob_path):
        client.wait_for_state("active")
        wait_until(lambda: "no cloud on /points" in client.values("input")["conflicts"])
        assert client.values("input")["level"] == 1, "none has come yet"
        client.ask(GOOD)
        levels = [ord(array.status[1].level) for array in client.diagnostics if len(array.status) > 1]
        assert levels[-1] == 0
        wait_until(lambda: client.values("input")["level"] == 2)
        assert client.values("input")["message"].startswith("no cloud for")
    assert "no cloud on /points for 0 s from /client: does the sensor run?" in capfd.readouterr().err


@pytest.mark.parametrize("advice", ["", "turn the probe"])
def test_the_line_of_a_refusal_is_short_and_says_what_to_do(live, advice):
    node, client, method = live
    why = "so many reasons " * 50
    finding = Finding("check", Effect.REFUSE, 1.0, 0.5, RegistrationStatus.CLUTTER, why, advice)
    method.answer = RegistrationResult(RegistrationStatus.CLUTTER, reason=why, findings=(finding,))
    values = client.ask(GOOD)
    assert values["line"].startswith("refused (clutter): " + (advice or "most of the cloud is not this bone: set"))
    assert len(values["line"]) <= 200 and values["detail"] == why and values["findings"].startswith("check: so many")


def test_a_bag_without_a_clock_is_said_once(live, capfd):
    node, client, method = live
    for i in range(3):
        assert "old" not in client.ask(GOOD, stamp_s=1_000_000.0 + i)["line"]
    lines = capfd.readouterr().err.splitlines()
    assert sum("days older than the clock, as of a bag without /clock: play it with --clock" in x for x in lines) == 1


def test_an_answer_on_request_says_how_old_its_cloud_is(blob_path, client, method):
    with node_in_thread(method, blob_path, continuous=False) as node:
        client.wait_for_state("active")
        for age_s, said in ((16.6, "of a cloud 1"), (0.0, "")):
            received = node.counters.received
            client.send(GOOD, stamp_s=time.time() - age_s)
            wait_until(lambda n=received: node.counters.received > n)
            answer = client.call("register")
            assert answer.success and said in answer.message and ("old" in answer.message) == bool(said)


def test_a_clock_that_jumps_clears_the_track(blob_path, client, method):
    with node_in_thread(method, blob_path, use_sim_time=True, max_jump_translation=0.001) as node:
        client.wait_for_state("active")
        set_clock(client, node, 1000)
        assert client.ask(GOOD, stamp_s=1000.0)["level"] == 0
        method.answer = accepted(pose_mm([0.0, 0.0, 0.0], [50.0, 0.0, 0.0]))
        assert client.ask(GOOD, stamp_s=1000.1)["last_refusal"].startswith("jump")
        set_clock(client, node, 990)
        assert client.ask(GOOD, stamp_s=990.1)["level"] == 0


def test_the_model_is_latched_in_metres_and_the_aligned_bone_is_sent_when_somebody_listens(live):
    node, client, method = live
    wait_until(lambda: client.models)
    model = client.models[0]
    assert model.header.frame_id == "bone_preop"
    bone_mm = method.calls[0]["target"].points
    np.testing.assert_allclose(cloud_to_xyz(model) * 1000.0, bone_mm, atol=1e-4)

    aligned = []
    client.node.create_subscription(PointCloud2, "/register_node/debug/aligned", aligned.append, 1)
    wait_until(node.session._publishers._topics["debug/aligned"].get_subscription_count)
    wait_until(lambda: client.node.count_publishers("/register_node/debug/aligned"))
    method.answer = accepted(T_TARGET_SOURCE)
    client.ask(GOOD)
    wait_until(lambda: aligned)
    assert aligned[0].header.frame_id == "probe"
    np.testing.assert_allclose(
        cloud_to_xyz(aligned[0]) * 1000.0, se3.apply(se3.inverse(T_TARGET_SOURCE), bone_mm), atol=1e-3
    )


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
        assert client.ask(GOOD[:150])["level"] == 0
        method.gate.clear()
        client.send(GOOD[:300])
        wait_until(lambda: len(method.calls) == 3 and node.counters.received == 2)
        for i in range(6):
            client.send(GOOD[:100] * (i + 1) if i != 4 else np.full((100, 3), np.nan))
            wait_until(lambda i=i: node.counters.received == i + 3)
        method.gate.set()
        wait_until(lambda: int(client.values()["frames_accepted"]) == 3)
        wait_until(lambda: int(client.values()["frames_merged"]) == 4)
        values, kept = client.values(), list(method.kept)
    counts = {key: int(values[f"frames_{key}"]) for key in ("received", "accepted", "refused", "merged", "dropped")}
    assert counts == {"received": 8, "accepted": 3, "refused": 0, "merged": 4, "dropped": 1}
    assert [len(source) for source in kept] == [150, 300, 100, 100, 100, 100, 100]
    np.testing.assert_allclose(kept[-2], GOOD[:100] * 4 * 1000.0, atol=1e-3)
    np.testing.assert_allclose(kept[-1], GOOD[:100] * 6 * 1000.0, atol=1e-3)
    assert int(values["points_used"]) == 950


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
        assert answer.success and answer.message.startswith("pose with confidence 0.90")
        assert len(method.calls) == calls + 1, "continuous is off: one cloud, on request"
        client.send(np.empty((0, 3)))
        wait_until(lambda: node.counters.received == 4)
        answer = client.call("register")
        assert not answer.success and answer.message.startswith("refused (empty_cloud)")
        assert node.counters.dropped == 2


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
        assert {call.result().message.split(":")[0] for call in calls} == {"refused (superseded_by_reset)"}


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
        wait_until(lambda: node.session.gate.initial_pose)
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


def test_reload_keeps_the_old_bone_until_the_new_one_is_ready(live, tmp_path, blob_path):
    node, client, method = live
    node.set_parameters([Parameter("model_path", value=str(tmp_path / "absent.stl"))])
    wait_until(lambda: "the bone is not that of model_path: call ~/reload_model" in client.values("input")["conflicts"])
    answer = client.call("reload_model")
    assert not answer.success and answer.message.startswith("the old bone stays: expected a file that exists")
    wait_until(lambda: "~/reload_model failed, the old bone stays" in client.values("input")["conflicts"])
    assert client.ask(GOOD)["level"] == 0
    assert {entry.hardware_id for entry in client.diagnostics[-1].status} == {"blob.npy"}

    np.save(tmp_path / "new.npy", np.random.default_rng(5).normal(size=(700, 3)) * 40.0)
    node.set_parameters([Parameter("model_path", value=str(tmp_path / "new.npy"))])
    answer = client.call("reload_model")
    assert answer.success and "700 points" in answer.message
    values = client.ask(GOOD)
    assert values["level"] == 0
    wait_until(lambda: client.models[-1].width == 700)
    wait_until(lambda: client.values("input")["conflicts"] == "")


def test_a_disabled_node_counts_clouds_and_answers_none(live):
    node, client, method = live
    assert client.call("set_enabled", SetBool.Request(data=False)).success
    client.send(GOOD)
    values = wait_until(lambda: client.values() if int(client.values()["frames_dropped"]) == 1 else None)
    assert values["level"] == 1 and values["message"] == "disabled: clouds are dropped until ~/set_enabled"
    assert not client.call("register").success
    assert not client.statuses
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
    epoch = node.session.gate.epoch
    client.seeds.publish(seed)
    wait_until(lambda: node.session.gate.epoch > epoch)
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
    assert client.call(service).success
    wait_until(lambda: client.values()["last_refusal"] == "")
    values = client.values()
    assert not {"points_used", "found_by", "seconds"} & {key for key, value in values.items() if value}
    assert values["level"] == 0
    assert (values["frames_accepted"], values["frames_refused"]) == ("1", "1"), "the counts go on"


def test_a_method_that_remembers_poses_forgets_that_of_the_warm_up_and_with_every_reset(blob_path, client, method):
    method.forgotten_after = []
    method.reset = lambda: method.forgotten_after.append(len(method.calls))
    with node_in_thread(method, blob_path):
        client.wait_for_state("active")
        assert method.forgotten_after == [1]
        client.ask(GOOD)
        assert client.call("reset").success
        wait_until(lambda: method.forgotten_after == [1, 2])


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
        assert values["level"] == 0 and values["cloud_age"] == ""


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


@pytest.mark.parametrize("path", ["", "text.ply"])
def test_a_model_that_cannot_be_used_fails_configure_with_its_reason_and_the_node_lives(
    path, tmp_path, blob_path, client, method
):
    (tmp_path / "text.ply").write_text("this is not a mesh")
    with node_in_thread(method, tmp_path / path if path else "") as node:
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


@pytest.mark.parametrize(("unit", "mm"), [("m", 1000.0), ("cm", 10.0)])
def test_the_model_is_scaled_turned_and_converted_before_it_is_prepared(tmp_path, client, method, unit, mm):
    points_mm = np.random.default_rng(2).normal(size=(400, 3)) * [60.0, 20.0, 15.0]
    np.save(tmp_path / "bone.npy", points_mm / mm)
    options = {"model_unit": unit, "model_axes": "lps_to_ras"}
    with node_in_thread(method, tmp_path / "bone.npy", **options):
        client.wait_for_state("active")
        prepared = method.calls[0]["target"].points
    np.testing.assert_allclose(prepared, points_mm * [-1.0, -1.0, 1.0], atol=1e-9)


def test_the_log_says_what_is_loaded_and_where_clouds_are_waited_for(blob_path, client, method, capfd):
    with node_in_thread(method, blob_path, namespace="/left"):
        wait_until(lambda: client.values().get("state") == "active")
    lines = capfd.readouterr().err
    assert f"loading {blob_path}" in lines and "active, waits for clouds on /left/points (in m)" in lines


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
