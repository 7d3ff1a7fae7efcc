"""What tf2 has heard of other frames, when time starts over: nothing of one round is mixed with another."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from harness import node_in_thread, wait_until
from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

from gapr_ros.node import frames

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
        self.clear, self._insert = self._core.clear, self._core.set_transform

    def insert(self, stamp_s, x):
        self._insert(_transform(x, stamp_s), "the camera")

    def can_transform(self, parent, child, stamp):
        return self._core.can_transform_core(parent, child, stamp)[0]

    def lookup_transform(self, parent, child, stamp):
        try:
            return self._core.lookup_transform_core(parent, child, stamp)
        except self._errors as error:
            raise Missing(str(error)) from error


def _transform(x, stamp_s=0.0):
    transform = TransformStamped(child_frame_id="camera")
    transform.header.frame_id, transform.header.stamp = "world", Time(nanoseconds=round(stamp_s * 1e9)).to_msg()
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

    listener = SimpleNamespace(unregister=lambda: None)
    names = {"Buffer": make, "TransformListener": lambda *_: listener, "TransformException": Missing}
    monkeypatch.setattr(frames, "_import_tf2", lambda: SimpleNamespace(**names))
    return buffer


def see(client, buffer, stamp_s, camera_x):
    """Send a cloud between two transforms of its camera; the answer."""
    buffer.insert(stamp_s - LATE_S, camera_x)
    received = int(client.values()["frames_received"])
    stamp = client.send(GOOD, frame="camera", stamp_s=stamp_s)
    wait_until(lambda: int(client.values()["frames_received"]) > received)
    buffer.insert(stamp_s + LATE_S, camera_x)
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
        for i in range(6):
            answers.append(see(client, heard, back_to_s + 0.1 * i, camera_x=3.0))
            if len(method.calls) > calls:
                assert where(method) == pytest.approx(3.0, abs=1e-2)
        assert [answer["level"] for answer in answers[-3:]] == [0] * 3, answers


def test_a_long_bag_that_is_looped_without_simulated_time_goes_on_in_other_frames(blob_path, client, method, heard):
    """tf2 ignores what is 10 s older than the newest it has, and refused every cloud of the second round."""
    with node_in_thread(method, blob_path, output_frame="world", tf_timeout=4.0, max_future=0.0):
        client.wait_for_state("active")
        for _ in range(2):
            levels = [see(client, heard, 1000.0 + 4 * i, camera_x=1.0)["level"] for i in range(5)]
            assert levels[1:] == [0] * 4
