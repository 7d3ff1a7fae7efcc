"""The places that tf2 draws: which are believed, over its own buffer where that is installed and over a model of it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from harness import node_in_thread, wait_until
from rclpy.time import Time
from scipy.spatial.transform import Rotation

from gapr_ros.node import frames
from gapr_ros.node.frames import Frames
from gapr_ros.node.outcome import Reason, RefusedError
from gapr_ros.node.tf_guard import TfHistory

GOOD = np.random.default_rng(1).normal(size=(1000, 3)) * 0.02
START_S, RATE_HZ = 1000.0, 30.0


class Missing(Exception):
    """As tf2_ros.TransformException."""


class Model:
    """tf2's cache of one moving frame: it drops what is 10 s older than the newest, and interpolates between two."""

    def __init__(self):
        self._known = {}

    def set_transform_static(self, transform, authority):
        """Of no frame that is looked up."""

    def set_transform(self, transform, authority):
        stamp_s = Time.from_msg(transform.header.stamp).nanoseconds * 1e-9
        if transform.child_frame_id == "camera" and stamp_s >= max(self._known, default=0.0) - 10.0:
            self._known[stamp_s] = transform.transform.translation.x

    def can_transform(self, parent, child, stamp):
        stamp_s = stamp.nanoseconds * 1e-9
        return bool(self._known) and (not stamp_s or min(self._known) <= stamp_s <= max(self._known))

    def lookup_transform(self, parent, child, stamp):
        if not self.can_transform(parent, child, stamp):
            raise Missing("extrapolation")
        stamps = sorted(self._known)
        at = stamp.nanoseconds * 1e-9 or stamps[-1]
        return transform(np.interp(at, stamps, [self._known[each] for each in stamps]))

    def clear(self):
        self._known.clear()


class Real:
    """The buffer of tf2 itself."""

    def __init__(self):
        tf2 = pytest.importorskip("tf2_py", reason="the buffer of tf2 comes with a ROS installation")
        self._core, self._errors = tf2.BufferCore(), tf2.TransformException
        self.clear, self.set_transform = self._core.clear, self._core.set_transform
        self.set_transform_static = self._core.set_transform_static

    def can_transform(self, parent, child, stamp):
        return self._core.can_transform_core(parent, child, stamp)[0]

    def lookup_transform(self, parent, child, stamp):
        try:
            return self._core.lookup_transform_core(parent, child, stamp)
        except self._errors as error:
            raise Missing(str(error)) from error


def transform(x, stamp_s=0.0, child="camera", parent="world", turned=0.0):
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id, message.header.stamp = parent, Time(nanoseconds=round(stamp_s * 1e9)).to_msg()
    message.transform.translation.x = float(x)
    q = message.transform.rotation
    q.x, q.y, q.z, q.w = map(float, Rotation.from_rotvec([0.0, 0.0, turned]).as_quat())
    return message


@pytest.fixture(params=[Model, Real])
def history(request):
    warnings = []
    logger = SimpleNamespace(warning=lambda text, **_: warnings.append(text))
    made = TfHistory(request.param(), lambda stamp: stamp > 2e12, SimpleNamespace(get_logger=lambda: logger))
    made.warnings = warnings
    return made


def hear(history, places, start_s=START_S, rate_hz=RATE_HZ, turned=None):
    """Places x, m, one after the other; None is a place that is not sent. The stamp after the last one."""
    for i, x in enumerate(places):
        if x is not None:
            history.set_transform(transform(x, start_s + i / rate_hz, turned=turned[i] if turned else 0.0), "it")
    return start_s + len(places) / rate_hz


def why_not(history, at_s):
    """Empty where the place is believed."""
    try:
        history.lookup("world", "camera", Time(nanoseconds=round(at_s * 1e9)))
    except RefusedError as refusal:
        assert refusal.reason is Reason.TF_MISSING
        return refusal.text
    return ""


def between(index):
    """A stamp in the middle of two places."""
    return START_S + (index + 0.5) / RATE_HZ


REST = [0.3] * 10
MOVING = [0.3 + 0.5 * i / RATE_HZ for i in range(10)]  # at 0.5 m/s
HIDDEN = [*REST, *[None] * 30]  # for a second
CASES = {  # places, index of the look-up, a part of the reason
    "at rest": (REST, 5, ""),
    "moving": (MOVING, 5, ""),
    "at rest over a gap": ([*HIDDEN, 0.3, 0.3], 20, ""),
    "moved in a gap": ([*HIDDEN, 0.4, 0.4], 20, "moved while it was not heard"),
    "after a gap": ([*HIDDEN, 0.4, 0.4, 0.4], 40, ""),
    "hidden, as the origin": ([*REST, 0.0, 0.0, 0.0], 11, "exactly at the origin"),
    "hidden near the origin": ([0.006, 0.006, 0.0, 0.0, 0.0], 3, "exactly at the origin"),
    "a jump": ([*REST, 0.32, 0.32, 0.32], 9, "jumped"),
    "just after a jump": ([*REST, 0.32, 0.32, 0.32], 10, "jumped"),
    "long after a jump": ([*REST, 0.32, 0.32, 0.32, 0.32], 11, ""),
    "a small step": ([*REST, 0.304, 0.304], 9, ""),
    "a glitch, before it": ([*REST, 0.35, *REST], 9, "jumped"),
    "a glitch, after it": ([*REST, 0.35, *REST], 10, "jumped"),
    "two senders": ([0.3, 0.31] * 5, 6, "jumped"),
    "two transforms far apart": ([0.3, 0.32], 0, "jumped"),
    "two transforms that agree": ([0.3, 0.301], 0, ""),
}


@pytest.mark.parametrize("case", CASES)
def test_a_place_is_believed_only_where_the_transforms_around_it_agree(history, case):
    places, index, reason = CASES[case]
    hear(history, places)
    why = why_not(history, between(index))
    assert reason in why and bool(reason) == bool(why), why


def test_the_rules_hold_at_the_stamp_of_a_transform_too(history):
    hear(history, [*REST, 0.35, *REST])
    assert "jumped" in why_not(history, START_S + 10 / RATE_HZ)
    assert not why_not(history, START_S + 5 / RATE_HZ)
    hear(history, [0.0, 0.0], START_S + 5.0)
    assert "origin" in why_not(history, 0.0), "the newest"


def test_a_frame_that_turns_at_once_jumps_too(history):
    turned = [0.0] * 5 + [np.radians(10.0)] * 5
    hear(history, REST, turned=turned)
    assert "jumped" in why_not(history, between(4)) and not why_not(history, between(8))


def test_jitter_of_stamps_is_no_jump(history):
    rng = np.random.default_rng(0)
    for i in range(60):
        at_s = START_S + (i + 0.4 * rng.random()) / RATE_HZ
        history.set_transform(transform(0.3 + 0.2 * (at_s - START_S) + 2e-4 * rng.normal(), at_s), "it")
    assert not any(why_not(history, START_S + t) for t in np.linspace(0.2, 1.8, 50))


def test_a_frame_with_two_parents_and_one_that_is_static_as_well_are_not_believed(history):
    hear(history, REST)
    history.set_transform(transform(0.3, START_S + 10 / RATE_HZ, parent="world"), "it")
    history.set_transform(transform(0.3, START_S + 11 / RATE_HZ, parent="floor"), "it")
    if isinstance(history._buffer, Model):  # tf2 itself then knows no way from the world
        assert "parent" in why_not(history, between(10))
    history.start_over()
    hear(history, REST)
    history.set_transform_static(transform(0.3), "it")
    if isinstance(history._buffer, Model):
        assert "/tf_static" in why_not(history, between(5))


@pytest.mark.parametrize("damage", ["nan", "no quaternion", "the future"])
def test_what_is_no_transform_of_now_is_left_out(history, damage):
    hear(history, REST)
    bad = transform(np.nan if damage == "nan" else 0.3, 3000.0 if damage == "the future" else START_S + 0.4)
    if damage == "no quaternion":
        bad.transform.rotation.w = 0.0
    history.set_transform(bad, "it")
    assert len(history.warnings) == 1 and "left out" in history.warnings[0]
    assert not why_not(history, between(5))
    with pytest.raises(Exception, match=r".*"):
        why_not(history, START_S + 0.4)


def test_after_a_long_step_back_of_time_the_frame_is_known_again(history):
    hear(history, REST)
    hear(history, [0.5] * 5, START_S - 500.0)
    assert not why_not(history, START_S - 500.0 + 2.5 / RATE_HZ)


def test_nothing_between_two_rounds_of_time_is_believed(history):
    hear(history, REST)
    hear(history, [0.5] * 10, START_S + 0.013)  # a bag that is looped: the stamps come again
    assert all(why_not(history, between(i)) for i in range(2, 8))


def test_another_place_on_tf_static_is_said_and_told_to_who_looked_through_it():
    moved, warnings = [], []
    logger = SimpleNamespace(warning=lambda text, **_: warnings.append(text))
    node = SimpleNamespace(get_logger=lambda: logger)
    history = TfHistory(Model(), lambda stamp: False, node, moved.append)
    history.set_transform_static(transform(0.1, child="camera", parent="hand"), "it")
    history.set_transform_static(transform(0.1, child="camera", parent="hand"), "it")
    assert not warnings
    hear(history, REST)
    why_not(history, between(5))
    history.set_transform_static(transform(0.2, child="camera", parent="hand"), "it")
    history.set_transform_static(transform(0.2, child="lamp", parent="hand"), "it")
    assert len(warnings) == 1 and moved == ["camera"]


@pytest.mark.parametrize(
    ("parent", "at_s", "said"),
    [
        ("reference", START_S, "nobody sends 'reference'"),
        ("world", START_S + 0.5, "raise tf_timeout"),
        ("world", START_S + 5.0, "does its node still run"),
        ("world", START_S - 5.0, "older than all that was heard"),
        ("world", START_S + 1e6, "12 days apart: play /tf and --clock of the same bag"),
    ],
)
def test_where_a_transform_is_missing_the_text_says_what_to_do(history, parent, at_s, said):
    hear(history, REST)
    assert said in history.why_missing(parent, "camera", round(at_s * 1e9))


@pytest.fixture(params=[Model, Real])
def heard(monkeypatch, request):
    """The buffer that the node listens with."""
    buffer = request.param()

    def make(node):
        buffer.jump_handle, buffer.srv = SimpleNamespace(unregister=lambda: None), None
        return buffer

    def listen(into, node):
        buffer.hear = into.set_transform
        return SimpleNamespace(unregister=lambda: None)

    names = {"Buffer": make, "TransformListener": listen, "TransformException": Missing}
    monkeypatch.setattr(frames, "_import_tf2", lambda: SimpleNamespace(**names))
    return buffer


def test_a_cloud_is_placed_between_two_transforms_and_refused_over_a_jump(blob_path, client, method, heard):
    with node_in_thread(method, blob_path, output_frame="world", tf_timeout=5.0):
        client.wait_for_state("active")
        for i in range(4):
            heard.hear(transform(0.1, START_S + 0.02 * i), "it")
        assert client.ask(GOOD, frame="camera", stamp_s=START_S + 0.05)["level"] == 0
        assert method.calls[-1]["source"][:, 0].mean() == pytest.approx(100.0 + 1e3 * GOOD[:, 0].mean(), abs=1e-3)
        heard.hear(transform(0.3, START_S + 0.08), "it")
        values = client.ask(GOOD, frame="camera", stamp_s=START_S + 0.07)
        assert values["last_refusal"].startswith("tf_missing: output_frame: world <- camera: 'camera' jumped")


def test_a_looped_bag_without_simulated_time_is_placed_by_its_own_round(blob_path, client, method, heard):
    with node_in_thread(method, blob_path, output_frame="world"):
        client.wait_for_state("active")
        for x in (0.1, 0.2):  # another place in each round, so that a mix shows
            for i in range(60):
                heard.hear(transform(x, START_S + 0.1 * i), "it")
                if i % 10 == 5:
                    received = int(client.values()["frames_received"])
                    client.send(GOOD, frame="camera", stamp_s=START_S + 0.1 * i - 0.05)
                    wait_until(lambda n=received: int(client.values()["frames_received"]) > n)
        wait_until(lambda: len(method.calls) >= 7)
        clouds = [call["source"] for call in method.calls if len(call["source"]) == len(GOOD)]  # no warm-up
        places = {round(cloud[:, 0].mean() - 1e3 * GOOD[:, 0].mean()) for cloud in clouds}
        assert places <= {100, 200} and len(places) == 2


@pytest.mark.parametrize(("x_m", "refused"), [(30.0, False), (400.0, True)])
def test_a_transform_that_leads_out_of_any_room_is_refused(heard, x_m, refused):
    logger = SimpleNamespace(warning=lambda text, **_: None)
    made = Frames(SimpleNamespace(get_logger=lambda: logger), publish=False, listen=True)
    for i in range(4):
        heard.hear(transform(x_m, START_S + 0.02 * i), "it")
    try:
        made.lookup("world", "camera", Time(nanoseconds=round((START_S + 0.03) * 1e9)), 0.0)
    except RefusedError as refusal:
        assert refused and refusal.reason is Reason.BAD_FRAME and "millimetres" in refusal.text
    else:
        assert not refused
