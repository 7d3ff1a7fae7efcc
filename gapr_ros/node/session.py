"""Everything that lives from configure to cleanup: one bone, one method, one worker, one track.

What an interruption forgets; all but the last two refuse the clouds that are on their way:

| event | collection | row of good poses | limits on jumps | initial pose | last cloud (`~/register`) | latched pose |
|---|---|---|---|---|---|---|
| reset, another clock, bone, place on /tf_static | forgotten | ends | off until a pose | none | outdated | withdrawn |
| `initialpose` | forgotten | ends | stay until a good pose | the new one | stays | stays |
| pause | stays | ends | stay | stays | outdated | stays |
| clouds are read in another way | forgotten | stays | stay | stays | stays | stays |
| other limits | forgotten: another method | stays | stay | stays | stays | stays |
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from numpy.typing import NDArray

from gapr_core.results import PointCheck
from gapr_ros.node import check_points, intake, timeline
from gapr_ros.node.admission import CLOCK_CHANGED, CLOCK_WENT_BACK, STAMPS_WENT_BACK, Admission
from gapr_ros.node.changes import Changes
from gapr_ros.node.collection import forget
from gapr_ros.node.conflicts import Conflicts
from gapr_ros.node.course import Course
from gapr_ros.node.diagnostics import RefusalLog
from gapr_ros.node.frames import Frames
from gapr_ros.node.guard import THROTTLE_S
from gapr_ros.node.host import Host
from gapr_ros.node.model import Model, Ready
from gapr_ros.node.outcome import Outcome
from gapr_ros.node.publishers import Publishers
from gapr_ros.node.refusal import Reason, RefusedError
from gapr_ros.node.registration import Registration, needs_frames
from gapr_ros.node.shared_frame import SharedFrame
from gapr_ros.node.shared_name import SharedName
from gapr_ros.node.situation import InitialPose, Situation
from gapr_ros.node.worker import Job, Worker
from gapr_ros.parameters import NodeParameters
from msg_adapters import InvalidMessageError, pose_to_matrix

Array = NDArray[np.float64]
STREAM_AFTER = 5  # guesses without an answer between them
OUTLIVED_AFTER = 10  # refusals in a row: where the bone was before them is nothing for late listeners


class Session:
    """Takes clouds in, has them registered, decides on the outcomes and sends them.

    All methods belong to the executor's thread, except those under "the worker's thread".

    Args:
        host: the node.
        ready: the method and the bone.
        method_factory: makes another method when its own settings change.
    """

    def __init__(self, host: Host, ready: Ready, method_factory: Callable[[NodeParameters], Any]) -> None:
        self._host, self._ready, self._method_factory = host, ready, method_factory
        self._swapping = threading.Lock()  # both threads put another `_ready`; neither may lose what the other put
        self._changes = Changes(ready.parameters, host.parameters)
        self.enabled, self._closed = True, False
        self.last_outcome: Outcome | None = None
        self._guesses = 0  # since the last cloud that none of them superseded
        self._standing: Outcome | None = None  # of the last accepted pose, until it is withdrawn
        self.conflicts = Conflicts(host.ros.get_logger().warning)
        self.course = Course()
        self._log_refusal = RefusalLog(host.ros.get_logger().warning)
        publish, listen = host.parameters.publish_tf, needs_frames(host.parameters)
        self._shared = SharedFrame(host, self.conflicts) if publish else None
        self._named = SharedName(host, self.conflicts)
        note_sent = self._shared.note_own if self._shared else None
        host.counters.forget_refusals()
        self._frames = Frames(host.ros, publish, listen, note_sent, self._is_future, self._moved)
        self._admission = Admission(host, self.course.timeline, self._frames, self.conflicts)
        self._publishers = Publishers(host, self._frames)
        self._registration = Registration(self._frames, self._situation, self._report_collected)
        self.worker = Worker(self._work, self._held, self._period_s)
        self.parameters_changed()  # a limit may have been set while the bone was read

    @property
    def model(self) -> Model:
        """The bone."""
        return self._ready.model

    def close(self) -> None:
        """End the worker, after the cloud that it has in hand, and give the topics back; waits for nothing."""
        self.stop_waiting("the node stopped")
        self.worker.run(partial(self._registration.end, "the node stopped"))
        self._closed = True
        self.worker.stop()
        self._publishers.close()
        self._frames.close()
        self._named.close()
        if self._shared is not None:
            self._shared.close()

    # --- in: the executor's thread ---

    def take_cloud(self, data: bytes, alone: bool = False) -> None:
        """A serialised cloud, from the only publisher or not: into the mailbox, unless time or frame is refused."""
        counters, now_ns = self._host.counters, self._host.now_ns()
        counters.count_received()
        if not self.enabled:
            counters.dropped += 1
            return
        self._admission.note_clock(now_ns)
        header = intake.read_header(data)  # None: the worker says what is wrong with the bytes
        try:
            if header is not None and self._admission.admit(header, now_ns, alone):
                self._clear(STAMPS_WENT_BACK)
        except RefusedError as refusal:
            job = Job(b"", self.course.epoch, now_ns)
            self._answer(Outcome.refused(job, timeline.normal(header), refusal.reason, refusal.text))
            return
        self._put(Job(data, self.course.epoch, now_ns))

    def _put(self, job: Job) -> None:
        collects = self._host.parameters.collects
        pushed_out = self.worker.put(job, leave=self._registration.collect if collects else None)
        self._host.counters.dropped += pushed_out and not collects

    def take_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        """A pose from outside, where the next registrations start until one is accepted."""
        try:
            T_frame_model = pose_to_matrix(message)
        except InvalidMessageError as error:
            self._warn(f"initialpose is ignored: {error}")
            return
        frame = intake.plain_frame(message.header.frame_id)
        if frame == self._host.parameters.model_frame:
            self._warn(f"initialpose is ignored: it is in '{frame}', the bone's own frame")
            return
        self._guesses += 1
        often = f", {self._guesses} came since the last answer: send one guess, not a stream of them"
        why = "an initialpose" + (often if self._guesses >= STREAM_AFTER else "")
        self._begin_again(why, InitialPose(T_frame_model, frame))
        where = f"in '{frame}'" if frame else "in the frame of the clouds"
        text = f"initialpose {where} is taken: the track is forgotten"
        self._host.ros.get_logger().info(text, throttle_duration_sec=THROTTLE_S)
        if frame:
            self._frames.listen()

    def take_check_points(self, message: PoseArray) -> None:
        """Touched points, which check the last accepted pose: what they say goes out, and the pose stays."""
        found: PointCheck | str
        try:
            found = check_points.check(message, self._standing, self._ready, self._host.parameters)
        except check_points.NothingToCheckError as error:
            found = str(error)
            self._warn(f"nothing was checked: {found}")
        name, now_ns = self._host.ros.get_fully_qualified_name(), self._host.now_ns()
        self._publishers.send_check(check_points.status(message, found, self._standing, now_ns, name, self.model.file))

    def _warn(self, text: str) -> None:
        self._host.ros.get_logger().warning(text, throttle_duration_sec=THROTTLE_S)

    def _is_future(self, stamp_ns: int) -> bool:
        """Of a transform."""
        return timeline.is_far_ahead(stamp_ns, self._host.now_ns(), self._host.parameters.max_future)

    def register_newest(self, waiter: Any) -> bool:
        """Register the newest cloud now; its outcome becomes the waiter's result.

        False when none has come, or none since the last reset or reload.
        """
        return self.worker.ask(waiter, self.course.epoch)

    # --- the worker's thread ---

    def _work(self, job: Job) -> None:
        self._host.call_soon(partial(self._conclude, self._registration.process(job)))

    def _report_collected(self, collected: bool, why: str) -> None:
        """A cloud that a newer one pushed out of the mailbox is registered with it, or could not be."""
        self._host.call_soon(partial(self._count_collected, collected, why))

    def _situation(self) -> Situation:
        host, ready, course = self._host, self._ready, self.course
        since = course.epoch, course.oldest, course.why, course.initial_pose, course.place
        return Situation(ready.method, ready.model, host.parameters, *since, host.now_ns())

    def _renew_method(self) -> None:
        """Before the next cloud, which may wait already: it is not registered by the limits of before."""
        method = self._method_factory(self._host.parameters)
        with self._swapping:
            self._ready = replace(self._ready, method=method)

    def _held(self) -> bool:
        return not self._host.parameters.continuous

    def _period_s(self) -> float:
        max_rate = self._host.parameters.max_rate
        return 1.0 / max_rate if max_rate > 0.0 else 0.0

    # --- out: the executor's thread again ---

    def _count_collected(self, collected: bool, why: str) -> None:
        self._host.counters.count_pushed_out(collected)
        if not collected:
            self._warn(f"a cloud is not registered with the newer ones: {why}")

    def _conclude(self, outcome: Outcome) -> None:
        """Decide on an outcome of the worker and answer."""
        if outcome.followed is not None:
            self._show(outcome.followed, outcome)
            return
        self.course.decide(outcome, self.model, self._host.parameters)
        self._answer(outcome)

    def _show(self, T_frame_model: Array, outcome: Outcome) -> None:
        """Send a pose that was followed where what it rests on still stands. It is no answer and changes nothing."""
        stands = self.course.may_show(T_frame_model, outcome, self.model, self._host.parameters)
        shown = stands and not self._closed
        self._host.counters.count_followed(shown)
        if shown:
            self._publishers.send_followed(T_frame_model, outcome.header)
        self._host.report()

    def _answer(self, outcome: Outcome) -> None:
        """Count an outcome, send it, and tell who waits for it."""
        self.last_outcome = outcome
        self._guesses = self._guesses if outcome.reason is Reason.SUPERSEDED_BY_RESET else 0
        self._standing = outcome if outcome.ok else self._standing
        self._host.counters.count_answer(outcome)
        if not outcome.ok:
            self._log_refusal(outcome)
        try:
            if not self._closed:
                self._publishers.send(outcome, self.model)
                if self._host.counters.consecutive_refusals == OUTLIVED_AFTER:
                    self._withdraw_pose()
                self._admission.note_tf()
        finally:
            outcome.answer_waiters()
            self._host.report()

    # --- state ---

    def reset(self) -> None:
        """Forget track, initial pose, all clouds so far, their stamps on /tf, and the pose that late listeners get."""
        self._admission.forget()
        self._clear("a reset")

    def _clear(self, why: str) -> None:
        self._begin_again(why)
        self._outdate()

    def _outdate(self) -> None:
        """Nothing that was found or refused so far says anything of now."""
        self.worker.outdate(self.course.epoch)
        self.last_outcome = None
        self._host.counters.forget_refusals()
        self._withdraw_pose()

    def clock_jumped(self, is_another: bool) -> None:
        """The node's clock went back, or is another one: `use_sim_time` was set."""
        why = CLOCK_CHANGED if is_another else CLOCK_WENT_BACK
        self._admission.start_over(why)
        self._clear(why)

    def _moved(self, frame: str) -> None:
        """A frame that clouds are moved through has another place: what was found so far is of the one before."""
        self._clear(f"another place of '{frame}' on /tf_static")

    def look_at_file(self) -> None:
        """Say so while the bone's file is another one than the one that was read."""
        text = f"{self.model.path} has changed since it was read: call ~/reload_model" if self.model.has_changed else ""
        self.conflicts.note("bone file", text)

    def reload_failed(self, why: str) -> None:
        """The old bone stays, and the diagnostics say so until another one is read."""
        self.conflicts.note("reload", f"~/reload_model failed, {why}")

    def parameters_changed(self) -> None:
        """Take up what may change while running; the method's own limit means a new method for the same bone."""
        now = self._host.parameters
        waits = self._changes.of_bone(now)
        self.conflicts.note("bone", f"the bone is not that of {', '.join(waits)}: call ~/reload_model" if waits else "")
        if self._changes.in_reading(now):
            self._forget_clouds("clouds are read in another way")
        if self._changes.in_limits(now):
            self.course.forget_place()
            if self._host.parameters.collects:
                self._host.ros.get_logger().warning("the limits changed: the clouds collected so far are forgotten")
            self.worker.run(self._renew_method)
        self.worker.wake()

    def replace(self, ready: Ready) -> None:
        """Swap the bone, between two clouds; the pose of the old one is withdrawn."""
        self.conflicts.note("reload", "")
        self._host.ros.get_logger().info(str(ready.model))
        self._begin_again("another bone")
        with self._swapping:
            self._ready = ready
        self._changes = Changes(ready.parameters, self._host.parameters)
        self._outdate()
        self.look_at_file()
        self.parameters_changed()
        self.send_model()

    def send_model(self) -> None:
        """Show the bone."""
        self._publishers.send_model(self.model)

    def withdraw(self) -> None:
        """Late listeners get nothing from a node that is not active: it does not know where the bone is."""
        self._withdraw_pose()
        self._publishers.withdraw("model")

    def _withdraw_pose(self) -> None:
        """Nobody gets it any more, and nothing checks it."""
        self._standing = None
        self._publishers.withdraw("pose")

    def stop_waiting(self, why: str) -> None:
        """A pause: drop the cloud in the mailbox, tell those who wait for it why, and refuse the one on its way.

        What was collected stays, with that cloud, and so do the poses against which jumps are measured.
        """
        self.course.refuse_all(why)
        waiting = self.worker.clear()
        if waiting is not None:
            outcome = Outcome(waiting)
            outcome.refuse(Reason.SUPERSEDED_BY_RESET, why)
            outcome.answer_waiters()
        if self._host.parameters.collects:
            if waiting is not None:
                self.worker.run(partial(self._registration.collect, waiting))
            return
        self._host.counters.dropped += waiting is not None
        self._forget_clouds(why)

    def _begin_again(self, why: str, initial_pose: InitialPose | None = None) -> None:
        self.course.begin_again(why, initial_pose)
        self._forget_clouds(why)

    def _forget_clouds(self, why: str) -> None:
        self.worker.run(partial(forget, self._ready.method, why))
