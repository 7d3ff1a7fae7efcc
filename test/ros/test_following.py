"""Clouds between two that are assessed: on ~/followed_pose alone, and only while what they rest on stands."""

from __future__ import annotations

from types import SimpleNamespace

import bones
import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from harness import NODE, Client, NodeProcess, StandIn, accepted, node_in_thread, pose_mm, wait_until
from lifecycle_msgs.msg import Transition
from rclpy.parameter import Parameter
from rclpy.time import Time
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger

from gapr_core import FollowedPose
from gapr_core.geometry import se3
from gapr_core.results import RegistrationResult, RegistrationStatus
from gapr_ros import parameters as node_parameters
from gapr_ros.node import frames, units
from gapr_ros.node.course import Course
from gapr_ros.node.model import Model
from gapr_ros.node.outcome import Found, Outcome
from gapr_ros.node.refusal import Reason
from gapr_ros.node.timeline import Timeline
from gapr_ros.node.worker import Job
from gapr_ros.parameters import NodeParameters
from msg_adapters import pose_to_matrix

GOOD = np.random.default_rng(1).normal(size=(1000, 3)) * 0.02
T_ASSESSED = pose_mm([0.3, -1.1, 0.7], [120.0, -40.0, 300.0])
T_FOLLOWED = se3.exp([3.0, 0.0, 0.0, 0.0, 0.0, 0.0]) @ T_ASSESSED
REFUSED = RegistrationResult(RegistrationStatus.LOW_CONFIDENCE, reason="for the test")


class Follows(StandIn):
    """A stand-in that follows where a test lets it; `gate` holds it back as well."""

    def __init__(self):
        super().__init__()
        self.answer, self.found = accepted(T_ASSESSED), FollowedPose(T_FOLLOWED, 0.9, 0.5, 1)
        self.follows = []

    def follow(self, source, target):
        self.follows.append(source)
        assert self.gate.wait(60.0)
        return self.found


class Watch:
    """A node with its client: sends clouds one by one, and hears ~/followed_pose and /tf."""

    def __init__(self, node, client, method, on_tf):
        self.node, self.client, self.method, self.on_tf = node, client, method, on_tf
        self.followed = []
        client.do(
            lambda: client.node.create_subscription(PoseStamped, f"{NODE}/followed_pose", self.followed.append, 99)
        )
        topic = node.session._publishers._topics["followed_pose"]
        wait_until(topic.get_subscription_count, what="the subscription to ~/followed_pose")

    @property
    def counts(self):
        c = self.node.counters
        return {"accepted": c.accepted, "refused": c.refused, "followed": c.followed, "dropped": c.dropped}

    def send(self, *stamps_s, frame="probe"):
        for stamp_s in stamps_s:
            before = sum(self.counts.values())
            self.client.send(GOOD, frame=frame, stamp_s=stamp_s)
            wait_until(lambda before=before: sum(self.counts.values()) == before + 1, what=lambda: self.counts)

    def heard(self, count):
        """Stamps of ~/followed_pose, once there are so many."""
        wait_until(lambda: len(self.followed) >= count, what=lambda: f"{count} followed poses, {self.counts}")
        return [message.header.stamp.sec for message in self.followed]


@pytest.fixture
def watch(blob_path, client, monkeypatch):
    """Starts a node that assesses every so many clouds."""
    running, on_tf = [], []

    class Broadcaster:
        def __init__(self, node):
            self.pub_tf = node.create_publisher(PoseStamped, "unused", 1)

        def sendTransform(self, transform):  # noqa: N802
            on_tf.append(transform.header.stamp.sec)

    monkeypatch.setattr(frames, "_import_tf2", lambda: SimpleNamespace(TransformBroadcaster=Broadcaster))

    def start(assess_every=3, **parameters):
        method = Follows()
        running.append(node_in_thread(method, blob_path, assess_every=assess_every, publish_tf=True, **parameters))
        node = running[-1].__enter__()
        client.wait_for_state("active")
        return Watch(node, client, method, on_tf)

    yield start
    for each in running:
        each.__exit__(None, None, None)


def stamps(messages):
    return [message.header.stamp.sec for message in messages]


def test_one_of_three_clouds_is_assessed_and_the_others_go_to_followed_pose_alone(watch):
    live = watch(assess_every=3)
    live.send(*range(10, 17))
    assert live.heard(4) == [11, 12, 14, 15]
    wait_until(lambda: len(live.client.poses) == len(live.client.confidences) == len(live.client.transforms) == 3)
    assert stamps(live.client.poses) == stamps(live.client.transforms) == live.on_tf == [10, 13, 16]
    assert live.client.confidences == [0.9] * 3 and len(live.method.follows) == 4
    assert live.counts == {"accepted": 3, "refused": 0, "followed": 4, "dropped": 0}
    wait_until(lambda: live.client.values().get("frames_followed") == "4")
    wait_until(lambda: live.client.values()["cloud_stamp"].startswith("16."))
    message = live.followed[0]
    expected = se3.inverse(T_FOLLOWED)
    expected[:3, 3] /= 1000.0
    np.testing.assert_allclose(pose_to_matrix(message), expected, atol=1e-12)
    assert message.header == Header(frame_id="probe", stamp=Time(seconds=11).to_msg())


def test_every_cloud_is_assessed_unless_asked_otherwise(watch):
    live = watch(assess_every=1)
    live.send(*range(10, 14))
    assert live.counts["accepted"] == 4 and not live.method.follows


def test_a_cloud_that_cannot_be_followed_is_assessed_at_once(watch):
    live = watch(assess_every=3)
    live.send(10, 11)
    live.method.found = None
    live.send(12)
    assert live.counts == {"accepted": 2, "refused": 0, "followed": 1, "dropped": 0}
    np.testing.assert_array_equal(live.method.calls[-1]["source"], live.method.follows[-1])
    live.method.found = FollowedPose(np.full((4, 4), np.nan), 0.9, 0.5, 1)
    live.send(13)
    live.method.found = FollowedPose(T_FOLLOWED, 0.9, 0.5, 1)
    live.send(14, 15, 16)
    assert live.heard(3) == [11, 14, 15]
    wait_until(lambda: len(live.client.poses) == 4)
    assert stamps(live.client.poses) == [10, 12, 13, 16]


def test_nothing_is_followed_after_a_refusal_until_a_cloud_is_accepted(watch):
    live = watch(assess_every=4)
    live.send(10, 11)
    live.method.found, live.method.answer = None, REFUSED
    live.send(12)
    live.method.found = FollowedPose(T_FOLLOWED, 0.9, 0.5, 1)
    live.send(13, 14)
    assert live.counts["refused"] == 3 and live.heard(1) == [11]
    live.method.answer = accepted(T_ASSESSED)
    live.send(15, 16)
    assert live.heard(2) == [11, 16]


def test_nothing_is_followed_while_there_are_too_few_good_poses_in_a_row(watch):
    live = watch(assess_every=3)
    live.send(10, 11)
    assert live.node.set_parameters([Parameter("require_consecutive", value=3)])[0].successful
    live.send(12, 13, 14, 15)
    assert live.heard(3) == [11, 12, 15] and live.counts == {"accepted": 2, "refused": 1, "followed": 3, "dropped": 0}


@pytest.mark.parametrize("cloud", [np.zeros((5, 3)), np.full((500, 3), np.nan)])
def test_nor_after_a_cloud_that_could_not_be_read(watch, cloud):
    live = watch(assess_every=9)
    live.send(10, 11)
    live.client.ask(cloud, stamp_s=12.0)
    live.send(13, 14)
    assert live.heard(2) == [11, 14] and live.counts["refused"] == 1


def test_a_cloud_that_is_refused_for_its_stamp_changes_nothing(watch):
    live = watch(assess_every=9)
    live.send(10, 11, 5, 12)
    assert live.heard(2) == [11, 12] and live.node.counters.last_refusal.startswith("stale")


def test_nor_after_an_error_of_the_method_and_the_error_is_a_refusal(watch):
    live = watch(assess_every=9)
    live.send(10)

    def broken(source, target):
        raise ValueError("for the test")

    live.method.follow = broken
    live.send(11)
    del live.method.follow
    live.send(12, 13)
    assert live.heard(1) == [13] and live.counts == {"accepted": 2, "refused": 1, "followed": 1, "dropped": 0}


@pytest.mark.parametrize("service", ["reset", "reload_model"])
def test_nothing_is_followed_after_a_reset_or_with_another_bone_until_a_cloud_is_accepted(watch, service):
    live = watch(assess_every=9)
    live.send(10, 11)
    assert live.client.call(service).success
    live.send(12, 13)
    assert live.heard(2) == [11, 13]


def test_nor_after_a_pause(watch):
    live = watch(assess_every=9)
    live.send(10, 11)
    for enabled in (False, True):
        assert live.client.call("set_enabled", SetBool.Request(data=enabled)).success
    live.send(12, 13)
    assert live.heard(2) == [11, 13]


def test_nor_in_another_frame_nor_after_a_guess(watch):
    live = watch(assess_every=9)
    live.send(10, 11)
    live.send(12, frame="other")
    live.send(13, frame="other")
    assert live.heard(2) == [11, 13]
    wait_until(live.client.seeds.get_subscription_count)
    live.client.seeds.publish(PoseWithCovarianceStamped(header=Header(frame_id="other")))
    wait_until(lambda: live.node.session.course.initial_pose)
    live.send(14, frame="other")
    live.send(15, frame="other")
    assert live.heard(3) == [11, 13, 15] and live.method.calls[-1]["initial"] is not None


END = {
    "other limits": lambda live: live.node.set_parameters([Parameter("min_confidence", value=0.95)]),
    "a reset": lambda live: live.client.call("reset"),
    "another bone": lambda live: live.node.session.replace(live.node.session._ready),
    "a pause": lambda live: live.client.call("set_enabled", SetBool.Request(data=False)),
    "a deactivation": lambda live: live.client.change_state(Transition.TRANSITION_DEACTIVATE),
}


@pytest.mark.parametrize("end", END)
def test_a_pose_that_is_being_followed_does_not_go_out_after(watch, end):
    live = watch(assess_every=9)
    live.send(10, 11)
    live.heard(1)
    live.method.gate.clear()
    live.client.send(GOOD, stamp_s=12.0)
    wait_until(lambda: len(live.method.follows) == 2)
    if end == "another bone":
        live.node.call_soon(lambda: END[end](live))
        wait_until(lambda: live.node.session.course.place is None)
    else:
        END[end](live)
    assert live.node.session.course.place is None
    live.method.gate.set()
    wait_until(lambda: live.counts["dropped"] == 1, what=lambda: live.counts)
    assert live.counts["followed"] == 1 and live.heard(1) == [11]


def test_a_followed_pose_beyond_the_limits_on_jumps_is_assessed_and_refused(watch):
    live = watch(assess_every=9, max_jump_translation=0.01)
    live.send(10, 11)
    far = se3.exp([20.0, 0.0, 0.0, 0.0, 0.0, 0.0]) @ T_ASSESSED
    live.method.found, live.method.answer = FollowedPose(far, 0.9, 0.5, 1), accepted(far)
    live.send(12)
    assert live.heard(1) == [11] and live.counts == {"accepted": 1, "refused": 1, "followed": 1, "dropped": 0}
    assert live.node.counters.last_refusal.startswith("jump")


def test_a_cloud_that_is_asked_for_is_assessed(watch):
    live = watch(assess_every=9)
    live.send(10, 11)
    assert live.client.call("register", Trigger.Request()).success
    assert live.counts["accepted"] == 2 and live.heard(1) == [11]


def test_a_followed_pose_that_took_too_long_is_refused(watch):
    live = watch(assess_every=9)
    live.send(10)
    assert live.node.set_parameters([Parameter("timeout", value=0.001)])[0].successful
    follow = live.method.follow
    live.method.follow = lambda source, target: (sum(range(3_000_000)), follow(source, target))[1]
    live.send(11)
    assert live.counts["refused"] == 1 and live.node.counters.last_refusal.startswith("timeout")


def test_followed_poses_are_in_the_order_of_their_stamps_and_newer_than_the_last_answer(watch):
    live = watch(assess_every=9)
    live.send(10.0)
    live.send(10.0, 11.5, 11.0, 12.0)
    assert live.heard(2) == [11, 12]
    assert live.counts == {"accepted": 1, "refused": 0, "followed": 2, "dropped": 2}


def test_after_time_starts_over_an_older_stamp_is_the_next():
    timeline, header = Timeline(), lambda stamp_s: Header(stamp=Time(seconds=stamp_s).to_msg())
    shown = [timeline.admit_shown(np.eye(4), header(stamp_s), GOOD) for stamp_s in (20, 19, 20, 21)]
    assert shown == [True, False, False, True]
    timeline.forget()
    assert timeline.admit_shown(np.eye(4), header(5), GOOD)
    unstamped = Timeline()
    assert [unstamped.admit_shown(np.eye(4), header(0), GOOD) for _ in range(2)] == [True, True], "no clock runs"


def decided(course, stamp_s, reason=None, **parameters):
    """Why a cloud gets no pose that was found, or refused for a reason, while it was on its way; empty if it does."""
    header = Header(frame_id="probe", stamp=Time(seconds=stamp_s).to_msg())
    outcome = Outcome(Job(b"", course.epoch, 0), "probe", header, result=accepted(tre95_mm=2.0))
    outcome.found = Found(np.eye(4), np.eye(6))
    if reason:
        outcome.refuse(reason, "for the test")
    course.decide(outcome, Model("bone.npy", None, GOOD * 1000.0, 100.0, None), NodeParameters(**parameters))
    return outcome.text


@pytest.mark.parametrize("limit", [{"min_confidence": 0.95}, {"max_tre": 0.001}])
def test_a_limit_that_is_raised_while_a_cloud_is_on_its_way_ends_the_row_and_the_place(limit):
    course = Course()
    assert not decided(course, 1) and course.place
    assert decided(course, 2, **limit) and not course.place
    assert decided(course, 3, require_consecutive=2).startswith("1 of 2")


@pytest.mark.parametrize(("reason", "stands"), [(Reason.STALE, True), (Reason.AMBIGUOUS, False)])
def test_a_cloud_that_grew_old_in_the_mailbox_ends_neither_the_row_nor_the_place(reason, stands):
    course = Course()
    assert not decided(course, 1)
    assert decided(course, 2, reason) == "for the test" and bool(course.place) is stands
    assert bool(decided(course, 3, require_consecutive=2)) is not stands


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({}, ""),
        ({"track": False}, "assess_every is not used: track is off"),
        ({"accumulate": 5, "output_frame": "reference"}, "assess_every is not used: a cloud that is registered with"),
        ({"viewpoint": "origin"}, "assess_every is not used: with a viewpoint"),
    ],
)
def test_where_no_cloud_can_be_followed_the_node_says_so(watch, given, why):
    with_every = NodeParameters(accumulate=given.pop("accumulate", 1), assess_every=3, sensor="laser", **given)
    said = [remark for remark in node_parameters.remarks(with_every) if remark.startswith("assess_every")]
    assert why in " ".join(said) and bool(why) == bool(said)
    assert not any("assess_every" in text for text in node_parameters.remarks(NodeParameters(accumulate=1, **given)))


def test_a_cloud_that_shows_where_its_camera_was_is_assessed(watch, image):
    """Nobody knows which part of it is bone."""
    live = watch(assess_every=3)
    live.send(10)
    live.client.send(image / 1000.0, stamp_s=11.0)
    wait_until(lambda: live.counts["accepted"] == 2, what=lambda: live.counts)
    live.send(12)
    assert live.counts["followed"] == 1


@pytest.mark.parametrize("given", [{"track": False}, {"viewpoint": "origin"}])
def test_and_every_cloud_is_assessed(watch, given):
    live = watch(assess_every=3, **given)
    live.send(10, 11, 12)
    assert live.counts["accepted"] == 3 and not live.method.follows


def test_the_node_as_users_start_it_follows_a_moving_bone(tmp_path):
    """The real tracker in a process of its own."""
    bone, client, heard = bones.bone(), Client(), []
    node = NodeProcess(tmp_path, model_path=bones.save(bone, tmp_path / "bone.npz"), model_unit="mm", timeout=60.0,
                       assess_every=3)  # fmt: skip
    client.do(lambda: client.node.create_subscription(PoseStamped, f"{NODE}/followed_pose", heard.append, 99))
    client.wait_for_state("active")
    wait_until(lambda: client.node.count_publishers(f"{NODE}/followed_pose"))
    poses = [
        se3.exp([2.0 * k, -k, 0.0, 0.01 * k, 0.0, 0.0]) @ pose_mm([0.1, 0.2, -0.9], [30, 20, 90]) for k in range(6)
    ]
    clouds = [bones.partial(bone, T, seed) for seed, T in enumerate(poses)]
    elsewhere = pose_mm([1.0, -2.0, 0.4], [-80.0, 10.0, 30.0])
    for count, cloud in enumerate([*clouds, bones.partial(bone, elsewhere, 9)], 1):
        client.send(cloud, stamp_s=100.0 + count)
        wait_until(lambda count=count: counted(client) == count, what=lambda: (client.values(), node.log))
    wait_until(lambda: len(heard) == 4 and len(client.poses) == 3, what=lambda: (client.values(), node.log))
    assert stamps(client.poses) == [101, 104, 107] and stamps(heard) == [102, 103, 105, 106]
    for message, number in zip(heard, (1, 2, 4, 5), strict=True):
        estimate = units.core_pose(pose_to_matrix(message))
        shift_mm, turn_deg = se3.pose_error(estimate, poses[number], clouds[number] * 1000.0)
        assert shift_mm < 1.0 and turn_deg < 1.0
    client.send(clouds[0], stamp_s=108.0)
    wait_until(lambda: len(client.poses) == 4)
    assert stamps(client.poses)[-1] == 108, "the bone jumped: assessed at once"
    client.close()
    assert node.stop() == 0, node.log


def counted(client):
    values = client.values()
    return sum(int(values.get(f"frames_{kind}", 0)) for kind in ("accepted", "refused", "followed", "dropped"))
