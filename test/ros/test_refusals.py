"""Every reason to refuse, on a live node: confidence 0, no pose, the reason in the diagnostics, the next is fine."""

from __future__ import annotations

import time
from functools import partial

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from harness import StandIn, accepted, node_in_thread, pose_mm, wait_until
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header
from std_srvs.srv import SetBool

from gapr_core.errors import InvalidPointCloudError, InvalidViewpointError
from gapr_core.results import RegistrationResult, RegistrationStatus
from gapr_ros.node import cloud as cloud_room
from gapr_ros.node import report
from gapr_ros.node.outcome import Job, Outcome, Reason, RefusedError
from gapr_ros.parameters import NodeParameters
from msg_adapters import xyz_to_cloud

CHANGED = "max_cloud_age", "min_confidence", "cloud_unit", "max_jump_translation", "max_jump_rotation", "max_tre"
GOOD = np.random.default_rng(1).normal(size=(1000, 3)) * 0.02


@pytest.fixture(scope="module")
def live(blob_path_module):
    """One node and one client for all tests of this file; every test puts back what it changed."""
    from harness import Client

    method, client = StandIn(), Client()
    with node_in_thread(method, blob_path_module, max_cloud_age=0.0) as node:
        client.wait_for_state("active")
        yield node, client, method
        client.close()


@pytest.fixture(scope="module")
def blob_path_module(blob_path):
    return blob_path


@pytest.fixture(autouse=True)
def restored(live):
    node, client, method = live
    client.call("reset")
    client.poses.clear()
    client.statuses.clear()
    yield
    method.answer, method.error = accepted(), None
    method.gate.set()
    defaults = NodeParameters()
    for name in CHANGED:
        assert node.set_parameters_atomically([Parameter(name, value=getattr(defaults, name))]).successful


def expect_refusal(live, cloud, reason, text="", **kwargs):
    """The cloud is refused for this reason, and the node accepts a good one right after."""
    node, client, method = live
    values = client.ask(cloud, **kwargs)
    assert values["last_refusal"].split(":")[0] == str(reason), values["last_refusal"]
    assert text in values["last_refusal"]
    assert values["level"] >= 1 and values["reason"] == str(reason) and not client.poses


def expect_good(live):
    node, client, method = live
    values = client.ask(GOOD)
    assert values["level"] == 0, values
    wait_until(lambda: client.poses)


def damaged(change) -> PointCloud2:
    cloud = xyz_to_cloud(GOOD.astype(np.float32), Header(frame_id="probe"))
    change(cloud)
    return cloud


def overflow(cloud):
    cloud.header.stamp.sec, cloud.header.stamp.nanosec = 2**31 - 1, 2**32 - 1


INTEGERS = damaged(lambda c: [setattr(field, "datatype", PointField.INT32) for field in c.fields])
BAD_INPUT = {
    "an empty cloud": (np.empty((0, 3)), Reason.EMPTY_CLOUD),
    "a message of nothing": (PointCloud2(), Reason.BAD_FRAME),
    "an empty cloud of a frame": (PointCloud2(header=Header(frame_id="probe")), Reason.EMPTY_CLOUD),
    "no frame": (damaged(lambda c: setattr(c.header, "frame_id", "")), Reason.BAD_FRAME),
    "nothing but a slash": (damaged(lambda c: setattr(c.header, "frame_id", "/")), Reason.BAD_FRAME),
    "the bone's own frame": (damaged(lambda c: setattr(c.header, "frame_id", "/bone_preop")), Reason.BAD_FRAME),
    "a negative stamp": (damaged(lambda c: setattr(c.header.stamp, "sec", -1)), Reason.BAD_FIELDS),
    "a stamp beyond the last second": (damaged(overflow), Reason.BAD_FIELDS),
    "all NaN": (np.full((500, 3), np.nan), Reason.NON_FINITE),
    "all infinite": (np.full((500, 3), np.inf), Reason.NON_FINITE),
    "all at the sensor's origin": (np.zeros((500, 3)), Reason.NON_FINITE),
    "millimetres given as metres": (GOOD * 1000.0, Reason.UNIT_MISMATCH),
    "far too large in any unit": (GOOD * 1e5, Reason.UNIT_MISMATCH),
    "larger than a country": (GOOD * 1e9, Reason.BAD_FIELDS),
    "wrong field types": (INTEGERS, Reason.BAD_FIELDS),
    "no fields": (damaged(lambda c: c.fields.clear()), Reason.BAD_FIELDS),
    "truncated data": (damaged(lambda c: setattr(c, "data", c.data[:-7])), Reason.BAD_FIELDS),
    "data for fewer points than it says": (damaged(lambda c: setattr(c, "width", 2_000_000_000)), Reason.BAD_FIELDS),
}


@pytest.mark.parametrize("name", BAD_INPUT)
def test_bad_input_is_refused_with_its_reason_and_survived(live, name):
    cloud, reason = BAD_INPUT[name]
    expect_refusal(live, cloud, reason)
    expect_good(live)


def test_metres_given_as_millimetres_are_named(live):
    live[0].set_parameters_atomically([Parameter("cloud_unit", value="mm")])
    expect_refusal(live, GOOD, Reason.UNIT_MISMATCH, "looks like metres")


@pytest.mark.parametrize(
    "data", [b"", b"\x00\x01\x00\x00", b"\x00\x01\x00\x00garbage that is no cloud", b"\xff" * 4000]
)
def test_bytes_that_are_no_message_are_refused_and_survived(live, data):
    expect_refusal(live, data, Reason.BAD_FIELDS)
    assert live[1].values("input")["level"] == 2
    expect_good(live)
    assert live[1].values("input")["level"] == 0


def test_five_million_points_are_thinned_and_answered(live):
    cloud = np.random.default_rng(0).normal(size=(5_000_000, 3)).astype(np.float32) * 0.02
    node, client, method = live
    values = client.ask(cloud)
    assert values["level"] == 0, values
    assert (values["points_in"], values["points_used"]) == ("5000000", "60000")


def test_an_old_cloud_is_stale(live):
    live[0].set_parameters_atomically([Parameter("max_cloud_age", value=0.5)])
    expect_refusal(live, GOOD, Reason.STALE, "max_cloud_age is 0.5", stamp_s=time.time() - 10.0)
    expect_good(live)


@pytest.mark.parametrize("together", [0, 4])
@pytest.mark.parametrize(("factor", "reason", "said"), [
    (1000.0, Reason.UNIT_MISMATCH, "looks like .*millimetres"), (1e12, Reason.BAD_FIELDS, "is_bigendian"),
    (1e3 * 1e3, Reason.UNIT_MISMATCH, "crop box"),
])  # fmt: skip
def test_a_cloud_that_is_far_too_large_is_refused_with_what_may_be_wrong(factor, reason, said, together):
    """Collected clouds too, which may be of any size but this one."""
    given = NodeParameters(accumulate=together)
    cloud = xyz_to_cloud(GOOD * factor, Header(frame_id="probe"))
    with pytest.raises(RefusedError, match=said) as caught:
        cloud_room.take_in(cloud, 150.0, given)
    assert caught.value.reason is reason


@pytest.mark.parametrize(
    ("answer", "reason", "text"),
    [
        (RegistrationResult(RegistrationStatus.AMBIGUOUS, reason="two poses fit"), Reason.AMBIGUOUS, "two poses fit"),
        (RegistrationResult(RegistrationStatus.DEGENERATE, reason="spin"), Reason.DEGENERATE, "spin"),
        (RegistrationResult(RegistrationStatus.LOW_CONFIDENCE, confidence=0.4), Reason.LOW_CONFIDENCE, ""),
        (RegistrationResult(RegistrationStatus.TOO_FEW_POINTS), Reason.TOO_FEW_POINTS, ""),
        (accepted(confidence=0.49), Reason.LOW_CONFIDENCE, "min_confidence is 0.5"),
        (accepted(confidence=float("nan")), Reason.LOW_CONFIDENCE, ""),
        (accepted(np.full((4, 4), np.nan)), Reason.NOT_CONVERGED, "no finite pose"),
        (accepted(covariance=None), Reason.NOT_CONVERGED, "no finite covariance"),
        (accepted(covariance=np.full((6, 6), np.inf)), Reason.NOT_CONVERGED, "no finite covariance"),
    ],
)
def test_what_the_method_refuses_or_cannot_stand_for_has_no_pose(live, answer, reason, text):
    live[2].answer = answer
    expect_refusal(live, GOOD, reason, text)
    live[2].answer = accepted()
    expect_good(live)


@pytest.mark.parametrize(
    ("error", "reason", "text"),
    [
        (RuntimeError("singular"), Reason.NOT_CONVERGED, "RuntimeError: singular"),
        (InvalidPointCloudError("a bone", "3 m", "check the unit"), Reason.UNIT_MISMATCH, "got 3 m"),
        (
            InvalidViewpointError("a viewpoint outside the cloud", "0 0 0", "move it"),
            Reason.BAD_FRAME,
            "parameter viewpoint",
        ),
        (MemoryError(), Reason.NOT_CONVERGED, "MemoryError"),
    ],
)
def test_an_exception_of_the_method_is_a_refusal(live, error, reason, text):
    live[2].error = error
    expect_refusal(live, GOOD, reason, text)
    live[2].error = None
    expect_good(live)


@pytest.mark.parametrize(
    ("name", "limit", "reason"),
    [("min_confidence", 0.95, "low_confidence: confidence 0.90"), ("max_tre", 0.001, "imprecise: the 95 % bound")],
)
def test_a_limit_that_is_set_while_a_cloud_is_on_its_way_holds_for_it(live, name, limit, reason):
    node, client, method = live
    expect_good(live)
    poses, before = len(client.poses), len(method.calls)
    method.answer = accepted(tre95_mm=2.0)
    method.gate.clear()
    client.send(GOOD)
    wait_until(lambda: len(method.calls) > before)
    refused = node.counters.refused
    assert node.set_parameters_atomically([Parameter(name, value=limit)]).successful
    method.gate.set()
    wait_until(lambda: node.counters.refused > refused and client.values()["last_refusal"].startswith(reason))
    assert len(client.poses) == poses


def test_a_jump_beyond_the_limit_is_refused_until_a_reset(live):
    node, client, method = live
    node.set_parameters_atomically([Parameter("max_jump_translation", value=0.01)])
    expect_good(live)
    client.poses.clear()
    client.statuses.clear()
    method.answer = accepted(pose_mm([0, 0, 0], [30.0, 0, 0]))
    expect_refusal(live, GOOD, Reason.JUMP, "moved 0.03 m, max_jump_translation is 0.01 m; call ~/reset")
    client.call("reset")
    expect_good(live)


def test_a_seed_in_a_frame_that_nobody_knows_is_not_used(live):
    node, client, method = live
    seed = PoseWithCovarianceStamped(header=Header(frame_id="map"))
    wait_until(client.seeds.get_subscription_count)
    client.seeds.publish(seed)
    wait_until(lambda: node.session.gate.initial_pose)
    expect_good(live)
    assert method.calls[-1]["initial"] is None and node.session.gate.initial_pose is None


@pytest.mark.parametrize(("frame", "is_a_jump"), [("probe", False), ("map", True)])
def test_a_jump_is_none_where_the_pose_was_found_from_a_seed_and_only_there(live, monkeypatch, frame, is_a_jump):
    node, client, method = live
    node.set_parameters_atomically([Parameter("max_jump_translation", value=0.01)])
    expect_good(live)
    wait_until(client.seeds.get_subscription_count)
    client.seeds.publish(PoseWithCovarianceStamped(header=Header(frame_id=frame)))
    wait_until(lambda: node.session.gate.initial_pose)
    method.answer = accepted(pose_mm([0, 0, 0], [30.0, 0, 0]))
    if is_a_jump:
        client.poses.clear()
        assert client.ask(GOOD)["last_refusal"].startswith("jump: moved 0.03 m") and not client.poses
    else:
        expect_good(live)


def test_seeds_are_logged_whether_they_are_taken_or_not_and_a_flood_of_them_is_not(live, monkeypatch):
    node, client, method = live
    said = []
    for how in ("info", "warning"):
        monkeypatch.setattr(node.get_logger(), how, lambda text, **options: said.append((text, options)), raising=False)
    seeds = [PoseWithCovarianceStamped(header=Header(frame_id=name)) for name in ("probe", "bone_preop", "probe")]
    seeds[0].pose.pose.position.x = np.nan
    for seed in seeds:
        node.call_soon(partial(node.session.take_initial_pose, seed))
    wait_until(lambda: len(said) == 3, what=lambda: said)
    assert [options for _, options in said] == [{"throttle_duration_sec": 5.0}] * 3
    assert said[0][0].startswith("initialpose is ignored") and said[1][0].startswith("initialpose is ignored: it is in")
    assert said[2][0] == "initialpose in 'probe' is taken: the track is forgotten"


def test_a_seed_in_the_bones_own_frame_changes_nothing(live):
    node, client, method = live
    wait_until(client.seeds.get_subscription_count)
    epoch = node.session.gate.epoch
    for frame in ("/bone_preop", ""):
        client.seeds.publish(PoseWithCovarianceStamped(header=Header(frame_id=frame)))
        time.sleep(0.2)  # the node hears the newest one only
    wait_until(lambda: node.session.gate.initial_pose)
    assert node.session.gate.epoch == epoch + 1, "that of the second one"


def test_a_turn_beyond_the_limit_is_refused(live):
    node, client, method = live
    node.set_parameters_atomically([Parameter("max_jump_rotation", value=0.1)])
    expect_good(live)
    client.poses.clear()
    client.statuses.clear()
    method.answer = accepted(pose_mm([0, 0, 0.3], [0, 0, 0]))
    expect_refusal(live, GOOD, Reason.JUMP, "turned 0.3 rad")


def test_neither_another_frame_nor_a_pause_takes_the_limit_of_jumps_away(live):
    node, client, method = live
    node.set_parameters_atomically([Parameter("max_jump_translation", value=0.01)])
    expect_good(live)
    moved = accepted(pose_mm([0, 0, 0], [50.0, 0, 0]))
    assert client.ask(GOOD, frame="other")["level"] == 0
    method.answer = moved
    assert client.ask(GOOD)["last_refusal"].startswith("jump: moved 0.05 m")
    for enabled in (False, True):
        assert client.call("set_enabled", SetBool.Request(data=enabled)).success
    assert client.ask(GOOD)["last_refusal"].startswith("jump: moved 0.05 m")
    assert client.ask(GOOD, frame="other")["last_refusal"].startswith("jump: moved 0.05 m")
    method.answer = accepted()
    assert client.ask(GOOD)["level"] == 0


def test_a_pause_does_not_forget_where_to_start(live):
    node, client, method = live
    client.seeds.publish(PoseWithCovarianceStamped(header=Header(frame_id="probe")))
    wait_until(lambda: node.session.gate.initial_pose is not None)
    for enabled in (False, True):
        assert client.call("set_enabled", SetBool.Request(data=enabled)).success
    assert node.session.gate.initial_pose is not None


def test_a_reset_refuses_the_cloud_on_its_way(live):
    node, client, method = live
    before = len(method.calls)
    method.gate.clear()
    client.send(GOOD)
    wait_until(lambda: len(method.calls) > before)
    received = node.counters.received
    client.send(GOOD)
    wait_until(lambda: node.counters.received == received + 1)
    client.call("reset")
    method.gate.set()
    wait_until(lambda: node.counters.consecutive_refusals == 2)
    # The next answer must not be the last one of these.
    wait_until(lambda: int(client.values()["frames_refused"]) == node.counters.refused)
    assert client.values()["last_refusal"].endswith("a reset")
    assert client.values()["last_refusal"].startswith("superseded_by_reset")
    assert len(method.calls) == before + 1, "the waiting cloud is not even registered"
    expect_good(live)


def test_refusals_whose_reasons_alternate_do_not_fill_the_log(monkeypatch):
    lines, now = [], [0.0]
    monkeypatch.setattr(report.time, "monotonic", lambda: now[0])
    log = report.RefusalLog(lines.append)
    for tenths in range(52):
        now[0] = tenths / 10.0
        log(Outcome(Job(b"", 0, 0), "probe", reason=[Reason.AMBIGUOUS, Reason.STALE][tenths % 2]))
    assert lines == ["refused (ambiguous)", "refused (stale)", "refused (ambiguous) (+24)", "refused (stale) (+24)"]
