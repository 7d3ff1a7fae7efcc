"""What the node says about a cloud besides its pose, as messages; lengths in metres."""

from __future__ import annotations

from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseArray, PoseStamped
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from gapr_core.geometry import se3
from gapr_core.results import Guidance, Residuals
from gapr_ros.node import timeline, units
from gapr_ros.node.diagnostics import status_message
from gapr_ros.node.outcome import Outcome
from msg_adapters import matrix_to_pose, xyz_to_cloud

Array = NDArray[np.float64]
NEARLY_UP = 0.999  # cosine beyond which a direction has no side that is up


def status(outcome: Outcome, name: str, hardware_id: str) -> DiagnosticStatus:
    """What became of a cloud: everything that a consumer needs to decide on its pose, or on doing without one.

    The confidence and the errors are those of the registration, whatever the node decided later.
    """
    result = outcome.result
    values = {
        "stamp": timeline.stamp_text(outcome.header),
        "frame": outcome.header.frame_id,
        "status": "" if result is None else str(result.status),
        "reason": "" if outcome.reason is None else str(outcome.reason),
        "confidence": outcome.confidence,
        "tre": _metres(outcome.tre_mm),
        "tre95": _metres(outcome.tre95_mm),
        "inlier_ratio": outcome.inlier_ratio,
        "points_used": outcome.points_used,
        "exec_ms": outcome.exec_ms,
    }
    level = DiagnosticStatus.OK if outcome.ok else DiagnosticStatus.WARN
    return status_message(level, f"{name}: cloud", hardware_id, str(outcome), values)


def hypotheses(outcome: Outcome) -> PoseArray:
    """The poses that were compared and are not believed, best first: on a refusal all, else those behind the pose."""
    found = () if outcome.result is None else outcome.result.hypotheses
    poses = [units.ros_pose(each.T_target_source) for each in found[1 if outcome.ok else 0 :]]
    return PoseArray(header=outcome.header, poses=[matrix_to_pose(T) for T in poses])


def residuals(found: Residuals, header: Header) -> PointCloud2:
    """The used points with their signed distance from the bone, m, NaN where none is near, and 1 for inliers.

    The stand-off of the sensor is taken off.
    """
    fields = {
        "distance": units.to_metres(found.distance_mm).astype("f4"),
        "inlier": found.inlier.astype("u1"),
    }
    return xyz_to_cloud(units.to_metres(found.points).astype("f4"), header, fields=fields)


def guidance(found: Guidance, header: Header) -> PointCloud2:
    """The bone's points; intensity is by how much a look there would lower the bound of the error, m."""
    gain = units.to_metres(found.gain_mm).astype("f4")
    return xyz_to_cloud(units.to_metres(found.points).astype("f4"), header, fields={"intensity": gain})


def next_view(found: Guidance, header: Header) -> PoseStamped:
    """The middle of the best patch; the x axis leaves the bone there: look from where it points."""
    best = found.patches[0]
    T = se3.from_rotation_translation(_with_x(best.normal), units.to_metres(best.centre))
    return PoseStamped(header=header, pose=matrix_to_pose(T))


def detection(types: Any, outcome: Outcome, class_id: str, points_mm: Array) -> Any:
    """A vision_msgs/Detection3DArray: one detection of an accepted pose, none of a refusal.

    Args:
        types: the module `vision_msgs.msg`.
        outcome: of the cloud.
        class_id: names the bone.
        points_mm: (M, 3) of the bone in its own frame, whose box is sent.
    """
    message = types.Detection3DArray(header=outcome.header)
    if outcome.found is None:
        return message
    low, high = units.to_metres(points_mm.min(axis=0)), units.to_metres(points_mm.max(axis=0))
    sole = types.ObjectHypothesisWithPose()
    sole.hypothesis.class_id, sole.hypothesis.score = class_id, outcome.confidence
    sole.pose.pose = matrix_to_pose(outcome.found.pose)
    sole.pose.covariance = [float(value) for value in outcome.found.covariance.ravel()]
    one = types.Detection3D(header=outcome.header, results=[sole], id=class_id)
    middle = outcome.found.pose @ se3.from_rotation_translation(np.eye(3), 0.5 * (low + high))
    one.bbox.center = matrix_to_pose(middle)
    one.bbox.size.x, one.bbox.size.y, one.bbox.size.z = (high - low).tolist()
    message.detections = [one]
    return message


def vision_types() -> Any | None:
    """The module `vision_msgs.msg`, part of a ROS installation and not of the wheels; None without it."""
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
