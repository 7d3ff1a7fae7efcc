"""The way of one cloud through the worker's thread: read, look up, register, convert, or refuse."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from rclpy.time import Time
from std_msgs.msg import Header

from gapr_core.baselines.base import takes
from gapr_core.errors import InvalidPointCloudError, InvalidViewpointError
from gapr_core.geometry import sampling, se3
from gapr_core.results import RegistrationResult, confidence_text
from gapr_ros.node import intake, region, timeline, units
from gapr_ros.node.collection import Late, forget
from gapr_ros.node.following import Following
from gapr_ros.node.frames import Frames
from gapr_ros.node.guard import describe
from gapr_ros.node.initial_pose import InitialPoses
from gapr_ros.node.outcome import Found, Outcome
from gapr_ros.node.refusal import OF_STATUS, Reason, RefusedError
from gapr_ros.node.region import Crop
from gapr_ros.node.situation import InitialPose, Situation
from gapr_ros.node.worker import Job
from gapr_ros.parameters import NO_FRAME, NodeParameters
from msg_adapters import INPUTS

Array = NDArray[np.float64]

FARTHEST_M = 50.0  # of a cloud from a frame that its pose is asked in
SEARCHED_FOR_DOUBLES = 20_000  # of more points there are enough, and sorting them takes time


class Registration:
    """Turns jobs into outcomes.

    Args:
        frames: look-up of transforms.
        situation: asked at the start of each job; its method satisfies `RegistrationMethod`, `register` takes `initial`
            when there is such a pose, and with `accumulate` it has `collect` and `together_with` as an `Accumulator`,
            or where `viewpoint` names a place as a `LookAccumulator`.
        report_collected: is called for every cloud of `collect`, now or later: whether it was collected, and why not.
    """

    def __init__(
        self, frames: Frames, situation: Callable[[], Situation], report_collected: Callable[[bool, str], None]
    ) -> None:
        self._frames, self._situation = frames, situation
        self._late = Late(self._collect, report_collected)
        self._following, self._initial_poses = Following(), InitialPoses()
        self._newest_collected: Job | None = None  # since a cloud was registered; it alone may change the frame
        self._frame = ""  # of the last answer; what the method remembers holds there only

    def process(self, job: Job) -> Outcome:
        """The outcome of one cloud; never raises."""
        outcome, start = Outcome(job), time.monotonic()
        try:
            self._run(outcome, self._situation(), start)
        except RefusedError as refusal:
            outcome.refuse(refusal.reason, refusal.text)
        except InvalidViewpointError as error:
            outcome.refuse(Reason.BAD_FRAME, f"{error}: set the parameter viewpoint")
        except InvalidPointCloudError as error:  # sizes and values that the method itself rejects
            outcome.refuse(Reason.UNIT_MISMATCH, str(error))
        except Exception as error:
            outcome.refuse(Reason.NOT_CONVERGED, f"the registration failed: {describe(error)}")
        outcome.exec_ms = (time.monotonic() - start) * 1000.0
        return outcome

    def collect(self, job: Job) -> None:
        """Keep a cloud to be registered with a newer one, once its transform is there; never raises, never waits."""
        self._late.add(job)
        self._newest_collected = job
        self._late.take(self._situation().parameters.tf_timeout)

    def end(self, why: str) -> None:
        """No cloud waits for its transform any longer; never raises."""
        self._late.end(why)

    def _collect(self, job: Job) -> None:
        now = self._situation()
        if job.epoch < now.oldest:
            raise RefusedError(Reason.SUPERSEDED_BY_RESET, f"the cloud is older than this: {now.why}")
        outcome = Outcome(job)
        # one from before a refusal may be collected, back to `oldest`; `_points_mm` would leave it out
        now = replace(now, epoch=job.epoch, parameters=replace(now.parameters, tf_timeout=0.0))
        points_mm = self._points_mm(outcome, now)
        frame = outcome.header.frame_id
        if job is self._newest_collected:  # for the first time, just now
            self._watch_frame(frame, now)
        elif frame != self._frame:
            raise RefusedError(Reason.BAD_FRAME, f"it is in '{frame}', those that are collected are in '{self._frame}'")
        now.method.collect(points_mm, **self._seen_from(outcome, now))

    def _run(self, outcome: Outcome, now: Situation, start: float) -> None:
        points_mm = self._points_mm(outcome, now)
        self._watch_frame(outcome.header.frame_id, now)
        outcome.points_used, self._newest_collected = len(points_mm), None
        if now.parameters.collects:
            self._late.take(now.parameters.tf_timeout)  # the transform of this cloud has come: so have those of before
            self._check_together(points_mm, outcome, now)
        is_to_be_assessed = outcome.job.urgent or outcome.seen_from is not None
        outcome.followed = self._following.follow(points_mm, outcome.header.frame_id, is_to_be_assessed, now)
        if outcome.followed is not None:
            _check_time(time.monotonic() - start - outcome.tf_wait_s, now.parameters)
            return
        result = self._register(points_mm, outcome, now)
        _check(result, time.monotonic() - start - outcome.tf_wait_s, now.parameters)
        _note_pose(outcome, result, points_mm, now.parameters)

    def _points_mm(self, outcome: Outcome, now: Situation) -> Array:
        """(N, 3) points of a cloud, mm, in the frame of the answer."""
        header = intake.read_header(outcome.job.cloud)
        if header is not None:  # whatever becomes of the cloud, what is said of it names it
            _note_header(outcome, header, now)
        if outcome.job.epoch != now.epoch:
            raise RefusedError(Reason.SUPERSEDED_BY_RESET, f"the cloud is older than this: {now.why}")
        cloud = intake.read_message(outcome.job.cloud, now.parameters.cloud_type)
        outcome.points_in = INPUTS[now.parameters.cloud_type].count(cloud)
        timeline.check_age(timeline.stamp_ns(cloud.header), now.now_ns, now.parameters.max_cloud_age)
        T_frame_cloud = self._lookup(outcome.header.frame_id, outcome, now)
        crops = self._crops(T_frame_cloud, outcome, now)
        points_mm = intake.take_in(cloud, now.model.extent_mm, now.parameters, crops)
        outcome.seen_from = intake.seen_from(cloud, now.parameters) if takes(now.method, "viewpoint") else None
        return units.moved_mm(T_frame_cloud, points_mm)

    def _crops(self, T_frame_cloud: Array, outcome: Outcome, now: Situation) -> list[Crop]:
        """What the region of interest takes away, in the cloud's own frame."""
        crops, place = [], now.place
        if region.has_box(now.parameters):
            crops.append(region.box(now.parameters, self._lookup(now.parameters.crop_frame, outcome, now)))
        if now.parameters.crop_to_track > 0.0 and place is not None and place.frame == outcome.header.frame_id:
            T_cloud_model = se3.inverse(T_frame_cloud) @ place.T_frame_model
            crops.append(region.around(now.model, T_cloud_model, now.parameters.crop_to_track))
        return crops

    def _watch_frame(self, frame: str, now: Situation) -> None:
        """What the method remembers is of one frame."""
        if self._frame and frame != self._frame:
            forget(now.method, f"the clouds come in '{frame}' and no longer in '{self._frame}'")
        self._frame = frame

    def _register(self, points_mm: Array, outcome: Outcome, now: Situation) -> RegistrationResult:
        initial = self._initial_poses.start(now.initial_pose, partial(self._initial, outcome=outcome, now=now))
        outcome.has_initial_pose = initial is not None
        options = {"initial": initial} if outcome.has_initial_pose else {}
        options |= self._seen_from(outcome, now)
        result = now.method.register(points_mm, now.model.target, **options)
        outcome.confidence, outcome.inlier_ratio = float(result.confidence), float(result.inlier_ratio)
        outcome.result, outcome.found_by = result, result.proposer
        outcome.tre_mm, outcome.tre95_mm = result.tre_mm, result.tre95_mm
        return result

    def _initial(self, given: InitialPose, outcome: Outcome, now: Situation) -> Array:
        """The pose as T_target_source, mm, the source being in the frame of the answer."""
        T_given_cloud = self._lookup(given.frame, outcome, now)
        T_frame_cloud = self._lookup(outcome.header.frame_id, outcome, now)
        return units.core_pose(T_frame_cloud @ se3.inverse(T_given_cloud) @ given.T_frame_model)

    def _seen_from(self, outcome: Outcome, now: Situation) -> dict[str, Array]:
        """`viewpoint` for the method, where there is one."""
        viewpoint_mm = self._viewpoint_mm(outcome, now)
        return {} if viewpoint_mm is None else {"viewpoint": viewpoint_mm}

    def _check_together(self, points_mm: Array, outcome: Outcome, now: Situation) -> None:
        """Number and unit of this cloud and those before it; where they are too few it is kept for the next one."""
        seen_from = self._seen_from(outcome, now)
        together = now.method.together_with(points_mm, **seen_from)
        if len(together) < SEARCHED_FOR_DOUBLES:
            together = sampling.distinct(together)  # a cloud that comes again makes no more of them
        if not len(together) or not intake.is_one_bone(together, now.model.extent_mm):
            together = points_mm  # the method leaves this cloud out, or starts again with it
        outcome.points_used = len(together)
        try:
            intake.check_together(together, now.model.extent_mm, now.parameters)
        except RefusedError as refusal:
            if refusal.reason is Reason.TOO_FEW_POINTS:
                now.method.collect(points_mm, **seen_from)
            raise

    def _viewpoint_mm(self, outcome: Outcome, now: Situation) -> Array | None:
        """(3,) where the camera was, in the frame of the answer; None where it is not known, or not one place."""
        frame, is_probe = now.parameters.viewpoint, now.parameters.collects and not now.parameters.collects_looks
        if is_probe or (frame in NO_FRAME and outcome.seen_from is None):
            return None
        T_frame_cloud = self._lookup(outcome.header.frame_id, outcome, now)
        if outcome.seen_from is not None:
            return units.moved_mm(T_frame_cloud, outcome.seen_from[None])[0]
        if frame != "origin":
            T_frame_cloud = T_frame_cloud @ se3.inverse(self._lookup(frame, outcome, now))
        return T_frame_cloud[:3, 3] * units.MM_PER_M

    def _lookup(self, frame: str, outcome: Outcome, now: Situation) -> Array:
        """T_frame_cloud at the cloud's stamp; no frame is that of the cloud. All look-ups of a cloud share one wait."""
        if not frame:
            return np.eye(4)
        stamp, start = Time.from_msg(outcome.header.stamp), time.monotonic()
        left_s = max(now.parameters.tf_timeout - outcome.tf_wait_s, 0.0)
        try:
            gap_s, arrived_s = now.parameters.max_tf_gap, outcome.job.arrived_s
            name = intake.plain_frame(frame)
            found = self._frames.lookup(name, outcome.cloud_frame, stamp, left_s, gap_s, arrived_s)
            _check_distance(found, name, outcome.cloud_frame)
            return found
        except RefusedError as refusal:
            raise RefusedError(refusal.reason, _who_asks(frame, now.parameters) + refusal.text) from refusal
        finally:
            outcome.tf_wait_s += time.monotonic() - start


def _check_distance(T_frame_cloud: Array, frame: str, cloud_frame: str) -> None:
    """Refuse a transform that leads out of any operating room: a driver that sends millimetres, say."""
    away_m = float(np.linalg.norm(T_frame_cloud[:3, 3]))
    if away_m > FARTHEST_M:
        text = f"'{cloud_frame}' is {away_m:.0f} m from '{frame}': are the transforms between them in millimetres?"
        raise RefusedError(Reason.BAD_FRAME, text)


def _who_asks(frame: str, parameters: NodeParameters) -> str:
    """The parameters that name a frame, for a refusal; empty for the frame of an initialpose."""
    names = [name for name in ("output_frame", "crop_frame", "viewpoint") if getattr(parameters, name) == frame]
    return f"{' and '.join(names)}: " if names else ""


def needs_frames(parameters: NodeParameters) -> bool:
    """Whether clouds cannot be read without tf2."""
    has_frame = parameters.viewpoint not in (*NO_FRAME, "origin")
    return bool(parameters.output_frame or parameters.crop_frame or has_frame)


def _note_header(outcome: Outcome, header: Header, now: Situation) -> None:
    """Frame and stamp of the answer; a cloud without a stamp gets the time at which it arrived."""
    stamp_ns = timeline.stamp_ns(header)
    outcome.cloud_frame = intake.plain_frame(header.frame_id)
    outcome.header.frame_id = now.parameters.output_frame or outcome.cloud_frame
    outcome.header.stamp = Time(nanoseconds=stamp_ns or outcome.job.received_ns).to_msg()
    outcome.age_s = timeline.age_s(stamp_ns, now.now_ns)


def _check(result: RegistrationResult, seconds: float, parameters: NodeParameters) -> None:
    """Refuse what the method refused, whatever time that took, what took too long and what is not sure enough."""
    if not result.ok:
        raise RefusedError(OF_STATUS[result.status], result.reason)
    _check_time(seconds, parameters)
    check_limits(result, parameters)
    for name, value in (("pose", result.T_target_source), ("covariance", result.covariance)):
        if value is None or not np.isfinite(value).all():
            raise RefusedError(Reason.NOT_CONVERGED, f"{result.method} gave no finite {name}")


def _check_time(seconds: float, parameters: NodeParameters) -> None:
    if seconds > parameters.timeout:
        raise RefusedError(Reason.TIMEOUT, f"took {seconds:.3g} s, timeout is {parameters.timeout:g} s")


def check_limits(result: RegistrationResult, parameters: NodeParameters) -> None:
    """Refuse what is not sure or not precise enough, by the limits of this moment.

    Raises:
        RefusedError: low_confidence or imprecise.
    """
    if not result.confidence >= parameters.min_confidence:
        text = f"confidence {confidence_text(result.confidence)}, min_confidence is {parameters.min_confidence:g}"
        raise RefusedError(Reason.LOW_CONFIDENCE, text)
    _check_precision(result, parameters.max_tre)


def _check_precision(result: RegistrationResult, most_m: float) -> None:
    """Refuse a pose whose error over the bone is not bounded by `max_tre`; a method that gives no bound has none."""
    if most_m <= 0.0:
        return
    bound_m = units.to_metres(np.inf if result.tre95_mm is None else result.tre95_mm)
    if not bound_m <= most_m:
        text = f"the 95 % bound of the error over the bone is {bound_m:.3g} m, max_tre is {most_m:g} m"
        raise RefusedError(Reason.IMPRECISE, text)


def _note_pose(outcome: Outcome, result: RegistrationResult, points_mm: Array, parameters: NodeParameters) -> None:
    T, covariance = result.T_target_source, result.covariance
    assert T is not None and covariance is not None
    centre_mm = se3.apply(T, points_mm.mean(axis=0)[None])[0] if result.centre_mm is None else result.centre_mm
    floors = (parameters.covariance_floor_translation, parameters.covariance_floor_rotation)
    outcome.found = Found(units.ros_pose(T), units.ros_covariance(covariance, T, centre_mm, floors))
