"""Everything that lives from configure to cleanup: one bone, one method, one worker, one gate.

What an interruption forgets; all but the last two refuse the clouds that are on their way:

| event | collection | limits on jumps | initial pose | last cloud (`~/register`) | latched pose |
|---|---|---|---|---|---|
| reset, another clock, bone, place on /tf_static | forgotten | off until a pose | none | outdated | withdrawn |
| `initialpose` | forgotten | stay until a good pose | the new one | stays | stays |
| pause | stays | stay | stays | outdated | stays |
| clouds are read in another way | forgotten | stay | stays | stays | stays |
| other limits | forgotten: another method | stay | stays | stays | stays |
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from std_msgs.msg import Header

from gapr_ros.node import cloud, units
from gapr_ros.node.frames import Frames, needs_frames
from gapr_ros.node.gate import Gate, is_far_ahead
from gapr_ros.node.host import THROTTLE_S, Host, guarded, steady_timer
from gapr_ros.node.model import Model, Ready
from gapr_ros.node.outcome import NO_CLOCK_S, Job, Outcome, Place, Reason, RefusedError, normal
from gapr_ros.node.publish import Publishers
from gapr_ros.node.register import JobContext, Registration, forget
from gapr_ros.node.report import Conflicts, RefusalLog, names_of
from gapr_ros.node.worker import Worker
from gapr_ros.parameters import NodeParameters
from msg_adapters import InvalidMessageError, pose_to_matrix

WATCH_S = 0.1  # between two looks at the age of the pose
OF_BONE = "model_path", "model_label", "model_unit", "model_axes"  # read with the bone
SHOWN_S = 10.0
NO_CLOCK = "use_sim_time is true and no /clock has come: no stamp is checked"
OTHER_CLOCK = "the clouds are {:.0f} days older than the clock, as of a bag without /clock: play it with --clock"
STAMPS_WENT_BACK = "the stamps of the clouds went back"
CLOCK_WENT_BACK, CLOCK_CHANGED = "the clock jumped back", "the node's clock is another one now"
OVER = "time starts over and the track is cleared"
TWO_CLOCKS = "the clock jumped back, and /clock has {} publishers ({}): each step back drops clouds; leave one"
BEHIND = (
    "/tf waits for stamps 10 s newer than those it had before, or tf2 would mix the poses of both rounds: "
    "play bags with --clock, for nodes with use_sim_time:=true, or start the listeners again and call ~/reset"
)


class Session:
    """Takes clouds in, has them registered, decides on the outcomes and sends them.

    All methods belong to the executor's thread, except those under "the worker's thread".

    Args:
        host: the node.
        ready: the method and the bone.
        method_factory: makes another method when its own settings change.

    Attributes:
        withdrawn: why the last pose was withdrawn by its age; empty while one stands, and before the first.
    """

    def __init__(self, host: Host, ready: Ready, method_factory: Callable[[NodeParameters], Any]) -> None:
        self._host, self._ready, self._method_factory = host, ready, method_factory
        self._swapping = threading.Lock()  # both threads put another `_ready`; neither may lose what the other put
        self._reading, self._limits = _reading(host.parameters), _limits(ready.parameters)
        self.enabled, self._closed, self.withdrawn = True, False, ""
        self.last_outcome: Outcome | None = None
        self._posed_at: float | None = None  # when the pose that stands was sent, `time.monotonic`
        self._log = host.ros.get_logger()
        self.conflicts = Conflicts(self._log.warning)
        self.gate = Gate()
        self._log_refusal = RefusalLog(self._log.warning)
        host.counters.forget_refusals()
        parameters = host.parameters
        self._frames = Frames(host.ros, parameters.publish_tf, needs_frames(parameters), self._is_future, self._moved)
        self._publishers = Publishers(host, self._frames)
        self._registration = Registration(self._frames, self._context, self._report_collected)
        self.worker = Worker(self._work, lambda: not host.parameters.continuous)
        self._watching = steady_timer(host.ros, WATCH_S, self._watch_pose)
        self.parameters_changed()  # a limit may have been set while the bone was read

    @property
    def model(self) -> Model:
        """The bone."""
        return self._ready.model

    def close(self) -> None:
        """End the worker, after the cloud that it has in hand, and give the topics back; waits for nothing."""
        self.stop_waiting("the node stopped")
        self._closed = True
        self.worker.stop()
        self._host.ros.destroy_timer(self._watching)
        self._publishers.close()
        self._frames.close()

    def get_logger(self) -> Any:
        """Return the node's logger (for `guarded`)."""
        return self._log

    # --- in: the executor's thread ---

    def take_cloud(self, data: bytes, alone: bool = False) -> None:
        """Put a serialised cloud into the mailbox, unless its time or frame is refused."""
        counters, now_ns = self._host.counters, self._host.now_ns()
        counters.count_received()
        if not self.enabled:
            counters.dropped += 1
            return
        self.conflicts.note("clock", "" if now_ns else NO_CLOCK)
        header = cloud.read_header(data)  # None: the worker says what is wrong with the bytes
        try:
            if header is not None and self.gate.admit(header, now_ns, self._host.parameters, alone):
                self.conflicts.note("time", f"{STAMPS_WENT_BACK}: {OVER}", SHOWN_S)
                self._frames.hold()
                self._clear(STAMPS_WENT_BACK)
        except RefusedError as refusal:
            named = Header() if header is None else normal(header)
            outcome = Outcome(Job(b"", self.gate.epoch, now_ns), named.frame_id, named)
            outcome.refuse(refusal.reason, refusal.text)
            self._answer(outcome)
            return
        collects = self._host.parameters.collects
        pushed_out = self.worker.put(
            Job(data, self.gate.epoch, now_ns), leave=self._registration.collect if collects else None
        )
        counters.dropped += pushed_out and not collects

    def take_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Start the next registrations at a pose from outside, until one is accepted."""
        try:
            T_frame_model = pose_to_matrix(message)
        except InvalidMessageError as error:
            self._warn(f"initialpose is ignored: {error}")
            return
        frame = cloud.plain_frame(message.header.frame_id)
        if frame == self._host.parameters.model_frame:
            self._warn(f"initialpose is ignored: it is in '{frame}', the bone's own frame")
            return
        self.gate.begin_again("an initialpose", Place(T_frame_model, frame))
        self._forget_clouds("an initialpose")
        where = f"in '{frame}'" if frame else "in the frame of the clouds"
        self._log.info(f"initialpose {where} is taken: the track is forgotten", throttle_duration_sec=THROTTLE_S)
        if frame:
            self._frames.listen()

    def _warn(self, text: str) -> None:
        self._host.ros.get_logger().warning(text, throttle_duration_sec=THROTTLE_S)

    def _is_future(self, stamp_ns: int) -> bool:
        """Say if a transform is from the future."""
        return is_far_ahead(stamp_ns, self._host.now_ns())

    def register_newest(self, waiter: Any) -> bool:
        """Register the newest cloud now; its outcome becomes the waiter's result.

        False when none has come, or none since the last reset or reload.
        """
        return self.worker.ask(waiter, self.gate.epoch)

    # --- the worker's thread ---

    def _work(self, job: Job) -> None:
        self._host.call_soon(partial(self._conclude, self._registration.process(job)))

    def _report_collected(self, why: str) -> None:
        """Count a cloud that a newer one pushed out of the mailbox: registered with it, or why not."""
        self._host.call_soon(partial(self._count_collected, why))

    def _context(self) -> JobContext:
        host, ready, gate = self._host, self._ready, self.gate
        since = gate.epoch, gate.oldest, gate.why, gate.initial_pose
        return JobContext(ready.method, ready.model, host.parameters, *since, host.now_ns())

    def _renew_method(self) -> None:
        """Before the next cloud, which may wait already: it is not registered by the limits of before."""
        method = self._method_factory(self._host.parameters)
        with self._swapping:
            self._ready = replace(self._ready, method=method)

    # --- out: the executor's thread again ---

    def _count_collected(self, why: str) -> None:
        self._host.counters.merged += not why
        self._host.counters.dropped += bool(why)
        if why:
            self._warn(f"a cloud is not registered with the newer ones: {why}")

    def _conclude(self, outcome: Outcome) -> None:
        """Decide on an outcome of the worker and answer."""
        points_m = units.to_metres(self.model.points_mm)
        self.gate.decide(outcome, points_m, self._host.now_ns(), self._host.parameters)
        is_of_another_clock = (outcome.age_s or 0.0) > NO_CLOCK_S
        text = OTHER_CLOCK.format((outcome.age_s or 0.0) / 86_400.0) if is_of_another_clock else ""
        self.conflicts.note("other clock", text)
        self._answer(outcome)

    def _answer(self, outcome: Outcome) -> None:
        """Count an outcome, send it, and tell who waits for it."""
        self.last_outcome = outcome
        self._host.counters.count_answer(outcome)
        if not outcome.ok:
            self._log_refusal(outcome)
        try:
            if not self._closed:
                self._publishers.send(outcome, self.model)
                if outcome.ok:
                    self._note_pose(outcome)
                self.conflicts.note("/tf", BEHIND if self._frames.behind else "")
        finally:
            outcome.answer_waiters()
            self._host.report()

    def _note_pose(self, outcome: Outcome) -> None:
        """Note an accepted pose."""
        if self._posed_at is None:
            self._log.info(f"{'poses are back' if self.withdrawn else 'first pose'}: {outcome.line}")
        self._posed_at, self.withdrawn = time.monotonic(), ""

    @guarded
    def _watch_pose(self) -> None:
        """Withdraw a pose that no newer one has followed for `pose_lifetime`."""
        lifetime_s = self._host.parameters.pose_lifetime
        if self._posed_at is None or not 0.0 < lifetime_s < time.monotonic() - self._posed_at:
            return
        last = self._host.counters.last_refusal if self._host.counters.consecutive_refusals else "no cloud was answered"
        self._withdraw_pose(f"no newer one for {lifetime_s:g} s (pose_lifetime); {last}"[:180])
        self._log.warning(f"poses stopped: {self.withdrawn}")
        self._host.report()

    # --- state ---

    def reset(self) -> None:
        """Forget track, initial pose, all clouds so far, their stamps on /tf, and the pose that late listeners get."""
        self._forget_time()
        self._clear("a reset")

    def _forget_time(self) -> None:
        """Whatever comes next is the newest, on /tf too: its listeners are started again."""
        self.gate.forget_time()
        self._frames.forget()
        for kind in ("time", "/tf"):
            self.conflicts.note(kind, "")

    def _clear(self, why: str) -> None:
        self._begin_again(why)
        self._outdate(why)

    def _outdate(self, why: str) -> None:
        """Nothing that was found or refused so far says anything of now."""
        self.worker.outdate(self.gate.epoch)
        self.last_outcome = None
        self._host.counters.forget_refusals()
        if self._posed_at is not None:
            self._withdraw_pose(why)
        self.withdrawn = ""  # whoever did this knows

    def clock_jumped(self, is_another: bool) -> None:
        """Start over: the node's clock went back, or is another one since `use_sim_time` was set."""
        why = CLOCK_CHANGED if is_another else CLOCK_WENT_BACK
        self._forget_time()
        clocks = [] if is_another else self._host.ros.get_publishers_info_by_topic("/clock")
        if len(clocks) > 1:
            self.conflicts.note("clocks", TWO_CLOCKS.format(len(clocks), names_of(clocks)), SHOWN_S)
        else:
            self._log.warning(f"{why}: {OVER}")
        self._clear(why)

    def _moved(self, frame: str) -> None:
        """Start over: a frame that clouds are moved through has another place."""
        self._clear(f"another place of '{frame}' on /tf_static")

    def look_at_file(self) -> None:
        """Say so while the bone's file is another one than the one that was read."""
        text = f"{self.model.path} has changed since it was read: call ~/reload_model" if self.model.has_changed else ""
        self.conflicts.note("bone file", text)

    def reload_failed(self, why: str) -> None:
        """Keep the old bone, and say so in the diagnostics until another one is read."""
        self.conflicts.note("reload", f"~/reload_model failed, {why}")

    def parameters_changed(self) -> None:
        """Take up what may change while running; the method's own limit means a new method for the same bone."""
        now, before = self._host.parameters, self._ready.parameters
        waits = [name for name in OF_BONE if getattr(now, name) != getattr(before, name)]
        self.conflicts.note("bone", f"the bone is not that of {', '.join(waits)}: call ~/reload_model" if waits else "")
        if _reading(now) != self._reading:
            self._forget_clouds("clouds are read in another way")
        if _limits(now) != self._limits:
            if now.collects:
                self._log.warning("the limits changed: the clouds collected so far are forgotten")
            self.worker.run(self._renew_method)
        self._reading, self._limits = _reading(now), _limits(now)
        self.worker.wake()

    def replace(self, ready: Ready) -> None:
        """Swap the bone, between two clouds; the pose of the old one is withdrawn."""
        self.conflicts.note("reload", "")
        self._log.info(str(ready.model))
        self._begin_again("another bone")
        with self._swapping:
            self._ready = ready
        self._limits = _limits(ready.parameters)
        self._outdate("another bone")
        self.look_at_file()
        self.parameters_changed()
        self.send_model()

    def send_model(self) -> None:
        """Show the bone."""
        self._publishers.send_model(self.model)

    def withdraw(self) -> None:
        """Late listeners get nothing from a node that is not active: it does not know where the bone is."""
        if self._posed_at is not None:
            self._withdraw_pose("the node was deactivated")
        self.withdrawn = ""
        self._publishers.withdraw_all()

    def _withdraw_pose(self, why: str) -> None:
        """Withdraw the last pose."""
        self._posed_at, self.withdrawn = None, why
        frame = self.last_outcome.header.frame_id if self.last_outcome else ""
        header = Header(frame_id=frame, stamp=self._host.ros.get_clock().now().to_msg())
        self._publishers.withdraw(why, header, self.model)

    def stop_waiting(self, why: str) -> None:
        """Drop the cloud in the mailbox, with the reason for those who wait, and refuse the one on its way.

        What was collected stays, with that cloud, and so do the poses against which jumps are measured.
        """
        self.gate.refuse_all(why)
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

    def _begin_again(self, why: str) -> None:
        self.gate.begin_again(why)
        self._forget_clouds(why)

    def _forget_clouds(self, why: str) -> None:
        self.worker.run(partial(forget, self._ready.method, why))


def _reading(parameters: NodeParameters) -> tuple[Any, ...]:
    """Return the values that decide how a cloud is read; clouds read with others are not collected together."""
    return parameters.cloud_unit, parameters.crop_min, parameters.crop_max


def _limits(parameters: NodeParameters) -> tuple[float, ...]:
    """Return the limits of the method itself; others need a new method for the same bone."""
    return parameters.min_confidence, parameters.max_tre
