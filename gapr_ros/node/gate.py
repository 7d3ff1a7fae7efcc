"""The gate: which clouds are of now and let in, and which answers go out. The one owner of time and of the limits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from std_msgs.msg import Header

from gapr_core.geometry import se3
from gapr_core.results import RegistrationResult, confidence_text
from gapr_ros.node import units
from gapr_ros.node.cloud import plain_frame
from gapr_ros.node.outcome import LAST_NS, Outcome, Place, Reason, RefusedError, age_s, stamp_ns
from gapr_ros.parameters import NodeParameters

Array = NDArray[np.float64]
BACK_NS = 1_000_000_000  # older than the newest cloud by more than this: the stamps went back
RESTART_AFTER = 3  # so many clouds in a row whose stamps went back are no stragglers: time has started over
MAX_FUTURE_S = 0.5  # a cloud may be so far ahead of the clock; a transform a second more, as AMCL sends them
ALIKE_M = 1e-5  # two poses of one stamp that move no point of the bone by more are the same


class Gate:
    """Judges clouds when they arrive, and their answers; a refused one changes nothing.

    Of the executor's thread; the worker's reads the attributes.

    Poses go out in the order of their stamps, one for each stamp. A stamp more than a second back is a straggler's, or
    time has started over, as in a bag looped without simulated time. Three such in a row, with increasing stamps, start
    time over. So does this round's very first stamp, if all clouds come from one publisher.

    Attributes:
        epoch: the clouds of earlier ones are refused.
        oldest: first epoch of the clouds that may be registered together with new ones.
        why: the last epoch ended.
        initial_pose: a pose from outside, where registrations start until one is accepted.
    """

    def __init__(self) -> None:
        self.epoch, self.oldest, self.why = 0, 0, ""
        self.initial_pose: Place | None = None
        self._accepted: dict[str, Array] = {}  # the last pose by frame, against which jumps are measured
        self.forget_time()

    def forget_time(self) -> None:
        """Time starts over: whatever comes next is the newest."""
        self._newest_ns, self._first_ns, self._count = 0, 0, 0  # of this round
        self._answered_ns, self._answered_in, self._answer = 0, "", np.eye(4)  # the last pose that went out
        self._back_ns: list[int] = []  # stamps of the clouds in a row that went back

    def begin_again(self, why: str, initial_pose: Place | None = None) -> None:
        """Refuse the clouds on their way, and register none before with new ones.

        With an initial pose, jumps are still measured against the poses before it until a good one was found from it.
        """
        self.refuse_all(why)
        self.oldest, self.initial_pose = self.epoch, initial_pose
        if initial_pose is None:
            self._accepted = {}

    def refuse_all(self, why: str) -> None:
        """Refuse the clouds on their way."""
        self.epoch, self.why = self.epoch + 1, why

    def admit(self, header: Header, now_ns: int, parameters: NodeParameters, alone: bool = False) -> bool:
        """Let a cloud of now pass. True when time has started over with it.

        Args:
            header: of a cloud that has just arrived.
            now_ns: the clock, ns; 0 while it does not run.
            parameters: `model_frame` and `max_cloud_age`.
            alone: all clouds come from one publisher.

        Raises:
            RefusedError: bad_frame, bad_fields, future or stale.
        """
        _check_frame(plain_frame(header.frame_id), parameters.model_frame)
        stamp = stamp_ns(header)
        _check_stamp(stamp, now_ns)
        check_age(stamp, now_ns, parameters.max_cloud_age)
        stamp = stamp or now_ns
        if stamp >= max(self._newest_ns - BACK_NS, self._answered_ns):
            self._first_ns, self._count = self._first_ns if self._count else stamp, self._count + 1
            self._newest_ns, self._back_ns = max(stamp, self._newest_ns), []
            return False
        begins_again = alone and stamp == self._first_ns and self._count >= RESTART_AFTER
        first_ns = stamp if begins_again else self._note_back(stamp)
        self.forget_time()
        self._newest_ns, self._first_ns, self._count = stamp, first_ns, 1
        return True

    def decide(self, outcome: Outcome, points_m: Array, now_ns: int, parameters: NodeParameters) -> None:
        """Let an outcome pass, or turn it into a refusal. `points_m`: (N, 3) of the bone in its own frame."""
        if outcome.job.epoch != self.epoch:
            outcome.refuse(Reason.SUPERSEDED_BY_RESET, f"the cloud was on its way when this came: {self.why}")
        if outcome.found is None or outcome.result is None:
            return
        T, header = outcome.found.pose, outcome.header
        try:
            check_limits(outcome.result, parameters)  # they may have been set while the cloud was on its way
            check_age(stamp_ns(header), now_ns, parameters.max_cloud_age)
            self._check_order(T, header, points_m)
            if not outcome.has_initial_pose and header.frame_id in self._accepted:
                _check_jump(self._accepted[header.frame_id], T, points_m.mean(axis=0), parameters)
        except RefusedError as refusal:
            outcome.refuse(refusal.reason, refusal.text)
            return
        if outcome.has_initial_pose:
            self._accepted = {}
        self._accepted[header.frame_id], self.initial_pose = T, None
        self._answered_ns, self._answered_in, self._answer = stamp_ns(header), header.frame_id, T

    def _check_order(self, T_frame_model: Array, header: Header, points_m: Array) -> None:
        """Refuse a pose that would go out behind a newer one, or as the second one of its stamp."""
        stamp = stamp_ns(header)
        if stamp < self._answered_ns:  # it was let in before the newer one was answered
            raise RefusedError(Reason.STALE, self._older(stamp))
        moved = se3.apply(T_frame_model, points_m) - se3.apply(self._answer, points_m)
        is_sent = header.frame_id == self._answered_in and bool((np.linalg.norm(moved, axis=1) <= ALIKE_M).all())
        if 0 < stamp == self._answered_ns and not is_sent:
            text = "another pose was sent for this stamp, and stands; send clouds with stamps of their own, or ~/reset"
            raise RefusedError(Reason.STALE, text)

    def _older(self, stamp: int) -> str:
        return f"the stamp is {(self._answered_ns - stamp) * 1e-9:.3g} s older than the last pose"

    def _note_back(self, stamp: int) -> int:
        """Count a stamp that went far back, and refuse it until there are enough of them; the first of them."""
        if stamp >= self._newest_ns - BACK_NS:
            raise RefusedError(Reason.STALE, self._older(stamp))
        goes_on = bool(self._back_ns) and stamp > self._back_ns[-1]
        self._back_ns = [*self._back_ns, stamp] if goes_on else [stamp]
        if len(self._back_ns) < RESTART_AFTER:
            behind_s = (self._newest_ns - stamp) * 1e-9
            count = f"{len(self._back_ns)} of {RESTART_AFTER} in a row that start time over"
            raise RefusedError(Reason.STALE, f"the stamp is {behind_s:.3g} s behind the newest cloud's ({count})")
        return self._back_ns[0]


def check_limits(result: RegistrationResult, parameters: NodeParameters) -> None:
    """Refuse what is not sure or not precise enough, by the limits of this moment.

    Raises:
        RefusedError: low_confidence or imprecise.
    """
    if not result.confidence >= parameters.min_confidence:
        text = f"confidence {confidence_text(result.confidence)}, min_confidence is {parameters.min_confidence:g}"
        raise RefusedError(Reason.LOW_CONFIDENCE, f"{text}: show more of the bone")
    bound_m = units.to_metres(np.inf if result.tre95_mm is None else result.tre95_mm)
    if parameters.max_tre > 0.0 and not bound_m <= parameters.max_tre:
        text = f"the 95 % bound of the error is {bound_m:.3g} m, max_tre is {parameters.max_tre:g} m"
        raise RefusedError(Reason.IMPRECISE, f"{text}: show the far parts of the bone")


def check_age(stamp: int, now_ns: int, max_age_s: float) -> None:
    """Refuse a cloud that is too old. Off without a limit, before the clock runs and for clouds without a stamp.

    Raises:
        RefusedError: stale.
    """
    age = age_s(stamp, now_ns)
    if max_age_s > 0.0 and age is not None and age > max_age_s:
        raise RefusedError(Reason.STALE, f"the cloud is {age:.3g} s old, max_cloud_age is {max_age_s:g} s")


def is_far_ahead(stamp: int, now_ns: int) -> bool:
    """Say if a transform is a second more ahead of the clock than a cloud may be."""
    return now_ns > 0 and stamp - now_ns > MAX_FUTURE_S * 1e9 + BACK_NS


def _check_frame(frame: str, model_frame: str) -> None:
    if not frame:
        raise RefusedError(Reason.BAD_FRAME, "the cloud has no frame_id, and a pose in no frame means nothing")
    if frame == model_frame:
        text = f"the cloud is in '{frame}', which is the bone's own frame: set model_frame, or the driver's frame_id"
        raise RefusedError(Reason.BAD_FRAME, text)


def _check_stamp(stamp: int, now_ns: int) -> None:
    """Refuse what is no time, and what is ahead of the clock: tf2's listeners would drop all later poses as old."""
    if not 0 <= stamp < LAST_NS:
        raise RefusedError(Reason.BAD_FIELDS, f"the stamp is no time: {stamp} ns")
    ahead_s = (stamp - now_ns) * 1e-9
    if now_ns > 0 and stamp > 0 and ahead_s > MAX_FUTURE_S:
        raise RefusedError(Reason.FUTURE, f"the stamp is {ahead_s:.3g} s ahead of the clock: synchronise the clocks")


def _check_jump(T_before: Array, T_now: Array, centre_m: Array, parameters: NodeParameters) -> None:
    """Refuse a pose that is farther from the last one than `max_jump_*` allow."""
    step = se3.apply(T_now, centre_m[None]) - se3.apply(T_before, centre_m[None])
    moved_m = float(np.linalg.norm(step))
    turned = float(np.radians(se3.rotation_angle_deg(se3.inverse(T_before) @ T_now)))
    why = ""
    if 0.0 < parameters.max_jump_translation < moved_m:
        why = f"moved {moved_m:.3g} m, max_jump_translation is {parameters.max_jump_translation:g} m"
    elif 0.0 < parameters.max_jump_rotation < turned:
        why = f"turned {turned:.3g} rad, max_jump_rotation is {parameters.max_jump_rotation:g} rad"
    if why:
        raise RefusedError(Reason.JUMP, f"{why}; call ~/reset if the bone really moved")
