"""Which answers go out: those of clouds that still count, in the order of their stamps, on from the poses before."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapr_core.results import RegistrationResult
from gapr_ros.node import timeline, units
from gapr_ros.node.following import continues
from gapr_ros.node.model import Model
from gapr_ros.node.outcome import Outcome
from gapr_ros.node.refusal import Reason, RefusedError
from gapr_ros.node.region import Place
from gapr_ros.node.registration import check_limits
from gapr_ros.node.situation import InitialPose
from gapr_ros.node.timeline import Timeline
from gapr_ros.node.track import Track
from gapr_ros.parameters import NodeParameters

Array = NDArray[np.float64]


class Course:
    """Time, the track and what began them. Of the executor's thread; the worker's reads the attributes and `place`.

    Attributes:
        timeline: admits clouds.
        epoch: the clouds of earlier ones are refused.
        oldest: first epoch of the clouds that may be registered together with new ones.
        initial_pose: a pose from outside, where registrations start until one is accepted.
        why: the last epoch ended.
    """

    def __init__(self) -> None:
        self.timeline = Timeline()
        self.epoch, self.oldest = 0, 0
        self.initial_pose: InitialPose | None = None
        self.why = ""
        self._track = Track()

    @property
    def place(self) -> Place | None:
        """Where the bone was with the last cloud; None where that says nothing of the next one."""
        return self._track.place

    def begin_again(self, why: str, initial_pose: InitialPose | None = None) -> None:
        """Forget the track; clouds on their way will be refused, and none before is registered with new ones.

        With an initial pose, whose frame may never come, jumps are still measured against the poses before it until a
        good pose was found from there.
        """
        self.refuse_all(why)
        self.oldest, self.initial_pose = self.epoch, initial_pose
        if initial_pose is None:
            self._track.clear()

    def refuse_all(self, why: str) -> None:
        """Clouds on their way will be refused, and say nothing about those to come."""
        self.epoch, self.why = self.epoch + 1, why
        self._track.miss()

    def forget_place(self) -> None:
        """No cloud is followed, or looked for near the bone, before the next good answer."""
        self._track.place = None

    def decide(self, outcome: Outcome, model: Model, parameters: NodeParameters) -> None:
        """Let an outcome pass, or turn it into a refusal."""
        if outcome.job.epoch != self.epoch:
            outcome.refuse(Reason.SUPERSEDED_BY_RESET, f"the cloud was on its way when this came: {self.why}")
            return
        if outcome.reason is Reason.STALE:  # it grew old in the mailbox, and changes nothing
            return
        if outcome.found is None or outcome.result is None:
            self._track.miss()
            return
        try:
            self._check_limits(outcome.result, parameters)
            self._judge(outcome.found.pose, outcome, model, parameters)
        except RefusedError as refusal:
            outcome.refuse(refusal.reason, refusal.text)

    def may_show(self, T_frame_model: Array, outcome: Outcome, model: Model, parameters: NodeParameters) -> bool:
        """Whether a followed pose is of now, what it rests on still stands, and nothing newer went out."""
        if outcome.job.epoch != self.epoch:
            return False
        header = outcome.header
        stands = continues(self.place, T_frame_model, header.frame_id, model, parameters)
        return stands and self.timeline.admit_shown(T_frame_model, header, units.to_metres(model.points_mm))

    def _check_limits(self, result: RegistrationResult, parameters: NodeParameters) -> None:
        """Limits may have been set while the cloud was on its way."""
        try:
            check_limits(result, parameters)
        except RefusedError:
            self._track.miss()
            raise

    def _judge(self, T_frame_model: Array, outcome: Outcome, model: Model, parameters: NodeParameters) -> None:
        header, points_m = outcome.header, units.to_metres(model.points_mm)
        self.timeline.check_answer(T_frame_model, header, points_m)
        cloud = timeline.stamp_ns(header) or hash(outcome.job.cloud)  # while no clock runs
        if outcome.has_initial_pose:
            self._track.forget_accepted()
        self._track.judge(T_frame_model, header.frame_id, points_m.mean(axis=0), cloud, parameters)
        self.timeline.note_answer(T_frame_model, header)
        self.initial_pose = None
