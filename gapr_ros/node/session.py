"""Everything that lives from configure to cleanup: one bone, one method, one worker, one track."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from geometry_msgs.msg import PoseWithCovarianceStamped

from gapr_ros import intake, track
from gapr_ros.diagnostics import RefusalLog
from gapr_ros.frames import Frames
from gapr_ros.model import Model, load_model, warm_up
from gapr_ros.outcome import Outcome
from gapr_ros.parameters import NodeParameters
from gapr_ros.publishers import Publishers
from gapr_ros.refusal import Reason, RefusedError
from gapr_ros.registration import Registration, Seed, Situation
from gapr_ros.track import Track
from gapr_ros.worker import Job, Worker
from msg_adapters import InvalidMessageError, pose_to_matrix

if TYPE_CHECKING:
    from gapr_ros.register_node import RegisterNode

STOP_TIMEOUT_S = 10.0


class Session:
    """Takes clouds in, has them registered, decides on the outcomes and sends them.

    All methods belong to the executor's thread, except those under "the worker's thread".

    Raises:
        GaprError: a bone that cannot be read or prepared.
    """

    def __init__(self, node: RegisterNode, method_factory: Callable[[NodeParameters], Any]) -> None:
        self._node, self._method_factory = node, method_factory
        self._method = method_factory(node.parameters)
        self._min_confidence, self._reading = node.parameters.min_confidence, _reading(node.parameters)
        self.enabled = True
        self.last_outcome: Outcome | None = None
        self._track, self._epoch, self._seed, self._last_stamp_ns = Track(), 0, None, 0
        self._log_refusal = RefusalLog(node.get_logger().warning)
        self.model = self.read_model()
        warm_up(self._method, self.model)
        self._forget_clouds()
        self._frames = Frames(node, node.parameters.publish_tf, listen=bool(node.parameters.output_frame))
        self._publishers = Publishers(node, self._frames, node.parameters.model_frame)
        self._registration = Registration(self._frames, self._situation)
        self.worker = Worker(self._work, self._held, self._period_s)

    def close(self) -> None:
        """End the worker and give the topics back."""
        self.stop_waiting("the node stopped")
        if not self.worker.stop(STOP_TIMEOUT_S):
            self._node.get_logger().error(f"the registration has not ended after {STOP_TIMEOUT_S:g} s: left alone")
        self._publishers.close()
        self._frames.close()

    # --- in: the executor's thread ---

    def take_cloud(self, data: bytes) -> None:
        """A serialised cloud arrived: into the mailbox, nothing more."""
        counters = self._node.counters
        counters.receive()
        if not self.enabled:
            counters.dropped += 1
            return
        accumulates = self._node.parameters.accumulate > 1
        pushed_out = self.worker.put(
            Job(data, self._epoch, self._node.now_ns()), leave=self._collect if accumulates else None
        )
        counters.dropped += pushed_out and not accumulates

    def take_seed(self, message: PoseWithCovarianceStamped) -> None:
        """A pose from outside, where the next registrations start until one is accepted."""
        try:
            T_frame_model = pose_to_matrix(message)
        except InvalidMessageError as error:
            self._node.get_logger().warning(f"initialpose is ignored: {error}")
            return
        self._begin_anew()
        self._seed = Seed(T_frame_model, message.header.frame_id)
        if message.header.frame_id:
            self._frames.listen()

    def register_newest(self, waiter: Any) -> bool:
        """Register the newest cloud now; its outcome becomes the waiter's result.

        False when none has come, or none since the last reset.
        """
        return self.worker.ask(waiter, self._epoch)

    # --- the worker's thread ---

    def read_model(self) -> Model:
        """The bone that the parameters name now, prepared."""
        return load_model(self._method, self._node.parameters)

    def _work(self, job: Job) -> None:
        self._node.call_soon(partial(self._settle, self._registration.process(job)))

    def _collect(self, job: Job) -> None:
        """A cloud that a newer one pushed out of the mailbox is registered with it."""
        self._node.call_soon(partial(self._node.counters.leave, self._registration.collect(job)))

    def _situation(self) -> Situation:
        node = self._node
        return Situation(self._method, self.model, node.parameters, self._epoch, self._seed, node.now_ns())

    def _renew_method(self) -> None:
        self._method = self._method_factory(self._node.parameters)

    def _forget_clouds(self) -> None:
        """Poses and clouds that the method remembers, as `Tracker` and `Accumulator` do."""
        if hasattr(self._method, "reset"):
            self._method.reset()

    def _held(self) -> bool:
        return not self._node.parameters.continuous

    def _period_s(self) -> float:
        max_rate = self._node.parameters.max_rate
        return 1.0 / max_rate if max_rate > 0.0 else 0.0

    # --- out: the executor's thread again ---

    def _settle(self, outcome: Outcome) -> None:
        """Decide on an outcome, count it, send it, and tell who waits for it."""
        self._decide(outcome)
        self.last_outcome = outcome
        self._node.counters.settle(outcome)
        if not outcome.ok:
            self._log_refusal(outcome)
        try:
            self._publishers.send(outcome, self.model)
        finally:
            outcome.tell()
            self._node.reporter.send()

    def _decide(self, outcome: Outcome) -> None:
        if outcome.job.epoch != self._epoch:
            outcome.refuse(Reason.SUPERSEDED_BY_RESET, "a reset came while the cloud was on its way")
            return
        self._watch_stamps(outcome)
        if not outcome.ok:
            self._track.miss()
            return
        try:
            centre_m = track.centre_of(self.model.points_mm)
            self._track.judge(outcome.pose, outcome.header.frame_id, centre_m, self._node.parameters)
            self._seed = None
        except RefusedError as refusal:
            outcome.refuse(refusal.reason, refusal.text)

    def _watch_stamps(self, outcome: Outcome) -> None:
        """A bag that starts over without simulated time shows in its stamps only, as `Registration` sees too."""
        stamp_ns = intake.stamp_ns(outcome.header)
        if 0 < stamp_ns < self._last_stamp_ns - intake.BACKWARD_NS:
            self._node.get_logger().warning("stamps went back: the track is cleared")
            self._forget()
        self._last_stamp_ns = stamp_ns or self._last_stamp_ns

    # --- state ---

    def reset(self) -> None:
        """Forget track, seed, all clouds so far and the pose that late listeners get."""
        self._begin_anew()
        self.worker.outdate(self._epoch)
        self._publishers.withdraw_pose()

    def parameters_changed(self) -> None:
        """Take up what may change while running; the method's own limit means a new method for the same bone."""
        if self._reading != (reading := _reading(self._node.parameters)):
            self._reading = reading
            self.worker.run(self._forget_clouds)
        if self._min_confidence != self._node.parameters.min_confidence:
            self._min_confidence = self._node.parameters.min_confidence
            if self._node.parameters.accumulate > 1:
                self._node.get_logger().warning("min_confidence changed: the clouds collected so far are forgotten")
            self.worker.run(self._renew_method)
        self.worker.wake()

    def replace_model(self, model: Model) -> None:
        """Swap the bone, between two clouds; the pose of the old one is withdrawn."""
        self.model = model
        self._begin_anew()
        self._publishers.withdraw_pose()
        self.send_model()

    def send_model(self) -> None:
        """Show the bone."""
        self._publishers.send_model(self.model)

    def stop_waiting(self, why: str) -> None:
        """Drop the cloud in the mailbox, tell those who wait for it why, and refuse the one on its way."""
        self._begin_anew()
        waiting = self.worker.clear()
        if waiting is not None:
            self._node.counters.dropped += 1
            outcome = Outcome(waiting)
            outcome.refuse(Reason.SUPERSEDED_BY_RESET, why)
            outcome.tell()

    def _begin_anew(self) -> None:
        """Forget track, seed and collected clouds; clouds on their way will be refused."""
        self._epoch += 1
        self.worker.run(self._forget_clouds)
        self._forget()

    def _forget(self) -> None:
        self._track.clear()
        self._seed, self._last_stamp_ns = None, 0
        self._frames.forget()


def _reading(parameters: NodeParameters) -> tuple[Any, ...]:
    """How clouds are read: what was collected under other settings cannot be registered with what comes."""
    return parameters.cloud_unit, parameters.range_min, parameters.range_max
