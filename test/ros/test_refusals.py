"""Every reason to refuse, on a live node: confidence 0, no pose, the reason in the diagnostics, the next is fine."""

from __future__ import annotations

import time
from functools import partial

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from harness import StandIn, accepted, node_in_thread, pose_mm, wait_until
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from scipy.spatial import cKDTree
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header
from std_srvs.srv import SetBool

from gapr_core.errors import InvalidPointCloudError, InvalidViewpointError
from gapr_core.results import RegistrationResult, RegistrationStatus
from gapr_core.surface import Surface
from gapr_ros.node import diagnostics, initial_pose, intake
from gapr_ros.node.model import Model
from gapr_ros.node.outcome import Outcome
from gapr_ros.node.refusal import Reason, RefusedError
from gapr_ros.node.registration import Registration
from gapr_ros.node.situation import InitialPose, Situation
from gapr_ros.node.worker import Job
from gapr_ros.parameters import NodeParameters
from msg_adapters import xyz_to_cloud

CHANGED = ("max_cloud_age", "timeout", "min_confidence", "cloud_unit", "max_jump_translation", "max_jump_rotation",
           "require_consecutive", "range_min", "range_max", "max_tre")  # fmt: skip
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
    client.confidences.clear()
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
    assert values["level"] == 1 and values["confidence"] == "0"
    wait_until(lambda: client.confidences)
    assert client.confidences == [0.0] and not client.poses


def expect_good(live):
    node, client, method = live
    values = client.ask(GOOD)
    assert values["level"] == 0, values
    wait_until(lambda: client.poses and client.confidences)


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
    "five points": (GOOD[:5], Reason.TOO_FEW_POINTS),
    "all NaN": (np.full((500, 3), np.nan), Reason.NON_FINITE),
    "all infinite": (np.full((500, 3), np.inf), Reason.NON_FINITE),
    "all at the sensor's origin": (np.zeros((500, 3)), Reason.NON_FINITE),
    "NaN but for 100 points": (np.vstack([np.full((500, 3), np.nan), GOOD[:100]]), Reason.TOO_FEW_POINTS),
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


def test_millimetres_are_named(live):
    expect_refusal(live, GOOD * 1000.0, Reason.UNIT_MISMATCH, "looks like millimetres: ")


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


def test_a_cloud_cut_off_on_the_wire_is_refused(live):
    from rclpy.serialization import serialize_message

    whole = serialize_message(xyz_to_cloud(GOOD.astype(np.float32), Header(frame_id="probe")))
    expect_refusal(live, whole[: len(whole) // 2], Reason.BAD_FIELDS)
    expect_good(live)


def test_five_million_points_are_thinned_and_answered(live):
    cloud = np.random.default_rng(0).normal(size=(5_000_000, 3)).astype(np.float32) * 0.02
    node, client, method = live
    node.set_parameters_atomically([Parameter("timeout", value=60.0)])
    values = client.ask(cloud)
    assert values["level"] == 0, values
    assert (values["points_in"], values["points_used"]) == ("5000000", "200000")


def test_an_old_cloud_is_stale(live):
    live[0].set_parameters_atomically([Parameter("max_cloud_age", value=0.5)])
    expect_refusal(live, GOOD, Reason.STALE, "max_cloud_age is 0.5", stamp_s=time.time() - 10.0)
    expect_good(live)


def send_slowly(live):
    """A cloud whose registration takes longer than `timeout`."""
    node, client, method = live
    node.set_parameters_atomically([Parameter("timeout", value=0.05)])
    before = len(method.calls)
    method.gate.clear()
    client.send(GOOD)
    wait_until(lambda: len(method.calls) > before)
    time.sleep(0.1)
    method.gate.set()


def test_a_slow_registration_times_out(live):
    client = live[1]
    send_slowly(live)
    wait_until(lambda: client.values()["last_refusal"].startswith("timeout: took ") and client.confidences)
    assert client.confidences == [0.0] and not client.poses


def test_what_the_method_refused_after_a_long_time_is_its_reason_and_not_the_time(live):
    """With another bone every cloud took long, and was refused as `timeout`: the users raised the limit."""
    _, client, method = live
    method.answer = RegistrationResult(RegistrationStatus.AMBIGUOUS, reason="two poses fit")
    send_slowly(live)
    why = "ambiguous: two poses fit"
    wait_until(lambda: client.values()["last_refusal"] == why and client.confidences, what=client.values)


class Slow:
    """Frames of which each comes after a while, if the wait is long enough."""

    def __init__(self, seconds):
        self.seconds, self.waits = seconds, []

    def lookup(self, parent, child, stamp, timeout_s, most_gap_s, arrived_s):
        assert most_gap_s == NodeParameters().max_tf_gap and arrived_s <= time.monotonic()
        self.waits.append(timeout_s)
        time.sleep(min(self.seconds, timeout_s))
        if timeout_s < self.seconds:
            raise RefusedError(Reason.TF_MISSING, f"{parent} <- {child}: not there")
        return np.eye(4)


def processed(frames, **parameters):
    """What became of a cloud whose frames come late."""
    method, given = StandIn(), NodeParameters(cloud_type="PointCloud2", **parameters)
    points = np.random.default_rng(0).normal(size=(500, 3)) * [60.0, 20.0, 15.0]
    model = Model("blob.npy", Surface(points), points, Surface(points).extent_mm, cKDTree(points))
    now = Situation(method, model, given, 0, 0, "", None, None, 0)
    cloud = serialize_message(xyz_to_cloud(GOOD.astype(np.float32), Header(frame_id="probe")))
    return Registration(frames, lambda: now, lambda *_: None).process(Job(cloud, 0, 0))


def test_the_wait_for_a_transform_is_no_time_of_the_registration():
    outcome = processed(Slow(0.3), output_frame="ref", tf_timeout=1.0, timeout=0.25)
    assert outcome.ok and outcome.tf_wait_s == pytest.approx(0.3, abs=0.1)


class Away:
    """Frames that are so far apart, m."""

    def __init__(self, x_m):
        self.T = np.eye(4)
        self.T[0, 3] = x_m

    def lookup(self, *_):
        return self.T


@pytest.mark.parametrize(("x_m", "is_refused"), [(49.9, False), (50.1, True), (-700.0, True)])
def test_a_transform_that_leads_out_of_any_room_is_refused(x_m, is_refused):
    """/tf in millimetres: poses 955 m off went out as OK."""
    outcome = processed(Away(x_m), output_frame="ref")
    assert outcome.ok is not is_refused
    if is_refused:
        assert outcome.reason is Reason.BAD_FRAME
        assert outcome.text.startswith(f"output_frame: 'probe' is {abs(x_m):.0f} m from 'ref': ")
        assert "in millimetres?" in outcome.text


@pytest.mark.parametrize("together", [0, 4])
@pytest.mark.parametrize(("factor", "reason", "said"), [
    (1000.0, Reason.UNIT_MISMATCH, "looks like .*millimetres"), (1e12, Reason.BAD_FIELDS, "is_bigendian"),
    (1e3 * 1e3, Reason.UNIT_MISMATCH, "range_max"),
])  # fmt: skip
def test_a_cloud_that_is_far_too_large_is_refused_with_what_may_be_wrong(factor, reason, said, together):
    """With `accumulate` a cloud in mm was answered with range_max, and swapped bytes always were."""
    given = NodeParameters(cloud_type="PointCloud2", accumulate=together)
    cloud = xyz_to_cloud(GOOD * factor, Header(frame_id="probe"))
    with pytest.raises(RefusedError, match=said) as caught:
        intake.take_in(cloud, 150.0, given)
    assert caught.value.reason is reason


def test_a_few_points_of_wild_bytes_do_not_refuse_a_cloud_that_is_in_range():
    wild = np.vstack([GOOD, np.full((100, 3), 1e9) * np.random.default_rng(0).random((100, 3))])
    given = NodeParameters(cloud_type="PointCloud2", range_max=10.0)
    assert len(intake.take_in(xyz_to_cloud(wild, Header(frame_id="probe")), 150.0, given)) == len(GOOD)


def test_all_transforms_of_a_cloud_share_one_wait_and_a_missing_one_names_who_asks_for_it():
    frames = Slow(0.3)
    corners = {"crop_min": (-1.0, -1.0, -1.0), "crop_max": (1.0, 1.0, 1.0)}
    outcome = processed(frames, output_frame="ref", crop_frame="box", tf_timeout=0.5, **corners)
    assert outcome.reason is Reason.TF_MISSING and outcome.text == "crop_frame: box <- probe: not there"
    assert frames.waits == [0.5, pytest.approx(0.2, abs=0.1)]


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
    client.confidences.clear()
    method.answer = accepted(pose_mm([0, 0, 0], [30.0, 0, 0]))
    expect_refusal(live, GOOD, Reason.JUMP, "moved 0.03 m, max_jump_translation is 0.01 m; call ~/reset")
    client.call("reset")
    expect_good(live)


def test_a_jump_ends_the_row_of_good_poses(live):
    node, client, method = live
    expect_good(live)
    node.set_parameters_atomically([Parameter("max_jump_translation", value=0.01),
                                    Parameter("require_consecutive", value=2)])  # fmt: skip
    client.poses.clear()
    client.confidences.clear()
    for position_mm, reason in ((0.0, None), (30.0, Reason.JUMP), (0.0, Reason.LOW_CONFIDENCE), (0.0, None)):
        method.answer = accepted(pose_mm([0, 0, 0], [position_mm, 0, 0]))
        values = client.ask(GOOD)
        assert values["last_refusal"].startswith(reason or "") and (values["level"] == 0) == (reason is None)


def test_a_single_point_metres_away_is_refused_with_the_way_to_fix_it(live):
    expect_refusal(live, np.vstack([GOOD, [[3.0, 0.0, 0.0]]]), Reason.UNIT_MISMATCH, "set range_max")


def test_a_seed_in_a_frame_that_nobody_knows_is_named(live):
    node, client, method = live
    seed = PoseWithCovarianceStamped(header=Header(frame_id="map"))
    wait_until(client.seeds.get_subscription_count)
    client.seeds.publish(seed)
    wait_until(lambda: node.session.course.initial_pose)
    expect_refusal(live, GOOD, Reason.TF_MISSING, "the initialpose is in map")
    client.call("reset")
    expect_good(live)


def test_a_seed_whose_frame_does_not_come_is_given_up_and_no_cloud_is_registered_with_it(live, monkeypatch):
    node, client, method = live
    wait_until(client.seeds.get_subscription_count)
    client.seeds.publish(PoseWithCovarianceStamped(header=Header(frame_id="map")))
    wait_until(lambda: node.session.course.initial_pose)
    registered = len(method.calls)
    expect_refusal(live, GOOD, Reason.TF_MISSING, "given up if that lasts 2 s; remap it if it is of another node")
    monkeypatch.setattr(initial_pose, "PATIENCE_S", 0.0)  # it has lasted
    assert len(method.calls) == registered
    expect_good(live)
    assert [call["initial"] for call in method.calls[registered:]] == [None]


@pytest.mark.parametrize(("frame", "is_a_jump"), [("probe", False), ("map", True)])
def test_a_jump_is_none_where_the_pose_was_found_from_a_seed_and_only_there(live, monkeypatch, frame, is_a_jump):
    node, client, method = live
    node.set_parameters_atomically([Parameter("max_jump_translation", value=0.01)])
    expect_good(live)
    wait_until(client.seeds.get_subscription_count)
    client.seeds.publish(PoseWithCovarianceStamped(header=Header(frame_id=frame)))
    wait_until(lambda: node.session.course.initial_pose)
    method.answer = accepted(pose_mm([0, 0, 0], [30.0, 0, 0]))
    if is_a_jump:
        assert client.ask(GOOD)["last_refusal"].startswith("tf_missing: the initialpose is in map")
        monkeypatch.setattr(initial_pose, "PATIENCE_S", 0.0)  # it has lasted
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
    epoch = node.session.course.epoch
    for frame in ("/bone_preop", ""):
        client.seeds.publish(PoseWithCovarianceStamped(header=Header(frame_id=frame)))
        time.sleep(0.2)  # the node hears the newest one only
    wait_until(lambda: node.session.course.initial_pose)
    assert node.session.course.epoch == epoch + 1, "that of the second one"


def test_a_seed_is_given_up_only_when_its_frame_is_missing_without_a_break(monkeypatch):
    now, there = [0.0], [False]
    monkeypatch.setattr(initial_pose.time, "monotonic", lambda: now[0])

    def find(given):
        if there[0]:
            return given.T_frame_model
        raise RefusedError(Reason.TF_MISSING, "not there")

    starts, given = initial_pose.InitialPoses(), InitialPose(np.eye(4), "map")
    for seconds, comes in ((0.0, False), (1.9, False), (2.5, True), (2.6, False), (4.5, False), (5.0, True)):
        now[0], there[0] = seconds, comes
        if comes:
            assert starts.start(given, find) is given.T_frame_model
        else:
            with pytest.raises(RefusedError, match="the initialpose is in map: not there"):
                starts.start(given, find)
    there[0], other = False, InitialPose(np.eye(4), "map")
    for seconds, each in ((6.0, given), (7.9, other)):  # another one has its own time
        now[0] = seconds
        with pytest.raises(RefusedError):
            starts.start(each, find)
    now[0] = 9.9
    assert starts.start(other, find) is None
    there[0] = True
    assert starts.start(other, find) is None, "given up for good"


def test_a_turn_beyond_the_limit_is_refused(live):
    node, client, method = live
    node.set_parameters_atomically([Parameter("max_jump_rotation", value=0.1)])
    expect_good(live)
    client.poses.clear()
    client.confidences.clear()
    method.answer = accepted(pose_mm([0, 0, 0.3], [0, 0, 0]))
    expect_refusal(live, GOOD, Reason.JUMP, "turned 0.3 rad")


def test_a_pose_goes_out_after_enough_good_ones_in_a_row(live):
    node, client, method = live
    node.set_parameters_atomically([Parameter("require_consecutive", value=3)])
    assert "1 of 3" in client.ask(GOOD)["last_refusal"]
    assert "2 of 3" in client.ask(GOOD)["last_refusal"]
    assert "empty_cloud" in client.ask(np.empty((0, 3)))["last_refusal"]
    assert "1 of 3" in client.ask(GOOD)["last_refusal"]
    assert "2 of 3" in client.ask(GOOD)["last_refusal"]
    assert client.ask(GOOD)["level"] == 0
    wait_until(lambda: client.confidences == [0.0] * 5 + [0.9] and len(client.poses) == 1)


def test_one_cloud_is_one_good_pose_however_often_it_is_registered(live):
    node, client, method = live
    node.set_parameters_atomically([Parameter("require_consecutive", value=3)])
    assert "1 of 3" in client.ask(GOOD)["last_refusal"]
    for _ in range(4):
        assert "1 of 3" in client.call("register").message
    assert "2 of 3" in client.ask(GOOD)["last_refusal"]
    assert "2 of 3" in client.call("register").message
    assert client.ask(GOOD)["level"] == 0
    assert client.call("register").success


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
    wait_until(lambda: node.session.course.initial_pose is not None)
    for enabled in (False, True):
        assert client.call("set_enabled", SetBool.Request(data=enabled)).success
    assert node.session.course.initial_pose is not None


def test_a_pause_ends_the_row_of_good_poses(live):
    node, client, method = live
    node.set_parameters_atomically([Parameter("require_consecutive", value=2)])
    assert "1 of 2" in client.ask(GOOD)["last_refusal"]
    for enabled in (False, True):
        assert client.call("set_enabled", SetBool.Request(data=enabled)).success
    assert "1 of 2" in client.ask(GOOD)["last_refusal"]


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
    wait_until(lambda: client.confidences == [0.0, 0.0])
    # The next answer must not be the last one of these.
    wait_until(lambda: int(client.values()["frames_refused"]) == node.counters.refused)
    assert client.values()["last_refusal"].endswith("a reset")
    assert client.values()["last_refusal"].startswith("superseded_by_reset")
    assert len(method.calls) == before + 1, "the waiting cloud is not even registered"
    expect_good(live)


def test_the_range_is_limited_on_both_sides(live):
    node, client, method = live
    near, middle, far = (direction(radius) for radius in (0.05, 0.2, 0.6))
    node.set_parameters_atomically([Parameter("range_min", value=0.1), Parameter("range_max", value=0.5)])
    assert client.ask(np.vstack([near, middle, far]))["points_used"] == "300"


def direction(radius: float) -> np.ndarray:
    vectors = np.random.default_rng(3).normal(size=(300, 3))
    return radius * vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_refusals_whose_reasons_alternate_do_not_fill_the_log(monkeypatch):
    lines, now = [], [0.0]
    monkeypatch.setattr(diagnostics.time, "monotonic", lambda: now[0])
    log = diagnostics.RefusalLog(lines.append)
    for tenths in range(52):
        now[0] = tenths / 10.0
        log(Outcome(Job(b"", 0, 0), "probe", reason=[Reason.AMBIGUOUS, Reason.STALE][tenths % 2]))
    assert [line.split(" refused: ")[1] for line in lines] == [
        "ambiguous", "stale", "ambiguous (24 more of these since the last line)",
        "stale (24 more of these since the last line)",
    ]  # fmt: skip
