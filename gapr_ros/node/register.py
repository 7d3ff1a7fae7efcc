"""The way of one cloud through the worker's thread: read, look up, register, convert, or refuse."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.time import Time
from std_msgs.msg import Header

from gapr_core.baselines.base import takes
from gapr_core.errors import InvalidPointCloudError, InvalidViewpointError
from gapr_core.geometry import se3
from gapr_core.results import RegistrationResult
from gapr_ros.node import cloud, units
from gapr_ros.node.frames import Frames
from gapr_ros.node.gate import check_age, check_limits
from gapr_ros.node.host import describe
from gapr_ros.node.model import Model
from gapr_ros.node.outcome import OF_STATUS, Found, Job, Outcome, Place, Reason, RefusedError, age_s, stamp_ns
from gapr_ros.parameters import NO_FRAME, NodeParameters

Array = NDArray[np.float64]
log = logging.getLogger(__name__)
FLOORS = 1e-4, 1e-3  # smallest standard deviation of a translation, m, and of a rotation, rad


@dataclass(frozen=True)
class JobContext:
    """What holds at the moment when a cloud is taken in hand.

    `oldest` is the first epoch of what may be collected, `why` the last one ended.
    """

    method: Any
    model: Model
    parameters: NodeParameters
    epoch: int
    oldest: int
    why: str
    initial_pose: Place | None
    now_ns: int


class Registration:
    """Turns jobs into outcomes.

    Args:
        frames: look-up of transforms.
        context: asked at the start of each job. Its method satisfies `RegistrationMethod` and takes `initial`. With
            `accumulate` it is an `Accumulator`, or a `LookAccumulator` if `viewpoint` names a place.
        report_collected: called for every cloud of `collect`: why it was not collected, empty if it was.
    """

    def __init__(
        self, frames: Frames, context: Callable[[], JobContext], report_collected: Callable[[str], None]
    ) -> None:
        self._frames, self._context, self._report_collected = frames, context, report_collected
        self._frame = ""  # of the last answer; what the method remembers holds there only

    def process(self, job: Job) -> Outcome:
        """Answer one cloud; never raises."""
        outcome, start = Outcome(job), time.monotonic()
        try:
            self._run(outcome, self._context())
        except RefusedError as refusal:
            outcome.refuse(refusal.reason, refusal.text)
        except InvalidViewpointError as error:
            outcome.refuse(Reason.BAD_FRAME, f"{error}: set the parameter viewpoint")
        except InvalidPointCloudError as error:  # sizes and values that the method itself rejects
            outcome.refuse(Reason.UNIT_MISMATCH, str(error))
        except Exception as error:
            outcome.refuse(Reason.NOT_CONVERGED, f"the registration failed: {describe(error)}")
        outcome.exec_s = time.monotonic() - start
        return outcome

    def collect(self, job: Job) -> None:
        """Keep a cloud that a newer one pushed out, to be registered with it; never raises."""
        now, outcome = self._context(), Outcome(job)
        try:
            if job.epoch < now.oldest:
                raise RefusedError(Reason.SUPERSEDED_BY_RESET, f"the cloud is older than this: {now.why}")
            points_mm = self._points_mm(outcome, now)
            self._watch_frame(outcome.header.frame_id, now)
            now.method.collect(points_mm, **self._seen_from(outcome, now))
        except Exception as error:  # whatever is wrong with it, it is counted as dropped
            self._report_collected(str(error) if isinstance(error, RefusedError) else describe(error))
        else:
            self._report_collected("")

    def _run(self, outcome: Outcome, now: JobContext) -> None:
        if outcome.job.epoch != now.epoch:
            header = cloud.read_header(outcome.job.cloud)
            if header is not None:  # what is said of it names it
                _note_header(outcome, header, now)
            raise RefusedError(Reason.SUPERSEDED_BY_RESET, f"the cloud is older than this: {now.why}")
        points_mm = self._points_mm(outcome, now)
        self._watch_frame(outcome.header.frame_id, now)
        options = self._seen_from(outcome, now)
        collects = now.parameters.collects
        outcome.points_used = len(now.method.together_with(points_mm, **options) if collects else points_mm)
        if (initial := self._initial(outcome, now)) is not None:
            outcome.has_initial_pose, options["initial"] = True, initial
        outcome.result = now.method.register(points_mm, now.model.target, **options)
        _check(outcome.result, now.parameters)
        outcome.found = _found(outcome.result, points_mm)

    def _points_mm(self, outcome: Outcome, now: JobContext) -> Array:
        """(N, 3) points of a cloud, mm, in the frame of the answer."""
        header = cloud.read_header(outcome.job.cloud)
        if header is not None:  # whatever becomes of the cloud, what is said of it names it
            _note_header(outcome, header, now)
        message = cloud.read_message(outcome.job.cloud)
        outcome.points_in = cloud.count(message)
        check_age(stamp_ns(message.header), now.now_ns, now.parameters.max_cloud_age)
        T_frame_cloud = self._lookup(outcome.header.frame_id, outcome, now)
        T_crop_cloud = self._lookup(now.parameters.crop_frame, outcome, now) if now.parameters.has_box else None
        taken = cloud.take_in(message, now.model.extent_mm, now.parameters, T_crop_cloud)
        outcome.points_on_table = taken.on_table
        outcome.seen_from = cloud.seen_from(message, now.parameters) if takes(now.method, "viewpoint") else None
        return units.moved_mm(T_frame_cloud, taken.points_mm)

    def _watch_frame(self, frame: str, now: JobContext) -> None:
        """Make the method forget what was found in another frame."""
        if self._frame and frame != self._frame:
            forget(now.method, f"the clouds come in '{frame}' and no longer in '{self._frame}'")
        self._frame = frame

    def _initial(self, outcome: Outcome, now: JobContext) -> Array | None:
        """Return the initial pose as T_target_source, mm; None without one, and while its frame is missing."""
        given = now.initial_pose
        if given is None:
            return None
        try:
            T_given_cloud = self._lookup(given.frame, outcome, now)
        except RefusedError as refusal:
            log.warning("the initialpose is not used for this cloud: %s", refusal.text)
            return None
        T_frame_cloud = self._lookup(outcome.header.frame_id, outcome, now)
        return units.core_pose(T_frame_cloud @ se3.inverse(T_given_cloud) @ given.T_frame_model)

    def _seen_from(self, outcome: Outcome, now: JobContext) -> dict[str, Array]:
        """`viewpoint` (3,) mm, in the frame of the answer, for the method; nothing where it is not one known place."""
        frame, is_probe = now.parameters.viewpoint, now.parameters.collects and not now.parameters.collects_looks
        if is_probe or (frame in NO_FRAME and outcome.seen_from is None):
            return {}
        T_frame_cloud = self._lookup(outcome.header.frame_id, outcome, now)
        if outcome.seen_from is not None:
            return {"viewpoint": units.moved_mm(T_frame_cloud, outcome.seen_from[None])[0]}
        if frame != "origin":
            T_frame_cloud = T_frame_cloud @ se3.inverse(self._lookup(frame, outcome, now))
        return {"viewpoint": T_frame_cloud[:3, 3] * units.MM_PER_M}

    def _lookup(self, frame: str, outcome: Outcome, now: JobContext) -> Array:
        """T_frame_cloud at the cloud's stamp; no frame is that of the cloud. All look-ups of a cloud share one wait."""
        if not frame:
            return np.eye(4)
        stamp, start = Time.from_msg(outcome.header.stamp), time.monotonic()
        left_s = now.parameters.tf_timeout - outcome.tf_wait_s
        if now.parameters.collects:  # of clouds that waited here, none waits again
            left_s = outcome.job.arrived_s + now.parameters.tf_timeout - start
        try:
            return self._frames.lookup(cloud.plain_frame(frame), outcome.cloud_frame, stamp, max(left_s, 0.0))
        except RefusedError as refusal:
            names = [name for name in ("output_frame", "crop_frame", "viewpoint") if _value(now, name) == frame]
            who = f"{' and '.join(names)}: " if names else ""
            raise RefusedError(refusal.reason, who + refusal.text) from refusal
        finally:
            outcome.tf_wait_s += time.monotonic() - start


def forget(method: Any, why: str) -> None:
    """Clear what a method remembers, as `Tracker` and `Accumulator` do; says so where clouds are lost."""
    if not hasattr(method, "reset"):
        return
    count = len(getattr(method, "collected", ()))
    if count:
        log.warning("%s: the %d points collected so far are forgotten", why, count)
    method.reset()


def _value(now: JobContext, name: str) -> Any:
    return getattr(now.parameters, name)


def _note_header(outcome: Outcome, header: Header, now: JobContext) -> None:
    """Frame and stamp of the answer; a cloud without a stamp gets the time at which it arrived."""
    stamp = stamp_ns(header)
    outcome.cloud_frame = cloud.plain_frame(header.frame_id)
    outcome.header.frame_id = now.parameters.output_frame or outcome.cloud_frame
    outcome.header.stamp = Time(nanoseconds=stamp or outcome.job.received_ns).to_msg()
    outcome.age_s = age_s(stamp, now.now_ns)


def _check(result: RegistrationResult, parameters: NodeParameters) -> None:
    """Refuse what the method refused, what is not sure enough, and what is no pose."""
    if not result.ok:
        raise RefusedError(OF_STATUS[result.status], result.reason)
    check_limits(result, parameters)
    for name, value in (("pose", result.T_target_source), ("covariance", result.covariance)):
        if value is None or not np.isfinite(value).all():
            raise RefusedError(Reason.NOT_CONVERGED, f"{result.method} gave no finite {name}")


def _found(result: RegistrationResult, points_mm: Array) -> Found:
    T, covariance = result.T_target_source, result.covariance
    assert T is not None and covariance is not None
    centre_mm = se3.apply(T, points_mm.mean(axis=0)[None])[0] if result.centre_mm is None else result.centre_mm
    return Found(units.ros_pose(T), units.ros_covariance(covariance, T, centre_mm, FLOORS))
