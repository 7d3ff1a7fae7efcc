"""Check points: positions that a tracked pointer touched on the bone, against the last accepted pose."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseArray
from numpy.typing import NDArray

from gapr_core.config import RegistrarConfig, SensorConfig
from gapr_core.errors import GaprError
from gapr_core.results import PointCheck, Verdict
from gapr_ros.node import timeline, units
from gapr_ros.node.diagnostics import status_message
from gapr_ros.node.intake import plain_frame
from gapr_ros.node.method import configured
from gapr_ros.node.model import Ready
from gapr_ros.node.outcome import Outcome
from gapr_ros.parameters import NodeParameters

Array = NDArray[np.float64]
OLD_S = 5.0  # age of a pose from which on the text says it: the bone may have moved since
NO_POINTS = "no check points that are finite: touch the bone, and publish the tip's positions (PoseArray, metres)"
NONE_NEAR = "none near the bone: are they in metres, and of the tip of a calibrated pointer?"
LEVELS = {
    Verdict.HOLDS: DiagnosticStatus.OK,
    Verdict.SAYS_LITTLE: DiagnosticStatus.WARN,
    Verdict.CONTRADICTED: DiagnosticStatus.ERROR,
}


class NothingToCheckError(Exception):
    """There is no verdict; the text says why."""


def check(message: PoseArray, accepted: Outcome | None, ready: Ready, parameters: NodeParameters) -> PointCheck:
    """What touched points say of the last accepted pose.

    Args:
        message: positions of the pointer's tip, metres, in the frame of the pose; orientations do not count.
        accepted: what became of the last cloud with a pose that still stands; None where there is none.
        ready: the bone, and the method whose settings say what the bone's model and a pointer err by.
        parameters: of the node, for a method that has no settings; where `sensor` is not a pointer, what is usual of
            one is assumed.

    Raises:
        NothingToCheckError: no pose, another frame, no points, or a method that says no covariance.
    """
    from gapr_core import check_points

    if accepted is None or accepted.result is None:
        raise NothingToCheckError("no pose was accepted, or the last one was withdrawn: register first")
    frame, wanted = plain_frame(message.header.frame_id), accepted.header.frame_id
    if frame != wanted:
        raise NothingToCheckError(f"check points in '{frame}', the pose is in '{wanted}': publish them there")
    positions = [[pose.position.x, pose.position.y, pose.position.z] for pose in message.poses]
    points_mm = units.to_mm(np.array(positions, dtype=np.float64).reshape(-1, 3), "m")
    if not np.isfinite(points_mm).all(axis=1).any():
        raise NothingToCheckError(NO_POINTS)
    try:
        return check_points(points_mm, ready.model.target, accepted.result, _config(ready.method, parameters))
    except GaprError as error:
        raise NothingToCheckError(str(error)) from error


def status(
    message: PoseArray, found: PointCheck | str, accepted: Outcome | None, now_ns: int, name: str, hardware_id: str
) -> DiagnosticStatus:
    """The verdict on an accepted pose with its numbers, lengths in metres; or why there is none."""
    age_s = accepted and timeline.age_s(timeline.stamp_ns(accepted.header), now_ns)
    values: dict[str, object] = {
        "stamp": timeline.stamp_text(message.header),
        "frame": plain_frame(message.header.frame_id),
        "points": 0 if isinstance(found, str) else len(found.points),
        "pose_stamp": timeline.stamp_text(accepted.header) if accepted else "",
        "pose_age": age_s,
    }
    if isinstance(found, str):
        return status_message(
            DiagnosticStatus.WARN, f"{name}: check points", hardware_id, found, {"verdict": ""} | values
        )
    largest_mm = float(np.abs(found.distance_mm).max())  # NaN where no surface is near
    values |= {
        "probability": found.probability,
        "largest_distance": units.to_metres(largest_mm),
        "shown": units.to_metres(found.shown_mm),
        "unseen": units.to_metres(found.unseen_mm),
        "tre95": units.to_metres(found.tre95_mm),
        "next_point": " ".join(f"{value:.4f}" for value in units.to_metres(found.next_point)),
    }
    values = {"verdict": str(found.verdict)} | values
    said = _said(message, found, age_s or 0.0)
    return status_message(LEVELS[found.verdict], f"{name}: check points", hardware_id, said, values)


def _said(message: PoseArray, found: PointCheck, age_s: float) -> str:
    """The verdict as text, with what a user should know before acting on it."""
    said, left_out = found.text(NONE_NEAR), len(message.poses) - len(found.points)
    said += f"  not finite and left out: {left_out}" if left_out else ""
    return said + (f"  the pose is {age_s:.0f} s old" if age_s > OLD_S else "")


def _config(method: Any, parameters: NodeParameters) -> RegistrarConfig:
    """The settings that clouds are registered with; of the pointer what is usual, where the clouds are not its own."""
    own = getattr(method, "config", None)
    config = own if isinstance(own, RegistrarConfig) else configured(RegistrarConfig(), parameters)
    return config if config.sensor.kind == "pointer" else replace(config, sensor=SensorConfig(kind="pointer"))
