"""What the node sends: the bone once, the outcome of every cloud, accepted poses, and what helps to look."""

from __future__ import annotations

from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from numpy.typing import NDArray
from rclpy.lifecycle import LifecyclePublisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from gapr_core.geometry import se3
from gapr_core.results import Guidance, RegistrationResult, Residuals
from gapr_ros.node import units
from gapr_ros.node.frames import Frames
from gapr_ros.node.host import Host
from gapr_ros.node.model import Model
from gapr_ros.node.outcome import Found, Outcome, stamp_ns
from gapr_ros.node.report import status_message, warnings_of
from msg_adapters import covariance_to_list, matrix_to_pose, matrix_to_transform, xyz_to_cloud

Array = NDArray[np.float64]
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
TOPICS = {
    "pose": (PoseWithCovarianceStamped, LATCHED),
    "status": (DiagnosticArray, LATCHED),
    "model": (PointCloud2, LATCHED),
    "debug/transform": (TransformStamped, 10),
    "debug/residuals": (PointCloud2, 1),
    "debug/guidance": (PointCloud2, 1),
    "debug/next_view": (PoseStamped, 1),
    "debug/aligned": (PointCloud2, 1),
}
NO_VISION = "vision_msgs is not installed, so there is no ~/detection: ~/status carries the same"
NEARLY_UP = 0.999  # cosine beyond which a direction has no side that is up


class Publishers:
    """The topics under `~/`, and /tf; silent while the node is not active."""

    def __init__(self, host: Host, frames: Frames) -> None:
        self._host, self._frames, self._vision = host, frames, vision_types()
        self._kinds: dict[str, Any] = dict(TOPICS)
        if self._vision is None:
            host.ros.get_logger().info(NO_VISION)
        else:
            self._kinds["detection"] = self._vision.Detection3DArray, LATCHED
        self._topics = {name: self._advertise(name) for name in self._kinds}

    def send_model(self, model: Model) -> None:
        """Send the bone, latched, in its own frame."""
        header = self._of_model(Time())  # stamp 0: wherever the frame is now; tf2 has forgotten the start after 10 s
        self._topics["model"].publish(xyz_to_cloud(units.to_metres(model.points_mm).astype("f4"), header))

    def send(self, outcome: Outcome, model: Model) -> None:
        """Send the outcome of a cloud."""
        self._topics["status"].publish(self._status(outcome.header, status_of(outcome, self._name, model.file)))
        if self._vision is not None:
            class_id = self._host.parameters.model_frame
            self._topics["detection"].publish(detection(self._vision, outcome, class_id, model.points_mm))
        if outcome.found is not None:
            self._send_pose(outcome.found, outcome.header)
            if self._is_heard("debug/aligned"):
                points = se3.apply(outcome.found.pose, units.to_metres(model.points_mm))
                self._topics["debug/aligned"].publish(xyz_to_cloud(points.astype("f4"), outcome.header))
        if outcome.result is not None:
            self._send_seen(outcome.result, outcome)

    def withdraw(self, why: str, header: Header, model: Model) -> None:
        """Take the last pose back: late listeners get none, the others an empty detection and a status."""
        self._renew("pose")
        if self._vision is not None:
            self._topics["detection"].publish(self._vision.Detection3DArray(header=header))
        values = {"status": "", "reason": "withdrawn", "detail": why, "confidence": 0.0}
        message = f"the pose was withdrawn: {why}"
        status = status_message(DiagnosticStatus.WARN, f"{self._name}: cloud", model.file, message, values)
        self._topics["status"].publish(self._status(header, status))

    def withdraw_all(self) -> None:
        """Empty the latched topics: the node no longer knows the pose."""
        for name in ("pose", "status", "model", *(["detection"] if self._vision is not None else [])):
            self._renew(name)

    def close(self) -> None:
        """Give the topics back."""
        for publisher in self._topics.values():
            self._host.ros.destroy_lifecycle_publisher(publisher)

    @property
    def _name(self) -> str:
        return str(self._host.ros.get_fully_qualified_name())

    def _renew(self, name: str) -> None:
        """Give a publisher up and advertise again: with it goes the message that it keeps."""
        old, self._topics[name] = self._topics[name], self._advertise(name)
        if old.is_activated:
            self._topics[name].on_activate(None)
        self._host.ros.destroy_lifecycle_publisher(old)

    def _advertise(self, name: str) -> LifecyclePublisher:
        kind, qos = self._kinds[name]
        return self._host.ros.create_lifecycle_publisher(kind, f"~/{name}", qos)

    def _of_model(self, stamp: Time) -> Header:
        return Header(frame_id=self._host.parameters.model_frame, stamp=stamp)

    def _is_heard(self, name: str) -> bool:
        return self._topics[name].get_subscription_count() > 0

    def _status(self, header: Header, status: DiagnosticStatus) -> DiagnosticArray:
        return DiagnosticArray(header=header, status=[status])

    def _send_pose(self, found: Found, header: Header) -> None:
        message = PoseWithCovarianceStamped(header=header)
        message.pose.pose = matrix_to_pose(found.pose)
        message.pose.covariance = covariance_to_list(found.covariance)
        self._topics["pose"].publish(message)
        transform = TransformStamped(header=header, child_frame_id=self._host.parameters.model_frame)
        transform.transform = matrix_to_transform(found.pose)
        self._topics["debug/transform"].publish(transform)
        self._frames.send(transform, stamp_ns(header))

    def _send_seen(self, result: RegistrationResult, outcome: Outcome) -> None:
        """Send the topics for people, above all with refusals."""
        if result.residuals is not None and self._is_heard("debug/residuals"):
            self._topics["debug/residuals"].publish(residuals(result.residuals, outcome.header))
        if result.guidance is not None and result.guidance.patches:
            # tf2 has the bone at the stamp of an accepted cloud; of a refused one, where it was last: at stamp 0
            header = self._of_model(outcome.header.stamp if outcome.ok else Time())
            self._topics["debug/guidance"].publish(guidance(result.guidance, header))
            self._topics["debug/next_view"].publish(next_view(result.guidance, header))


def status_of(outcome: Outcome, name: str, hardware_id: str) -> DiagnosticStatus:
    """Make the status from which a consumer decides; lengths in metres, angles in radians.

    The confidence and the errors are those of the registration, whatever the node decided later.
    """
    result, found = outcome.result, outcome.found
    values: dict[str, object] = {
        "status": "" if result is None else str(result.status),
        "reason": "" if outcome.reason is None else str(outcome.reason),
        "detail": outcome.text,
        "confidence": outcome.confidence,
        "pose_probability": None if result is None else result.pose_probability,
        "bone_evidence": None if result is None else result.bone_evidence,
        "tre": None if result is None else _metres(result.tre_mm),
        "tre95": None if result is None else _metres(result.tre95_mm),
        "inlier_ratio": 0.0 if result is None else float(result.inlier_ratio),
        "points_used": outcome.points_used,
        "seconds": outcome.exec_s,
        "warnings": warnings_of(result),
        "findings": "" if result is None else "; ".join(f"{each.check}: {each.text}" for each in result.findings),
    }
    if found is not None:
        pose = matrix_to_pose(found.pose)
        p, q = pose.position, pose.orientation
        values["pose"] = " ".join(f"{x:.9g}" for x in (p.x, p.y, p.z, q.x, q.y, q.z, q.w))
        values["covariance"] = " ".join(f"{x:.6g}" for x in covariance_to_list(found.covariance))
    level = DiagnosticStatus.OK if outcome.ok else DiagnosticStatus.WARN
    return status_message(level, f"{name}: cloud", hardware_id, outcome.line, values)


def detection(types: Any, outcome: Outcome, class_id: str, points_mm: Array) -> Any:
    """Make a vision_msgs/Detection3DArray: pose, covariance, confidence and box of the bone; empty for a refusal.

    Args:
        types: the module `vision_msgs.msg`.
        outcome: of the cloud.
        class_id: names the bone.
        points_mm: (M, 3) of the bone in its own frame, whose box is sent.
    """
    message, found = types.Detection3DArray(header=outcome.header), outcome.found
    if found is None:
        return message
    low, high = units.to_metres(points_mm.min(axis=0)), units.to_metres(points_mm.max(axis=0))
    sole = types.ObjectHypothesisWithPose()
    sole.hypothesis.class_id, sole.hypothesis.score = class_id, outcome.confidence
    sole.pose.pose, sole.pose.covariance = matrix_to_pose(found.pose), covariance_to_list(found.covariance)
    one = types.Detection3D(header=outcome.header, results=[sole], id=class_id)
    one.bbox.center = matrix_to_pose(found.pose @ se3.from_rotation_translation(np.eye(3), 0.5 * (low + high)))
    one.bbox.size.x, one.bbox.size.y, one.bbox.size.z = (high - low).tolist()
    message.detections = [one]
    return message


def residuals(found: Residuals, header: Header) -> PointCloud2:
    """Make a cloud of the used points: distance from the bone, m (NaN if none is near), and 1 for inliers.

    The stand-off of the sensor is taken off.
    """
    fields = {
        "distance": units.to_metres(found.distance_mm).astype("f4"),
        "inlier": found.inlier.astype("u1"),
    }
    return xyz_to_cloud(units.to_metres(found.points).astype("f4"), header, fields=fields)


def guidance(found: Guidance, header: Header) -> PointCloud2:
    """Make a cloud of the bone; intensity is how far a look there would lower the error's bound, m."""
    gain = units.to_metres(found.gain_mm).astype("f4")
    return xyz_to_cloud(units.to_metres(found.points).astype("f4"), header, fields={"intensity": gain})


def next_view(found: Guidance, header: Header) -> PoseStamped:
    """Make the pose of the best patch's middle; its x axis leaves the bone, towards the sensor."""
    best = found.patches[0]
    T = se3.from_rotation_translation(_with_x(best.normal), units.to_metres(best.centre))
    return PoseStamped(header=header, pose=matrix_to_pose(T))


def vision_types() -> Any | None:
    """Return the module `vision_msgs.msg`, part of a ROS installation and not of the wheels; None without it."""
    try:
        import vision_msgs.msg
    except ImportError:
        return None
    return vision_msgs.msg


def _metres(length_mm: float | None) -> float | None:
    return None if length_mm is None else units.to_metres(length_mm)


def _with_x(direction: Array) -> Array:
    """(3, 3) rotation whose x axis is along a direction; its z axis is as far up as can be."""
    x = direction / np.linalg.norm(direction)
    up = np.array([0.0, 0.0, 1.0] if abs(x[2]) < NEARLY_UP else [1.0, 0.0, 0.0])
    y = np.cross(up, x)
    y /= np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])
