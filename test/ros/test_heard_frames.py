"""What tf2 has heard of other frames, when time starts over: nothing of one round is mixed with another."""

from __future__ import annotations

import time
from types import SimpleNamespace

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from harness import Collecting, node_in_thread, wait_until
from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

from gapr_ros.node import frames, timeline
from gapr_ros.node import heard as heard_module
from gapr_ros.node.heard import Heard

GOOD = np.random.default_rng(1).normal(size=(1000, 3)) * 0.02
NEEDS_TF2 = "the real tf2 buffer comes with a ROS installation: apt install ros-jazzy-tf2-py"
LATE_S = 0.02  # transforms come so long before and after the stamp of a cloud


class Missing(Exception):
    """As tf2_ros.TransformException."""


class Model:
    """tf2's cache of one moving frame: it ignores what is 10 s older than the newest, and interpolates between two."""

    def __init__(self):
        self._known = {}

    def insert(self, stamp_s, x):
        if stamp_s >= max(self._known, default=0.0) - 10.0:
            self._known[stamp_s] = x

    def set_transform_static(self, transform, authority):
        """Of no frame that is looked up."""

    def set_transform(self, transform, authority):
        if transform.child_frame_id == "camera":
            self.insert(Time.from_msg(transform.header.stamp).nanoseconds * 1e-9, transform.transform.translation.x)

    def can_transform(self, parent, child, stamp):
        stamp_s = stamp.nanoseconds * 1e-9
        return bool(self._known) and min(self._known) <= stamp_s <= max(self._known)

    def lookup_transform(self, parent, child, stamp):
        if not self.can_transform(parent, child, stamp):
            raise Missing("extrapolation")
        stamps = sorted(self._known)
        return _transform(np.interp(stamp.nanoseconds * 1e-9, stamps, [self._known[stamp] for stamp in stamps]))

    def clear(self):
        self._known.clear()


class Real:
    """The buffer of tf2 itself."""

    def __init__(self):
        tf2 = pytest.importorskip("tf2_py", reason=NEEDS_TF2)
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


def _transform(x, stamp_s=0.0, child="camera", parent="world"):
    transform = TransformStamped(child_frame_id=child)
    transform.header.frame_id, transform.header.stamp = parent, Time(nanoseconds=round(stamp_s * 1e9)).to_msg()
    transform.transform.translation.x = float(x)
    return transform


@pytest.fixture(params=[Model, Real])
def heard(monkeypatch, request):
    """The buffer that the node listens with."""
    buffer = request.param()

    def raises(jump):
        raise TypeError("as tf2_ros_py 0.36.4 does")

    def make(node):
        threshold = JumpThreshold(min_forward=None, min_backward=Duration(seconds=-1))
        buffer.jump_handle = node.get_clock().create_jump_callback(threshold, post_callback=raises)
        buffer.srv = None
        return buffer

    def listen(into, node):
        buffer.hear, buffer.hear_static = into.set_transform, into.set_transform_static
        return SimpleNamespace(unregister=lambda: None)

    names = {"Buffer": make, "TransformListener": listen, "TransformException": Missing}
    monkeypatch.setattr(frames, "_import_tf2", lambda: SimpleNamespace(**names))
    return buffer


def see(client, buffer, stamp_s, camera_x, frame="camera"):
    """Send a cloud between two transforms of its camera; the answer."""
    buffer.hear(_transform(camera_x, stamp_s - LATE_S), "the camera")
    received = int(client.values()["frames_received"])
    stamp = client.send(GOOD, frame=frame, stamp_s=stamp_s)
    wait_until(lambda: int(client.values()["frames_received"]) > received)
    buffer.hear(_transform(camera_x, stamp_s + LATE_S), "the camera")
    return wait_until(lambda: client.values() if client.values()["cloud_stamp"] == stamp else None)


def where(method):
    """Where the last cloud was in the world, m."""
    return method.calls[-1]["source"][:, 0].mean() / 1000.0


@pytest.mark.parametrize("back_to_s", [1000.5, 1003.2])
@pytest.mark.parametrize("how", ["the stamps", "a reset", "the clock"])
def test_a_cloud_of_a_new_round_of_time_is_never_put_where_the_camera_was_in_the_last(
    blob_path, client, method, heard, how, back_to_s
):
    options = {"output_frame": "world", "tf_timeout": 60.0, "max_future": 0.0, "use_sim_time": how == "the clock"}
    with node_in_thread(method, blob_path, **options) as node:
        client.wait_for_state("active")
        for i in range(5):
            assert see(client, heard, 1000.0 + i, camera_x=1.0)["level"] == 0
            assert where(method) == pytest.approx(1.0, abs=1e-2)
        if how == "a reset":
            client.call("reset")
        if how == "the clock":
            for stamp_s in (1004.0, back_to_s):
                client.clock.publish(Clock(clock=Time(nanoseconds=round(stamp_s * 1e9)).to_msg()))
                wait_until(lambda stamp_s=stamp_s: node.now_ns() == round(stamp_s * 1e9))
        node.set_parameters([Parameter("tf_timeout", value=4.0)])  # one waits in vain: its transform came too early
        calls, answers = len(method.calls), []
        for i in range(11):  # stamps that went back by less than a second have to catch up
            answers.append(see(client, heard, back_to_s + 0.1 * i, camera_x=3.0))
            if len(method.calls) > calls:
                assert where(method) == pytest.approx(3.0, abs=1e-2)
        assert [answer["level"] for answer in answers[-3:]] == [0] * 3, answers


NS = 1_000_000_000


def hears(buffer, now_s=0):
    """A `Heard`, a function that lets it hear a transform of the camera, and the warnings that are written."""
    said = []
    logger = SimpleNamespace(warning=lambda text, **_: said.append(text))
    node = SimpleNamespace(get_logger=lambda: logger)
    heard = Heard(buffer, lambda stamp_ns: timeline.is_far_ahead(stamp_ns, now_s * NS, 0.5), node)
    return heard, lambda stamp_s, x: heard.set_transform(_transform(x, stamp_s), "the camera"), said


@pytest.fixture(params=[Model, Real])
def buffer(request):
    return request.param()


def seen_at(buffer, stamp_s):
    """Where the camera was, by the buffer; None where it does not know."""
    stamp = Time(nanoseconds=round(stamp_s * NS))
    known = buffer.can_transform("world", "camera", stamp)
    return buffer.lookup_transform("world", "camera", stamp).transform.translation.x if known else None


def test_one_transform_from_the_future_neither_freezes_the_camera_nor_shuts_out_what_comes(buffer):
    """tf2 interpolated from the last one to it, over a year, and ignored all that came."""
    _, hear, said = hears(buffer, now_s=1000)
    for stamp_s, x in ((999.9, 1.0), (1000.0, 1.0), (3e7, 1.0), (1000.1, 2.0), (1000.2, 2.0)):
        hear(stamp_s, x)
    assert seen_at(buffer, 1000.15) == pytest.approx(2.0) and seen_at(buffer, 1000.3) is None
    assert said == ["a transform of 'camera' is left out: its stamp is ahead of the clock; synchronise the clocks"]
    hear(1001.4, 2.0)
    assert seen_at(buffer, 1001.3) == pytest.approx(2.0), "some nodes send what holds for the second to come"


def test_what_is_left_of_the_last_round_is_no_clock_to_synchronise(buffer, monkeypatch):
    """A bag in a loop with /clock: the last transforms of a round came after its end, and were warned of."""
    heard, hear, said = hears(buffer, now_s=1000)
    now_s = heard_module.time.monotonic()
    monkeypatch.setattr(heard_module.time, "monotonic", lambda: now_s)
    heard.start_over()
    hear(3e7, 1.0)
    assert seen_at(buffer, 3e7) is None and not said
    now_s += heard_module.AFTER_A_STEP_S
    hear(3e7, 1.0)
    assert len(said) == 1


def test_transforms_that_go_on_after_one_ahead_of_all_others_are_soon_heard(buffer):
    """No clock says that it is wrong, as in a bag."""
    _, hear, _ = hears(buffer)
    for stamp_s in (1000.0, 1500.0, 1000.1, 1000.2, 1000.3, 1000.4):
        hear(stamp_s, 1.0)
    assert seen_at(buffer, 1000.35) == pytest.approx(1.0)
    assert seen_at(buffer, 1000.15) is None and seen_at(buffer, 1400.0) is None


def test_a_straggler_among_transforms_changes_nothing(buffer):
    _, hear, said = hears(buffer)
    for i in range(20):
        hear(1000.0 + i, 1.0)
        hear(998.5 + i, 7.0)
    hear(1018.8, 1.0)  # within a second
    assert seen_at(buffer, 1018.5) == seen_at(buffer, 1018.9) == pytest.approx(1.0) and not said


def test_another_round_of_transforms_is_never_mixed_with_the_last_though_no_cloud_comes(buffer):
    """As while the node is disabled: only clouds told it that time had started over."""
    _, hear, said = hears(buffer)
    for i in range(100):
        hear(1000.0 + 0.1 * i, 1.0)
    for i in range(30):
        hear(1002.0 + 0.1 * i, 3.0)
        seen = [seen_at(buffer, 1002.0 + 0.1 * i - back_s) for back_s in (0.01, 0.05)]
        assert i < 3 or seen == pytest.approx([3.0, 3.0])
    assert said == ["the stamps of the transforms of 'camera' went back: those of before are forgotten"]


def why_not(heard, stamp_s, most_gap_s=0.25, frame="world"):
    """Why the camera's place in a frame at a stamp is not to be believed."""
    return heard.why_not(frame, "camera", round(stamp_s * NS), most_gap_s)


def test_nothing_is_interpolated_over_a_time_in_which_a_frame_was_not_heard(buffer):
    """A marker that is hidden while the camera is moved: tf2 draws a straight line."""
    heard, hear, _ = hears(buffer)
    for stamp_s in (999.9, 1000.0, 1001.0, 1001.1):
        hear(stamp_s, stamp_s - 1000.0)
    assert seen_at(buffer, 1000.5) == pytest.approx(0.5)
    assert why_not(heard, 1000.5) == "'camera' was not heard for 1 s around this stamp, max_tf_gap is 0.25 s"
    assert [why_not(heard, stamp_s) for stamp_s in (999.95, 1000.0, 1001.0, 1001.05, 1002.0)] == [""] * 5
    assert why_not(heard, 1000.5, most_gap_s=0.0) == why_not(heard, 1000.5, most_gap_s=1.001) == "", "0 is off"
    assert why_not(heard, 0.0) == "", "the newest transform there is"


def broken(transform, how):
    """What trackers send of a marker that they do not see, and other things that tf2 drops."""
    moved = transform.transform
    if how == "NaN":
        moved.translation.y = np.nan
    elif how == "infinite":
        moved.translation.z = np.inf
    elif how == "no rotation":
        moved.rotation.w = 0.0
    elif how == "half a rotation":
        moved.rotation.z, moved.rotation.w = 0.5, 0.5
    else:
        transform.header.frame_id = {"itself": "/camera", "no parent": ""}[how]
    return transform


@pytest.mark.parametrize("how", ["NaN", "infinite", "no rotation", "half a rotation", "itself", "no parent"])
def test_a_transform_that_tf2_drops_was_not_heard(buffer, how):
    """A marker that is hidden while the camera is moved: over what is dropped tf2 draws a straight line."""
    heard, hear, said = hears(buffer)
    for i in range(60):
        stamp_s, x = 999.9 + 0.02 * i, 0.02 * i
        if 1000.0 < stamp_s < 1001.0:
            heard.set_transform(broken(_transform(x, stamp_s), how), "the tracker")
        else:
            hear(stamp_s, x)
    assert why_not(heard, 1000.5).startswith("'camera' was not heard for 1 s")
    assert why_not(heard, 999.95) == why_not(heard, 1001.05) == ""
    assert len(set(said)) == 1 and "is left out: it" in said[0]
    heard.set_transform_static(broken(_transform(0.0), how), "the mount")
    assert "on /tf_static is left out: it" in said[-1] and seen_at(buffer, 1001.06) is not None


@pytest.mark.parametrize("seconds", [0.1, 3.0, 40.0])
def test_a_frame_that_jumped_to_the_very_origin_is_not_believed_until_it_leaves_it(buffer, seconds):
    """So do some trackers say that they do not see a marker."""
    heard, hear, _ = hears(buffer)
    back_s = 1000.0 + seconds
    for i in range(round((seconds + 2.0) * 50.0)):
        stamp_s = 999.0 + 0.02 * i
        hear(stamp_s, 0.0 if 1000.0 < stamp_s < back_s else 0.5 + 0.1 * np.sin(stamp_s))
        if 1000.03 < stamp_s < back_s:
            assert "jumped to the very origin" in why_not(heard, stamp_s) == why_not(heard, stamp_s - 0.03), stamp_s
            assert "jumped to the very origin" in why_not(heard, 0.0)
    assert "jumped to the very origin" in why_not(heard, back_s - 0.01)
    assert why_not(heard, back_s + 0.5) == why_not(heard, 0.0) == ""


def test_a_frame_that_is_at_the_origin_from_the_start_or_comes_there_slowly_is_believed(buffer):
    heard, hear, _ = hears(buffer)
    for i in range(200):
        hear(1000.0 + 0.02 * i, max(0.0, 0.1 - 0.002 * abs(i - 100)))
        assert why_not(heard, 999.99 + 0.02 * i) == ""
    for i in range(40):
        hear(1004.0 + 0.02 * i, round(0.1 * np.sin(np.pi * i / 20.0), 9))
        assert why_not(heard, 1003.95 + 0.02 * i) == "", "one that moves through it"


def test_every_moving_frame_between_two_is_asked_and_no_other(buffer):
    heard, hear, _ = hears(buffer)
    for child, parent in (("lens", "camera"), ("/bed", "world")):
        heard.set_transform_static(_transform(0.0, child=child, parent=parent), "the mount")
    for stamp_s in (1000.0, 1001.0):
        heard.set_transform(_transform(0.0, stamp_s, child="camera", parent="arm"), "the wrist")
        heard.set_transform(_transform(0.0, stamp_s, child="drill", parent="world"), "another arm")
    for i in range(11):
        heard.set_transform(_transform(0.0, 1000.0 + 0.1 * i, child="arm", parent="/world"), "the arm")
    at = round(1000.55 * NS)
    assert "'camera'" in heard.why_not("bed", "lens", at, 0.25) == heard.why_not("/lens", "world", at, 0.25)
    assert heard.why_not("world", "arm", at, 0.25) == heard.why_not("lens", "camera", at, 0.25) == ""
    assert "'drill'" in heard.why_not("arm", "drill", at, 0.25)
    assert heard.why_not("world", "arm", at, 0.05).startswith("'arm' was not heard for 0.1 s")


def test_while_the_stamps_of_a_frame_may_have_gone_back_it_is_not_looked_up(buffer):
    heard, hear, said = hears(buffer)
    for i in range(50):
        hear(1000.0 + 0.02 * i, 1.0)
    hear(1000.972, 1.0)
    assert why_not(heard, 1000.9) == "", "8 ms, as where threads race"
    hear(1000.5, 3.0)
    text = "the stamps of the transforms of 'camera' went back, and whether time did is not clear yet"
    assert why_not(heard, 1000.9) == why_not(heard, 1000.9, most_gap_s=0.0) == text
    assert heard.why_not("world", "bed", round(1000.9 * NS), 0.25) == ""
    hear(1001.0, 1.0)
    assert why_not(heard, 1000.9) == "" and seen_at(buffer, 1000.5) == pytest.approx(1.0), "it was a straggler"
    for i in range(4):
        hear(1000.6 + 0.02 * i, 3.0)
    assert why_not(heard, 1000.65) == "" and len(said) == 1
    assert seen_at(buffer, 1000.65) == pytest.approx(3.0) and seen_at(buffer, 1000.95) is None


def test_a_cloud_that_came_late_is_final_by_the_next_transform_of_each_frame(buffer):
    heard, hear, _ = hears(buffer)

    def settled(stamp_s, arrived_s):
        return heard.is_final("world", "camera", round(stamp_s * NS), arrived_s)

    hear(1000.0, 1.0)
    now_s = time.monotonic()
    assert settled(999.96, now_s) and settled(1000.5, now_s), "40 ms is not late"
    assert not settled(999.94, now_s)
    assert settled(0.0, now_s) and heard.is_final("world", "bed", 0, now_s) and settled(999.0, now_s - 1.0)
    hear(999.5, 1.0)
    assert settled(999.94, now_s), "whatever it says: whether the stamps went back is asked apart"


def test_a_cloud_after_a_step_back_that_comes_before_the_first_transform_is_not_put_where_the_camera_was(
    blob_path, client, method, heard
):
    with node_in_thread(method, blob_path, output_frame="world", tf_timeout=60.0, max_future=0.0) as node:
        client.wait_for_state("active")
        for i in range(50):
            heard.hear(_transform(1.0, 1000.0 + 0.02 * i), "the camera")
        received, calls = node.counters.received, len(method.calls)
        stamp = client.send(GOOD, frame="camera", stamp_s=1000.5)
        wait_until(lambda: node.counters.received > received)
        time.sleep(0.2)
        assert len(method.calls) == calls, "it waits"
        for i in range(6):
            heard.hear(_transform(3.0, 1000.46 + 0.02 * i), "the camera")
        wait_until(lambda: client.values()["cloud_stamp"] == stamp)
        assert where(method) == pytest.approx(3.0, abs=1e-2)


def test_a_late_cloud_after_which_nothing_comes_is_registered_when_it_has_waited(blob_path, client, method, heard):
    with node_in_thread(method, blob_path, output_frame="world", tf_timeout=0.1, max_future=0.0):
        client.wait_for_state("active")
        for i in range(50):
            heard.hear(_transform(1.0, 1000.0 + 0.02 * i), "the camera")
        assert client.ask(GOOD, frame="camera", stamp_s=1000.5)["level"] == 0
        assert where(method) == pytest.approx(1.0, abs=1e-2)


def test_frames_that_nobody_looks_through_may_be_out_of_order(buffer):
    """Such as a marker that two cameras see, one of them late."""
    heard, hear, said = hears(buffer)
    for i in range(100):
        hear(1000.0 + 0.02 * i, 1.0)
        late_s = 0.3 if i % 4 else 0.0
        heard.set_transform(_transform(0.0, 1000.0 + 0.02 * i - late_s, child="marker"), "two cameras")
        assert i < 2 or why_not(heard, 1000.0 + 0.02 * i - 0.01) == ""
    assert seen_at(buffer, 1000.01) == pytest.approx(1.0) and not said


@pytest.mark.parametrize("step_s", [0.5, 0.05])
def test_after_a_small_step_back_of_the_clock_no_place_of_before_is_believed(buffer, step_s):
    """The camera moves by 1 m/s; clouds come 30 ms behind its transforms."""
    heard, hear, _ = hears(buffer)
    believed = []
    for i in range(200):
        stamp_s = 1000.0 + 0.02 * i - (step_s if i >= 100 else 0.0)
        hear(stamp_s, 0.02 * i)
        seen = seen_at(buffer, stamp_s - 0.03)
        if seen is not None and not why_not(heard, stamp_s - 0.03):
            believed.append(i)
            assert seen == pytest.approx(0.02 * i - 0.03, abs=1e-6), i
    assert set(range(200)) - set(believed) <= {0, 1, *range(100, 106)}


def test_one_transform_a_little_ahead_makes_no_place_wrong(buffer):
    """Within what some nodes send ahead, and no clock says that it is wrong."""
    heard, hear, _ = hears(buffer, now_s=1001)
    for i in range(100):
        stamp_s = 1000.0 + 0.02 * i
        hear(stamp_s, 0.02 * i)
        if i == 50:
            hear(stamp_s + 0.9, 0.02 * i)
        for back_s in (0.01, -0.03):
            seen = seen_at(buffer, stamp_s - back_s)
            assert seen is None or why_not(heard, stamp_s - back_s) or seen == pytest.approx(0.02 * i - back_s), i
    assert why_not(heard, 1001.97) == "" and seen_at(buffer, 1001.97) == pytest.approx(1.97)


def test_what_is_known_of_a_frame_stays_small_and_is_forgotten_with_its_round(buffer):
    heard, hear, _ = hears(buffer)
    for i in range(5000):
        hear(1000.0 + 0.01 * i, 1.0)
    assert 1000 <= len(heard._links._tracks["camera"].stamps) <= 2001
    assert why_not(heard, 1049.985, most_gap_s=0.005) != ""
    heard.start_over()
    assert why_not(heard, 1049.985, most_gap_s=0.005) == "" and not heard._links.between("world", "camera")


@pytest.mark.parametrize("rate_hz", [50, 10, 3])
@pytest.mark.parametrize("late_s", [0.0, 0.002, 0.01])
@pytest.mark.parametrize("moves_m_s", [0.0, 0.2])
def test_a_frame_that_two_nodes_send_is_not_believed_where_it_goes_to_and_fro(buffer, rate_hz, late_s, moves_m_s):
    """A tracker, and what the description of the robot says: tf2 draws a line between the two, 60 mm apart."""
    heard, hear, _ = hears(buffer)
    sent, why = 0, ""
    for i in range(250):
        stamp_s, true_m = 1000.0 + 0.02 * i, 0.02 * i * moves_m_s
        hear(stamp_s, true_m)
        if i > 20 and i % (50 // rate_hz) == 0:
            hear(stamp_s + late_s, true_m + 0.06)
            sent += 1
        for back_s in (0.001, 0.015, 0.03):
            seen, at_s = seen_at(buffer, stamp_s - back_s), stamp_s - back_s
            if sent < 3 or seen is None or abs(seen - (true_m - back_s * moves_m_s)) < 0.004:
                continue  # one jump alone may be one
            why = why_not(heard, at_s, most_gap_s=0.0)
            assert why.startswith("'camera' is not to be believed, it goes to and fro by "), (i, back_s)
            assert float(why.split(" by ")[1].split()[0]) == pytest.approx(60.0, abs=6.0)
    assert why.endswith("mm: do two nodes send it on /tf?")


@pytest.mark.parametrize("rate_hz", [4, 5, 20, 100])
@pytest.mark.parametrize("swing_m", [0.03, 0.1, 0.3])
def test_a_frame_that_one_tracker_follows_is_believed_however_it_turns_back(buffer, rate_hz, swing_m):
    """A probe that is swept to and fro every two seconds, with half a millimetre and a third of a degree of noise."""
    heard, hear, _ = hears(buffer)
    rng = np.random.default_rng(rate_hz)
    for i in range(20 * rate_hz):
        stamp_s = 1000.0 + i / rate_hz
        transform = _transform(swing_m * abs(1.0 - i / rate_hz % 2.0) + rng.normal(0.0, 5e-4), stamp_s)
        turn = rng.normal(0.0, np.radians(0.3), 3) / 2.0
        (q := transform.transform.rotation).x, q.y, q.z = turn
        q.w = float(np.sqrt(1.0 - turn @ turn))
        heard.set_transform(transform, "the tracker")
        assert "to and fro" not in why_not(heard, stamp_s - 0.5 / rate_hz, most_gap_s=0.0)
        assert "alone" not in why_not(heard, stamp_s - 1.5 / rate_hz, most_gap_s=0.0)
        assert "jumped" not in why_not(heard, stamp_s - 6.5 / rate_hz, most_gap_s=0.0)


@pytest.mark.parametrize("rate_hz", [10, 30, 60])
@pytest.mark.parametrize("jump_mm", [20.0, 50.0])
def test_between_the_two_places_of_a_frame_that_jumps_nothing_is_looked_up(buffer, rate_hz, jump_mm):
    """As with a marker that is mounted elsewhere, or a tracker that changes its mind; the stamps are not quite even."""
    heard, hear, _ = hears(buffer)
    rng = np.random.default_rng(rate_hz)
    stamps_s = 1000.0 + (np.arange(30) + rng.uniform(-0.2, 0.2, 30)) / rate_hz
    places_m = np.where(np.arange(30) < 20, 0.0, 1e-3 * jump_mm) + rng.normal(0.0, 2e-4, 30)
    rests_from_s = stamps_s[20] + max(0.05, 0.5 * (stamps_s[20] - stamps_s[19]))
    for number, (stamp_s, place_m) in enumerate(zip(stamps_s, places_m, strict=True)):
        hear(stamp_s, place_m)
        between = round(0.5 * stamps_s[19:21].sum() * NS)
        is_said = "'camera' jumped by" in heard.why_not("world", "camera", between, 0.0)
        assert is_said is (number >= 20), number
        is_final = bool(number < 20 or stamp_s > rests_from_s)  # until then it may go on
        assert heard.is_final("world", "camera", between, -np.inf) is is_final, number
    text = why_not(heard, 0.5 * stamps_s[19:21].sum(), most_gap_s=0.0)
    assert text.endswith("mm and 0.0 deg around this stamp: tf2 would say a place at which it never was")
    assert float(text.split(" by ")[1].split()[0]) == pytest.approx(jump_mm, abs=1.5)
    elsewhere = [*stamps_s, *(0.5 * (stamps_s[i] + stamps_s[i + 1]) for i in range(29) if i != 19)]
    assert [why_not(heard, stamp_s, most_gap_s=0.0) for stamp_s in elsewhere] == [""] * len(elsewhere)


@pytest.mark.parametrize(
    ("rate_hz", "swing_m", "times_a_s"),
    [(10, 0.1, 1.5), (20, 0.03, 2.5), (20, 0.1, 1.5), (60, 0.03, 2.5), (60, 0.1, 0.3)],
)
def test_a_frame_that_moves_however_fast_does_not_jump(buffer, rate_hz, swing_m, times_a_s):
    """It is heard six times and more while it swings once: less, and a straight line says nothing of where it was."""
    heard, hear, _ = hears(buffer)
    rng = np.random.default_rng(rate_hz)
    stamps_s = 1000.0 + (np.arange(5 * rate_hz) + rng.uniform(-0.2, 0.2, 5 * rate_hz)) / rate_hz
    for stamp_s in stamps_s:
        hear(stamp_s, swing_m * np.sin(2.0 * np.pi * times_a_s * stamp_s) + rng.normal(0.0, 2e-4))
    for between_s in 0.5 * (stamps_s[:-3] + stamps_s[1:-2]):
        assert "jumped" not in why_not(heard, between_s, most_gap_s=0.0)


def test_a_frame_that_sets_off_at_once_is_believed_as_soon_as_it_is_seen_to_go_on(buffer):
    heard, hear, _ = hears(buffer)
    for number, x in enumerate((0.0, 0.0, 0.0, 0.0, 0.0, 0.01, 0.02, 0.03)):
        hear(1000.0 + 0.02 * number, x)
        assert heard.is_final("world", "camera", round(1000.09 * NS), -np.inf) is (number != 5)
        assert bool(why_not(heard, 1000.09)) is (number == 5)


@pytest.mark.parametrize(("turn_deg", "took_s", "is_jump"), [(3.0, 0.02, True), (1.9, 0.02, False), (3.0, 0.1, False)])
def test_a_frame_that_turns_at_once_jumps_too(buffer, turn_deg, took_s, is_jump):
    heard, _, _ = hears(buffer)
    for number in range(10):
        turned = _transform(0.0, 1000.0 + took_s * number)
        half = np.radians(turn_deg if number > 4 else 0.0) / 2.0
        turned.transform.rotation.z, turned.transform.rotation.w = np.sin(half), np.cos(half)
        heard.set_transform(turned, "the tracker")
    assert ("jumped by 0.0 mm and 3.0 deg" in why_not(heard, 1000.0 + 4.5 * took_s, 0.0)) is is_jump


@pytest.mark.parametrize(("moved_mm", "took_s", "is_jump"), [(3.1, 0.02, True), (2.9, 0.01, False), (14.0, 0.1, False)])
def test_a_short_or_a_slow_way_is_no_jump(buffer, moved_mm, took_s, is_jump):
    heard, hear, _ = hears(buffer)
    for number in range(10):
        hear(1000.0 + took_s * number, 1e-3 * moved_mm * (number > 4))
    assert ("jumped" in why_not(heard, 1000.0 + 4.5 * took_s, 0.0)) is is_jump


@pytest.mark.parametrize(("before_mm", "after_mm", "is_jump"), [(2.0, 2.0, True), (6.0, 0.0, False), (0.0, 6.0, False)])
def test_a_frame_rests_on_both_sides_of_a_jump(buffer, before_mm, after_mm, is_jump):
    """20 mm; a quarter of it is rest, and to and fro within 50 ms is none."""
    heard, hear, _ = hears(buffer)
    for number, x_mm in enumerate((before_mm, 0.0, before_mm, before_mm, 20.0 + before_mm)):
        hear(1000.0 + 0.02 * number, 1e-3 * x_mm)
    for number in range(5, 8):
        hear(1000.0 + 0.02 * number, 1e-3 * (20.0 + before_mm + after_mm * (number == 5)))
    assert ("jumped" in why_not(heard, 1000.07)) is is_jump


def test_a_frame_that_is_turned_to_and_fro_or_has_two_parents_by_turns_is_not_believed(buffer):
    heard, _, _ = hears(buffer)
    for i in range(20):
        turned = _transform(0.0, 1000.0 + 0.02 * i)
        if i % 2:
            turned.transform.rotation.z, turned.transform.rotation.w = np.sin(0.02), np.cos(0.02)
        heard.set_transform(turned, "two nodes")
        heard.set_transform(_transform(0.0, 1000.0 + 0.02 * i, "tip", "probe" if i % 2 else "stylus"), "two nodes")
        heard.set_transform(_transform(0.0, 1000.0 + 0.02 * i, "arm", "world" if i < 10 else "base"), "once")
    assert "'camera' is not to be believed, it goes to and fro by 0.0 mm" in why_not(heard, 1000.2)
    at = round(1000.2 * NS)
    text = heard.why_not("stylus", "tip", at, 0.25)
    assert text.startswith("'tip' is not to be believed, its parent is 'probe' and 'stylus' by turns")
    assert heard.why_not("base", "arm", at, 0.25) == "", "a frame may be mounted elsewhere"


@pytest.mark.parametrize("rate_hz", [10, 30, 60])
@pytest.mark.parametrize(("away_mm", "turned_deg"), [(400.0, 0.0), (0.0, 120.0)])
def test_a_frame_that_was_elsewhere_for_one_transform_is_not_believed_next_to_it(buffer, rate_hz, away_mm, turned_deg):
    """A marker whose balls are mixed up, or that was hidden, for one image."""
    heard, _, _ = hears(buffer)
    stamps_s = 1000.0 + np.arange(30) / rate_hz
    for number, stamp_s in enumerate(stamps_s):
        transform = _transform(0.005 * number + 1e-3 * away_mm * (number == 20), stamp_s)
        half = np.radians(turned_deg * (number == 20)) / 2.0
        transform.transform.rotation.z, transform.transform.rotation.w = np.sin(half), np.cos(half)
        heard.set_transform(transform, "the tracker")
        for back in (0.3, 1.0, 1.7):
            at_s = stamps_s[20] - (back - 1.0) / rate_hz
            is_final = heard.is_final("world", "camera", round(at_s * NS), -np.inf)
            said = why_not(heard, at_s, most_gap_s=0.0)
            if number > 20:
                assert "deg away for one transform alone around this stamp" in said
            elif number == 20 and seen_at(buffer, at_s) is not None and back != 1.0:
                assert not is_final, "it waits for the next one"
    elsewhere = [*stamps_s[:20], *stamps_s[21:], *(stamps_s[:19] + 0.5 / rate_hz), *(stamps_s[21:-1] + 0.5 / rate_hz)]
    assert [why_not(heard, stamp_s, most_gap_s=0.0) for stamp_s in elsewhere] == [""] * len(elsewhere)


def test_nothing_is_looked_up_while_a_frame_passes_from_one_parent_to_another(buffer):
    """From one tracker to another: tf2 has the last place under the first one until the second one sends."""
    heard, _, _ = hears(buffer)
    for i in range(20):
        stamp_s = 1000.0 + 0.2 * (i >= 10) + 0.02 * i
        heard.set_transform(_transform(0.05 * i, stamp_s, parent="left" if i < 10 else "right"), "a tracker")
        for parent in ("left", "right"):
            heard.set_transform(_transform(0.0, stamp_s, child=parent), "the room")
    text = "the parent of 'camera' was 'left' and is 'right' after this stamp: tf2 has the place before"
    assert why_not(heard, 1000.3, most_gap_s=0.0) == text
    assert why_not(heard, 1000.18) == why_not(heard, 1000.4) == why_not(heard, 1000.17) == ""


def test_a_frame_that_comes_on_tf_stays_where_it_is_whatever_tf_static_says(buffer):
    """The mount of the robot's description, and a tracker: tf2 would have the former for all stamps, until the next."""
    heard, hear, said = hears(buffer)
    heard.set_transform_static(_transform(7.0), "the description")
    for i in range(10):
        hear(1000.0 + 0.02 * i, 1.0)
    heard.set_transform_static(_transform(7.0), "the description")
    assert said == ["'camera' came on /tf, and what /tf_static says of it is left out: let one node send it"]
    assert seen_at(buffer, 1000.05) == pytest.approx(1.0) and seen_at(buffer, 1000.3) is None
    assert why_not(heard, 1000.05) == ""
    heard.start_over()
    heard.set_transform_static(_transform(7.0), "the description")
    assert len(said) == 1 and not heard._links.moving, "another round"


def test_a_place_on_tf_static_that_changes_is_said(buffer):
    heard, _, said = hears(buffer)
    for x, parent in ((0.1, "world"), (0.1, "/world"), (0.1 + 1e-6, "world"), (0.16, "world"), (0.16, "bed")):
        heard.set_transform_static(_transform(x, parent=parent), "the mount")
    assert len(said) == 2
    assert "'camera' came on /tf_static once more, and it moved by 60.0 mm, 0.00 deg: this holds now" in said[0]
    assert "'bed' is its parent, and no longer 'world'" in said[1]


def test_another_place_on_tf_static_ends_what_was_collected_through_it(blob_path, client, heard):
    """A hand-eye calibration that is corrected: clouds of before would be registered with those of now."""
    method = Collecting()
    with node_in_thread(
        method, blob_path, output_frame="world", accumulate=50, tf_timeout=60.0, max_future=0.0
    ) as node:
        client.wait_for_state("active")
        for x in (0.1, 0.1):
            heard.hear_static(_transform(x, child="lens", parent="camera"), "the mount")
            heard.hear_static(_transform(x, child="bed"), "the room")
        for i in range(3):
            assert see(client, heard, 1000.0 + i, camera_x=1.0, frame="lens")["level"] == 0
        heard.hear_static(_transform(0.2, child="bed"), "the room")
        assert see(client, heard, 1003.0, camera_x=1.0, frame="lens")["level"] == 0
        assert len(method.kept) == 4, "of a frame that no cloud is moved through"
        assert node.session._standing is not None
        heard.hear_static(_transform(0.102, child="lens", parent="camera"), "the mount")
        wait_until(lambda: not method.kept and node.session._standing is None)
        assert see(client, heard, 1004.0, camera_x=1.0, frame="lens")["level"] == 0
        assert len(method.kept) == 1


def test_a_frame_that_nobody_looks_through_makes_nobody_forget_the_others(buffer):
    """A tool that two nodes send, 1.5 s apart, cleared the buffer again and again."""
    heard, hear, said = hears(buffer)
    for i in range(200):
        stamp_s = 1000.0 + 0.02 * i
        hear(stamp_s, 1.0)
        assert why_not(heard, stamp_s) == ""
        for late_s in (0.0, 1.5):
            heard.set_transform(_transform(0.0, stamp_s - late_s, child="tool"), "two nodes")
    assert seen_at(buffer, 1000.01) == pytest.approx(1.0) and not said
    for i in range(100):  # a bag begins again, with all that it holds
        hear(1000.0 + 0.02 * i, 3.0)
        heard.set_transform(_transform(7.0, 1000.0 + 0.02 * i, child="tool"), "one node")
    assert why_not(heard, 1001.0) == "" and seen_at(buffer, 1001.0) == pytest.approx(3.0) and len(said) == 1
    assert heard.why_not("world", "tool", round(1001.5 * NS), 0.25) == ""


@pytest.mark.parametrize(("max_tf_gap", "level"), [(0.25, 1), (0.0, 0), (2.0, 0)])
def test_only_the_limit_refuses_a_cloud_between_transforms_that_are_far_apart(
    blob_path, client, method, heard, max_tf_gap, level
):
    options = {"output_frame": "world", "tf_timeout": 0.2, "max_future": 0.0, "max_tf_gap": max_tf_gap}
    with node_in_thread(method, blob_path, **options):
        client.wait_for_state("active")
        for stamp_s, x in ((1000.0, 1.0), (1001.0, 2.0)):
            heard.hear(_transform(x, stamp_s), "the camera")
        answer = client.ask(GOOD, frame="camera", stamp_s=1000.5)
        assert answer["level"] == level
        refused = "tf_missing: output_frame: world <- camera: 'camera' was not heard for 1 s around this stamp"
        assert (refused in answer["last_refusal"]) == bool(level)


def test_a_cloud_waits_until_it_is_clear_whether_time_went_back(blob_path, client, method, heard):
    with node_in_thread(method, blob_path, output_frame="world", tf_timeout=60.0, max_future=0.0):
        client.wait_for_state("active")
        assert see(client, heard, 999.0, camera_x=1.0)["level"] == 0
        for stamp_s, x in ((1000.0, 1.0), (1000.2, 1.0), (1000.1, 9.0)):
            heard.hear(_transform(x, stamp_s), "the camera")
        received = int(client.values()["frames_received"])
        stamp = client.send(GOOD, frame="camera", stamp_s=1000.15)
        wait_until(lambda: int(client.values()["frames_received"]) > received)
        time.sleep(0.2)
        assert client.values()["cloud_stamp"] != stamp
        heard.hear(_transform(1.0, 1000.3), "the camera")
        wait_until(lambda: client.values()["cloud_stamp"] == stamp)
        assert where(method) == pytest.approx(1.0, abs=1e-2)


def test_after_a_reset_another_round_of_transforms_may_begin_however_little_they_go_back(buffer):
    heard, hear, _ = hears(buffer)
    for stamp_s in (1000.0, 1000.5, 1000.2, 1000.9):
        hear(stamp_s, 1.0)
    heard.expect_older()
    for stamp_s in (1000.3, 1000.4):
        hear(stamp_s, 3.0)
    assert seen_at(buffer, 1000.39) == pytest.approx(3.0) and seen_at(buffer, 1000.45) is None


def test_after_a_reset_only_the_first_transform_may_begin_another_round_with_a_small_step_back(buffer):
    """The one after it is out of order by 5 ms, as where threads race."""
    heard, hear, said = hears(buffer)
    for stamp_s in (1000.0, 1000.9):
        hear(stamp_s, 1.0)
    heard.expect_older()
    for stamp_s in (1001.0, 1001.02, 1001.015):
        hear(stamp_s, 1.0)
    assert seen_at(buffer, 1000.5) == seen_at(buffer, 1001.01) == pytest.approx(1.0) and not said


def test_the_node_puts_no_transform_from_the_future_into_its_buffer(blob_path, client, method, heard):
    now_s = 1000.0
    with node_in_thread(method, blob_path, output_frame="world", tf_timeout=60.0, use_sim_time=True) as node:
        client.wait_for_state("active")
        wait_until(
            lambda: client.clock.publish(Clock(clock=Time(seconds=now_s).to_msg())) or node.now_ns() == now_s * NS
        )
        for stamp_s, x in ((999.5, 1.0), (3e7, 1.0), (999.7, 2.0), (999.9, 2.0)):
            heard.hear(_transform(x, stamp_s), "the camera")
        assert client.ask(GOOD, frame="camera", stamp_s=999.86)["level"] == 0
        assert where(method) == pytest.approx(2.0, abs=1e-2)


def test_a_long_bag_that_is_looped_without_simulated_time_goes_on_in_other_frames(blob_path, client, method, heard):
    """tf2 ignores what is 10 s older than the newest it has, and refused every cloud of the second round."""
    with node_in_thread(method, blob_path, output_frame="world", tf_timeout=4.0, max_future=0.0):
        client.wait_for_state("active")
        for _ in range(2):
            levels = [see(client, heard, 1000.0 + 4 * i, camera_x=1.0)["level"] for i in range(5)]
            assert levels[1:] == [0] * 4
