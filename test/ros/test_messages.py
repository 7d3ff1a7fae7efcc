"""What is said of a cloud besides its pose: status, hypotheses, residuals, guidance, detection."""

from __future__ import annotations

import logging
import time
import types
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest
from builtin_interfaces.msg import Time as TimeMessage
from geometry_msgs.msg import Pose, PoseStamped, PoseWithCovariance, Vector3
from harness import NODE, accepted, node_in_thread, wait_until
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from gapr_core.geometry import se3
from gapr_core.results import Guidance, Patch, RegistrationResult, RegistrationStatus, Residuals
from gapr_ros.node import publish, report
from gapr_ros.node.host import RosLogHandler
from gapr_ros.node.outcome import OF_STATUS, Found, Outcome, Reason
from gapr_ros.node.publish import TOPICS
from gapr_ros.node.worker import Job
from msg_adapters import pose_to_matrix

GOOD = np.random.default_rng(1).normal(size=(1000, 3)) * 0.02


def outcome(result=None, pose=None, reason=None):
    found = None if pose is None else Found(pose, np.diag([1e-6] * 6))
    job, header = Job(b"", 0, 0), Header(frame_id="probe")
    return Outcome(job, "probe", header, reason, "", found, result=result or accepted())


def test_every_status_of_the_core_but_ok_has_a_reason_of_the_same_name():
    assert set(OF_STATUS) == set(RegistrationStatus) - {RegistrationStatus.OK}
    assert {status.value.lower() for status in OF_STATUS} == {reason.value for reason in OF_STATUS.values()}
    assert OF_STATUS[RegistrationStatus.IMPRECISE] is Reason.IMPRECISE
    assert OF_STATUS[RegistrationStatus.CLUTTER] is Reason.CLUTTER


@pytest.fixture
def heard(client):
    """Messages by topic."""
    kept = {name: [] for name in ("debug/residuals", "debug/guidance", "debug/next_view")}
    for name, messages_kept in kept.items():
        client.node.create_subscription(TOPICS[name][0], f"{NODE}/{name}", messages_kept.append, 10)
    return kept


@pytest.fixture
def live(blob_path, client, method, heard):
    with node_in_thread(method, blob_path) as node:
        client.wait_for_state("active")
        for name in heard:
            wait_until(lambda name=name: client.node.count_publishers(f"{NODE}/{name}"))
        wait_until(lambda: all(p.get_subscription_count() for k, p in node.session._publishers._topics.items()
                               if k in heard))  # fmt: skip
        yield node, client, method, heard


def test_residuals_and_guidance_are_sent_in_metres(live):
    node, client, method, heard = live
    points_mm = np.array([[10.0, 20.0, 30.0], [40.0, 50.0, 60.0]])
    residuals = Residuals(points_mm, np.array([1.5, np.nan]), np.array([True, False]))
    patch = Patch(np.array([100.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), 1.0, 0.5, 2.0)
    guidance = Guidance(points_mm, np.array([2.0, 0.0]), 3.0, (patch,))
    method.answer = RegistrationResult(RegistrationStatus.AMBIGUOUS, residuals=residuals, guidance=guidance)
    client.ask(GOOD)
    wait_until(lambda: all(heard[f"debug/{name}"] for name in ("residuals", "guidance", "next_view")))
    (sent,), (gain,), (view,) = (heard[f"debug/{name}"] for name in ("residuals", "guidance", "next_view"))
    rows = records(sent)
    assert sent.header.frame_id == "probe" and rows.dtype.names == ("x", "y", "z", "distance", "inlier")
    np.testing.assert_allclose([rows[name] for name in "xyz"], points_mm.T / 1000.0, atol=1e-7)
    np.testing.assert_allclose(rows["distance"], [0.0015, np.nan], atol=1e-8)
    assert rows["inlier"].tolist() == [1, 0]
    assert gain.header.frame_id == "bone_preop" and records(gain)["intensity"].tolist() == pytest.approx([0.002, 0.0])
    T = pose_to_matrix(view)
    np.testing.assert_allclose(T[:3, 3], [0.1, 0.0, 0.0])
    np.testing.assert_allclose(T[:3, 0], [0.0, 0.0, 1.0], atol=1e-12, err_msg="x leaves the bone")
    assert isinstance(view, PoseStamped) and isinstance(sent, PointCloud2)
    assert gain.header.stamp == view.header.stamp == TimeMessage(), "refused: tf2 has no bone at the cloud's stamp"
    method.answer = accepted(guidance=guidance)
    client.ask(GOOD, stamp_s=time.time())
    wait_until(lambda: len(heard["debug/next_view"]) == 2 and client.poses)
    assert heard["debug/next_view"][1].header.stamp == client.poses[-1].header.stamp


def records(cloud):
    codes = {7: "<f4", 8: "<f8", 2: "u1"}
    dtype = np.dtype({"names": [f.name for f in cloud.fields], "formats": [codes[f.datatype] for f in cloud.fields],
                      "offsets": [f.offset for f in cloud.fields], "itemsize": cloud.point_step})  # fmt: skip
    return np.frombuffer(bytes(cloud.data), dtype)


@pytest.mark.parametrize("seed", range(20))
def test_the_next_view_is_a_rotation_for_every_normal(seed):
    normal = np.random.default_rng(seed).normal(size=3) if seed > 5 else np.eye(3)[seed % 3] * (-1) ** seed
    R = publish._with_x(normal)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    np.testing.assert_allclose(R[:, 0], normal / np.linalg.norm(normal), atol=1e-12)


def test_max_tre_refuses_a_pose_that_nothing_else_refuses(live):
    node, client, method, _ = live
    method.answer = accepted(confidence=0.99, tre95_mm=2.1)
    assert client.ask(GOOD)["level"] == 0
    assert node.set_parameters([Parameter("max_tre", value=0.002)])[0].successful
    assert client.ask(GOOD)["last_refusal"].startswith("imprecise: the 95 % bound of the error is 0.0021 m")
    method.answer = accepted(confidence=0.99, tre95_mm=1.9)
    assert client.ask(GOOD)["level"] == 0
    method.answer = accepted(confidence=0.99)
    assert "imprecise" in client.ask(GOOD)["last_refusal"], "a method that gives no bound has none"


# --- detection: vision_msgs is part of a ROS installation, so its messages are stood in for here ---


@dataclass
class ObjectHypothesis:
    class_id: str = ""
    score: float = 0.0


@dataclass
class ObjectHypothesisWithPose:
    hypothesis: ObjectHypothesis = field(default_factory=ObjectHypothesis)
    pose: PoseWithCovariance = field(default_factory=PoseWithCovariance)


@dataclass
class BoundingBox3D:
    center: Pose = field(default_factory=Pose)
    size: Vector3 = field(default_factory=Vector3)


@dataclass
class Detection3D:
    header: Header = field(default_factory=Header)
    results: list = field(default_factory=list)
    bbox: BoundingBox3D = field(default_factory=BoundingBox3D)
    id: str = ""


@dataclass
class Detection3DArray:
    header: Header = field(default_factory=Header)
    detections: list = field(default_factory=list)


VISION = types.SimpleNamespace(
    ObjectHypothesisWithPose=ObjectHypothesisWithPose, Detection3D=Detection3D, Detection3DArray=Detection3DArray
)


def test_a_detection_has_pose_score_and_the_box_of_the_bone():
    points_mm = np.array([[0.0, 0.0, 0.0], [100.0, 40.0, 20.0]])
    T = se3.from_rotation_translation(se3.random_rotation(np.random.default_rng(0)), [0.5, 0.1, 0.2])
    (one,) = publish.detection(VISION, outcome(pose=T), "femur", points_mm).detections
    assert (one.id, one.results[0].hypothesis.class_id, one.results[0].hypothesis.score) == ("femur", "femur", 0.9)
    np.testing.assert_allclose(pose_to_matrix(one.results[0].pose.pose), T, atol=1e-12)
    middle = se3.apply(T, np.array([[0.05, 0.02, 0.01]]))[0]
    np.testing.assert_allclose(pose_to_matrix(one.bbox.center)[:3, 3], middle, atol=1e-12)
    assert (one.bbox.size.x, one.bbox.size.y, one.bbox.size.z) == pytest.approx((0.1, 0.04, 0.02))
    assert publish.detection(VISION, outcome(reason=Reason.JUMP), "femur", points_mm).detections == []


def test_the_z_axis_of_the_next_view_is_as_far_up_as_can_be():
    for normal in ([1.0, 0.0, 0.0], [0.6, 0.0, 0.8], [-0.3, 0.5, -0.2]):
        x = np.array(normal) / np.linalg.norm(normal)
        assert publish._with_x(x)[2, 2] == pytest.approx(np.hypot(x[0], x[1]))


def test_a_failure_in_the_log_comes_with_its_reason():
    said = []
    handler = RosLogHandler(SimpleNamespace(error=said.append, warning=said.append))
    log = logging.getLogger("test of the handler")
    log.addHandler(handler)
    try:
        raise OSError("no such settings file")
    except OSError:
        log.exception("work failed")
    log.removeHandler(handler)
    assert len(said) == 1 and said[0].startswith("work failed") and "no such settings file" in said[0]


@pytest.mark.parametrize(("value", "text"), [
    (11730.4, "11730.4"), (0.00071, "0.00071"), (1e16, "1e+16"), (7, "7"), (float("nan"), "nan"), (None, ""),
])  # fmt: skip
def test_values_are_written_as_short_text(value, text):
    found = report.status_message(b"\x00", "a", "", "", {"value": value})
    assert found.values[0].value == text
