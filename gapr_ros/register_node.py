"""register_node: partial clouds in, poses of the pre-operative bone out.

The executor's thread takes clouds in, decides on outcomes and sends; one worker thread does everything that takes time.
"""

from __future__ import annotations

import logging
import sys
from collections import deque
from collections.abc import Callable
from typing import Any

import rclpy
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.signals import uninstall_signal_handlers

from gapr_ros import parameters
from gapr_ros.diagnostics import Counters
from gapr_ros.guard import RosLogHandler, describe, guarded, transition
from gapr_ros.method import default_method
from gapr_ros.parameters import NodeParameters, ParameterError
from gapr_ros.reporter import Reporter
from gapr_ros.services import Services
from gapr_ros.session import Session
from gapr_ros.subscription import Subscriptions

LIBRARIES = ("gapr_core", "gapr_ros")  # whose logs go to the node's log


class RegisterNode(LifecycleNode):
    """Lifecycle, parameters and clock of the node; a `Session` does the rest.

    Args:
        method_factory: makes the registration method from the parameters when the node is configured.
        kwargs: of rclpy's Node (context, parameter_overrides, ...).

    Raises:
        ParameterError: a parameter of the wrong type or out of range; the text says what to write.
    """

    def __init__(self, method_factory: Callable[[NodeParameters], Any] = default_method, **kwargs: Any) -> None:
        super().__init__("register_node", **kwargs)
        self.parameters = parameters.declare(self)
        self._method_factory = method_factory
        self.counters, self.failure = Counters(), ""
        self.session: Session | None = None
        self.subscriptions_in: Subscriptions | None = None
        self._calls: deque[Callable[[], None]] = deque()
        self._bell = self.create_guard_condition(self._on_bell)
        self._watch_parameters()
        self._watch_clock()
        self._forward_logs()
        self.reporter, self._offered = Reporter(self), Services(self)
        self._diagnosing = self.create_timer(
            self.parameters.diagnostics_period, self.reporter.send, clock=_steady_clock()
        )
        if self.parameters.autostart:
            self.call_soon(self._autostart)

    @property
    def state(self) -> str:
        """unconfigured, inactive, active or finalized."""
        return str(self._state_machine.current_state[1])

    def now_ns(self) -> int:
        """The node's time, ns; 0 while simulated time has not started."""
        return int(self.get_clock().now().nanoseconds)

    def call_soon(self, call: Callable[[], None]) -> None:
        """Run in the executor's thread; from any thread."""
        self._calls.append(call)
        self._bell.trigger()

    def report_failure(self, text: str) -> None:
        """A transition failed: keep its reason for log and diagnostics."""
        self.failure = text
        self.get_logger().error(text)
        self.call_soon(self.reporter.send)

    def close(self) -> None:
        """End the worker and destroy the node."""
        self._end_session()
        for name in LIBRARIES:
            logging.getLogger(name).removeHandler(self._log_handler)
        self.destroy_node()

    # --- lifecycle ---

    @transition
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read the bone, prepare the method, advertise."""
        self.failure, self.parameters = "", parameters.read(self)
        self.session = Session(self, self._method_factory)
        model = self.session.model
        self.get_logger().info(f"{model.path}: {len(model.target.points)} points, {model.extent_mm:.0f} mm across")
        return super().on_configure(state)

    @transition
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Listen to clouds."""
        result = super().on_activate(state)
        self.session.send_model()
        self.subscriptions_in = Subscriptions(self, self.session)
        return result

    @transition
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Listen no more; clouds on their way are refused."""
        self._stop_listening()
        return super().on_deactivate(state)

    @transition
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget the bone."""
        self._end_session()
        return TransitionCallbackReturn.SUCCESS

    @transition
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give everything back."""
        self._end_session()
        return TransitionCallbackReturn.SUCCESS

    @transition
    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Back to unconfigured, from where it can be configured again."""
        self._end_session()
        return TransitionCallbackReturn.SUCCESS

    @guarded
    def _autostart(self) -> None:
        if self.trigger_configure() is TransitionCallbackReturn.SUCCESS:
            self.trigger_activate()

    def _stop_listening(self) -> None:
        listening, self.subscriptions_in = self.subscriptions_in, None
        if listening is not None:
            listening.close()
            self.session.stop_waiting("the node stopped listening")

    def _end_session(self) -> None:
        self._stop_listening()
        session, self.session = self.session, None
        if session is not None:
            session.close()

    # --- what the node watches ---

    def _watch_parameters(self) -> None:
        for sentence in parameters.unknown_names(self):
            self.get_logger().warning(sentence)
        self.add_on_set_parameters_callback(self._on_change)
        self.add_post_set_parameters_callback(self._on_changed)

    def _watch_clock(self) -> None:
        threshold = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1))
        self._jump_handle = self.get_clock().create_jump_callback(threshold, post_callback=self._on_jump)

    def _forward_logs(self) -> None:
        self._log_handler = RosLogHandler(self.get_logger())
        for name in LIBRARIES:
            logging.getLogger(name).addHandler(self._log_handler)

    def _on_change(self, changes: list[Parameter]) -> SetParametersResult:
        why = parameters.check_change(changes, configured=self.session is not None)
        return SetParametersResult(successful=not why, reason=why)

    @guarded
    def _on_changed(self, changes: list[Parameter]) -> None:
        self.parameters = parameters.read(self)
        if any(change.name == "diagnostics_period" for change in changes):
            self._diagnosing.timer_period_ns = int(self.parameters.diagnostics_period * 1e9)
            self._diagnosing.reset()
        if self.session is not None:
            self.session.parameters_changed()

    @guarded
    def _on_jump(self, jump: Any) -> None:
        self.get_logger().warning("the clock jumped: the track is cleared")
        if self.session is not None:
            self.session.reset()

    def _on_bell(self) -> None:
        while self._calls:
            self._run_call(self._calls.popleft())

    @guarded
    def _run_call(self, call: Callable[[], None]) -> None:
        call()


def _steady_clock() -> Clock:
    """For diagnostics, which must not stop with simulated time."""
    return Clock(clock_type=ClockType.STEADY_TIME)


def spin(node: RegisterNode, executor: Executor) -> None:
    """Run the node until it is asked to stop; no exception of a callback ends it."""
    executor.add_node(node)
    while node.context.ok():
        try:
            executor.spin()
        except (KeyboardInterrupt, ExternalShutdownException):
            break
        except Exception as error:
            node.get_logger().error(f"a callback failed: {describe(error)}", throttle_duration_sec=5.0)


def main(args: list[str] | None = None) -> int:
    """`ros2 run gapr_ros register_node`; 1 when a parameter cannot be used."""
    try:
        rclpy.init(args=args)
        node = RegisterNode()
        executor = SingleThreadedExecutor()
    except KeyboardInterrupt:
        return 0
    except Exception as error:
        if "context is invalid" in str(error):  # asked to stop while starting
            return 0
        text = str(error) if isinstance(error, ParameterError) else describe(error)
        sys.stderr.write(f"register_node: {text}\n")
        rclpy.try_shutdown()
        return 1
    try:
        spin(node, executor)
        node.close()
    except KeyboardInterrupt:
        pass
    rclpy.try_shutdown()
    uninstall_signal_handlers()  # joins rclpy's thread for signals, which may be using the executor's guard condition
    executor.shutdown(timeout_sec=0.0)
    return 0


if __name__ == "__main__":
    sys.exit(main())
