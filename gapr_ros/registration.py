"""The way of one cloud through the worker's thread: read, look up, register, convert, or refuse."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.time import Time
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from gapr_core.errors import InvalidPointCloudError
from gapr_core.geometry import se3
from gapr_core.results import RegistrationResult
from gapr_ros import intake, wire
from gapr_ros.frames import Frames
from gapr_ros.guard import describe
from gapr_ros.model import Model
from gapr_ros.outcome import Outcome
from gapr_ros.parameters import NodeParameters
from gapr_ros.refusal import OF_STATUS, Reason, RefusedError
from gapr_ros.worker import Job

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Seed:
    """A pose that somebody gave: T_frame_model (4, 4), metres, in `frame` (empty: that of the cloud)."""

    T_frame_model: Array
    frame: str


@dataclass(frozen=True)
class Situation:
    """What holds at the moment when a cloud is taken in hand."""

    method: Any
    model: Model
    parameters: NodeParameters
    epoch: int
    seed: Seed | None
    now_ns: int


class Registration:
    """Turns jobs into outcomes.

    Args:
        frames: look-up of transforms.
        situation: asked at the start of each job; its method satisfies `RegistrationMethod`, and `register` takes
            `initial` when there is a seed.
    """

    def __init__(self, frames: Frames, situation: Callable[[], Situation]) -> None:
        self._frames, self._situation = frames, situation
        self._frame: str | None = None  # of the last cloud; what the method remembers holds in it only

    def process(self, job: Job) -> Outcome:
        """The outcome of one cloud; never raises."""
        outcome, start = Outcome(job), time.monotonic()
        try:
            self._run(outcome, self._situation(), start)
        except RefusedError as refusal:
            outcome.refuse(refusal.reason, refusal.text)
        except InvalidPointCloudError as error:  # sizes and values that the method itself rejects
            outcome.refuse(Reason.UNIT_MISMATCH, str(error))
        except Exception as error:
            outcome.refuse(Reason.NOT_CONVERGED, f"the registration failed: {describe(error)}")
        outcome.exec_ms = (time.monotonic() - start) * 1000.0
        return outcome

    def _run(self, outcome: Outcome, now: Situation, start: float) -> None:
        if outcome.job.epoch != now.epoch:
            raise RefusedError(Reason.SUPERSEDED_BY_RESET, "the cloud is older than the last reset")
        cloud = intake.read_message(outcome.job.cloud)
        _note_header(outcome, cloud, now)
        self._watch_frame(outcome.header.frame_id, now)
        for earlier in outcome.job.earlier:
            outcome.merged += self._collect(earlier, outcome.header.frame_id, now)
        intake.check_age(cloud.header, now.now_ns, now.parameters.max_cloud_age)
        points_mm = self._points_mm(cloud, outcome.cloud_header, outcome.header.frame_id, now)
        source = _gather(points_mm, outcome, now)
        result = self._register(source, outcome, now)
        _check(result, time.monotonic() - start, now.parameters)
        _note_pose(outcome, result, _registered(source, now), now.parameters)

    def _watch_frame(self, frame: str, now: Situation) -> None:
        """Poses and clouds that the method remembers are of one frame."""
        if self._frame not in (None, frame) and hasattr(now.method, "reset"):
            now.method.reset()
        self._frame = frame

    def _points_mm(self, cloud: PointCloud2, header: Header, frame: str, now: Situation) -> Array:
        """(N, 3) points of a cloud, mm, in the frame of the answer."""
        T_frame_cloud = self._lookup(frame, header, now)
        return wire.moved_mm(T_frame_cloud, intake.take_in(cloud, now.model.extent_mm, now.parameters))

    def _collect(self, data: bytes, frame: str, now: Situation) -> bool:
        """Keep a cloud that a newer one pushed out of the mailbox. False when it cannot be used."""
        try:
            cloud = intake.read_message(data)
            if not now.parameters.output_frame and cloud.header.frame_id != frame:
                return False
            now.method.collect(self._points_mm(cloud, cloud.header, frame, now))
        except RefusedError:
            return False
        return True

    def _register(self, points_mm: Array, outcome: Outcome, now: Situation) -> RegistrationResult:
        seed = self._initial(outcome, now)
        options = {} if seed is None else {"initial": seed}
        result = now.method.register(points_mm, now.model.target, **options)
        outcome.confidence, outcome.inlier_ratio = float(result.confidence), float(result.inlier_ratio)
        outcome.tre_mm, outcome.found_by = result.tre_mm, str(result.details.get("proposer", ""))
        return result

    def _initial(self, outcome: Outcome, now: Situation) -> Array | None:
        """The seed as T_target_source, mm, the source being in the frame of the answer."""
        if now.seed is None:
            return None
        T_seed_cloud = self._lookup(now.seed.frame, outcome.cloud_header, now)
        T_frame_cloud = self._lookup(outcome.header.frame_id, outcome.cloud_header, now)
        return wire.core_pose(T_frame_cloud @ se3.inverse(T_seed_cloud) @ now.seed.T_frame_model)

    def _lookup(self, frame: str, header: Header, now: Situation) -> Array:
        """T_frame_cloud at the cloud's stamp; no frame is that of the cloud."""
        if not frame:
            return np.eye(4)
        return self._frames.lookup(frame, header.frame_id, Time.from_msg(header.stamp), now.parameters.tf_timeout)


def _gather(points_mm: Array, outcome: Outcome, now: Situation) -> Array:
    """What the method is given: nothing where it has the cloud already; too few points are kept for the next cloud."""
    if now.parameters.accumulate == 1:
        outcome.points_used = len(points_mm)
        return points_mm
    if outcome.job.again:
        points_mm = points_mm[:0]
    outcome.points_used = len(now.method.collected) + len(points_mm)
    if outcome.points_used < now.parameters.min_points:
        now.method.collect(points_mm)
    intake.check_count(outcome.points_used, now.parameters.min_points)
    return points_mm


def _registered(points_mm: Array, now: Situation) -> Array:
    """(N, 3) all points of the answer, mm, about whose middle its covariance turns."""
    return points_mm if now.parameters.accumulate == 1 else now.method.collected


def _note_header(outcome: Outcome, cloud: PointCloud2, now: Situation) -> None:
    """Frame and stamp of the answer; a cloud without a stamp gets the time at which it arrived."""
    stamp_ns = intake.stamp_ns(cloud.header)
    outcome.points_in = cloud.width * cloud.height
    outcome.header.frame_id = now.parameters.output_frame or cloud.header.frame_id
    outcome.header.stamp = Time(nanoseconds=stamp_ns or outcome.job.received_ns).to_msg()
    outcome.cloud_header = Header(frame_id=cloud.header.frame_id, stamp=outcome.header.stamp)
    outcome.age_s = (now.now_ns - stamp_ns) * 1e-9 if stamp_ns and now.now_ns else None


def _check(result: RegistrationResult, seconds: float, parameters: NodeParameters) -> None:
    """Refuse what the method refused, what took too long and what is not sure enough."""
    if seconds > parameters.timeout:
        raise RefusedError(Reason.TIMEOUT, f"took {seconds:.3g} s, timeout is {parameters.timeout:g} s")
    if not result.ok:
        raise RefusedError(OF_STATUS[result.status], result.reason)
    if not result.confidence >= parameters.min_confidence:
        text = f"confidence {result.confidence:.2f}, min_confidence is {parameters.min_confidence:g}"
        raise RefusedError(Reason.LOW_CONFIDENCE, text)
    for name, value in (("pose", result.T_target_source), ("covariance", result.covariance)):
        if value is None or not np.isfinite(value).all():
            raise RefusedError(Reason.NOT_CONVERGED, f"{result.method} gave no finite {name}")


def _note_pose(outcome: Outcome, result: RegistrationResult, points_mm: Array, parameters: NodeParameters) -> None:
    assert result.T_target_source is not None and result.covariance is not None
    floors = (parameters.covariance_floor_translation, parameters.covariance_floor_rotation)
    outcome.pose = wire.wire_pose(result.T_target_source)
    outcome.covariance = wire.wire_covariance(result.covariance, result.T_target_source, points_mm.mean(axis=0), floors)
