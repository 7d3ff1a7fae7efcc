"""The node: its lifecycle, parameters and clock; partial clouds in, poses of the pre-operative bone out.

The executor's thread takes clouds in, decides on outcomes and sends. What takes time has threads of its own: a worker
registers, a loader reads bones.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

from lifecycle_msgs.msg import Transition
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import ClockChange, JumpThreshold
from rclpy.duration import Duration
from rclpy.exceptions import InvalidHandle
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.lifecycle.node import LifecycleNodeMixin
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future

from gapr_ros import parameters
from gapr_ros.node import frames
from gapr_ros.node.host import RosLogHandler, guarded, steady_timer, transition
from gapr_ros.node.model import Loader, ShippedMethod, make_ready
from gapr_ros.node.outcome import Counters
from gapr_ros.node.report import PERIOD_S, Reporter
from gapr_ros.node.services import Services
from gapr_ros.node.session import Session
from gapr_ros.node.subscription import CLOUDS, Subscriptions
from gapr_ros.parameters import NodeParameters

NEXT = "ros2 lifecycle set {} configure, then activate"
LIBRARIES = ("gapr_core", "gapr_ros")  # whose logs go to the node's log


class RegisterNode(LifecycleNode):
    """Lifecycle, parameters and clock of the node; a `Session` does the rest.

    Args:
        method_factory: makes the registration method from the parameters, when the node is configured and when limits
            or the bone change; GAPR as it ships by default.
        kwargs: of rclpy's Node (context, parameter_overrides, ...).

    Raises:
        ParameterError: a parameter of the wrong type or out of range; the text says what to write.
    """

    def __init__(self, method_factory: Callable[[NodeParameters], Any] | None = None, **kwargs: Any) -> None:
        Node.__init__(self, "register_node", **kwargs)
        LifecycleNodeMixin.__init__(self, callback_group=ReentrantCallbackGroup())  # one that waits stops no other
        self.parameters = parameters.declare(self)
        self._method_factory = method_factory or ShippedMethod()
        self.counters, self.failure = Counters(), ""
        self.session: Session | None = None
        self.subscriptions_in: Subscriptions | None = None
        self._calls: deque[Callable[[], None]] = deque()
        self._bell = self.create_guard_condition(self._on_bell)
        self._watch_parameters()
        self._watch_clock()
        self._forward_logs()
        self._loader, self._loaded = Loader(self, self._method_factory), None
        self._reporter = Reporter(self, self._loader)
        self._services_offered = Services(self, self._loader, lambda: self.state, lambda: self.session)
        self._load_before_configuring()
        self._diagnosing = steady_timer(self, PERIOD_S, self.report)
        if self.parameters.autostart:
            self.call_soon(self._autostart)
        else:
            how = NEXT.format(self.get_fully_qualified_name())
            self.get_logger().info(f"unconfigured (autostart is false): configure and activate it, e.g. {how}")

    @property
    def ros(self) -> RegisterNode:
        """The node itself, as its parts advertise and subscribe with it."""
        return self

    @property
    def state(self) -> str:
        """unconfigured, inactive, active or finalized."""
        return str(self._state_machine.current_state[1])

    @property
    def _configured(self) -> Session:
        """The session of a node that is inactive or active."""
        if self.session is None:
            raise RuntimeError("the node is not configured")
        return self.session

    def now_ns(self) -> int:
        """Return the node's time, ns; 0 while simulated time has not started."""
        return int(self.get_clock().now().nanoseconds)

    def call_soon(self, call: Callable[[], None]) -> None:
        """Run in the executor's thread; from any thread."""
        self._calls.append(call)
        with suppress(InvalidHandle):  # a bone that is read while the node is destroyed has nobody to go to
            self._bell.trigger()

    def report_failure(self, text: str) -> None:
        """Keep the reason of a failed transition for log and diagnostics."""
        if self.state == "configuring":
            how = NEXT.format(self.get_fully_qualified_name())
            text = f"{text}; it stays unconfigured: correct it, then {how}, or start again"
        self.failure = text
        self.get_logger().error(text)
        self.call_soon(self.report)

    def report(self) -> None:
        """Send the diagnostics now."""
        self._reporter.send()

    def close(self, timeout_s: float = 0.0) -> bool:
        """Destroy the node. False when a registration or a loading still runs after `timeout_s`."""
        worker = None if self.session is None else self.session.worker
        self._end_session()
        ended = (worker is None or worker.stop(timeout_s)) and not self._loader.busy
        for name in LIBRARIES:
            logging.getLogger(name).removeHandler(self._log_handler)
        self.destroy_node()
        return ended

    # --- lifecycle ---

    def _load_before_configuring(self) -> None:
        """Read the bone, then change the state; only the caller waits, the executor does not."""
        service = self._service_change_state
        service.callback = partial(self._on_change_asked, service.callback)  # type: ignore[assignment]  # it is awaited

    async def _on_change_asked(self, change: Callable[..., Any], request: Any, response: Any) -> Any:
        if not self._is_to_configure(request.transition):
            return self._change(change, request, response)
        if self._loader.busy:
            return self._refuse_change(response, f"{self._loader}: one bone at a time")
        answer = Future()

        def configure(loading: Future) -> None:
            """At once: whatever comes first could set a parameter that the bone was read without."""
            self._loaded = loading.result()
            answer.set_result(self._change(change, request, response))

        self._load_to_configure().add_done_callback(configure)
        return await answer

    def _change(self, change: Callable[..., Any], request: Any, response: Any) -> Any:
        try:
            return change(request, response)
        except Exception as error:  # rclpy raises where the state does not allow the transition
            return self._refuse_change(response, str(error))
        finally:
            self._loaded = None

    def _refuse_change(self, response: Any, why: str) -> Any:
        self.get_logger().error(f"a change of state was refused: {why}")
        response.success = False
        return response

    def _load_to_configure(self) -> Future:
        """Read the bone, and the settings of the method too."""
        self._forget_settings()
        return self._loader.load()

    def _forget_settings(self) -> None:
        if isinstance(self._method_factory, ShippedMethod):
            self._method_factory.read_again()

    def _is_to_configure(self, asked: Transition) -> bool:
        named = asked.label == "configure" if asked.label else asked.id == Transition.TRANSITION_CONFIGURE
        return named and self.state == "unconfigured"

    @transition
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take the bone that was read, or read it now where nobody did, and advertise."""
        loaded, self._loaded = self._loaded, None
        self.failure, self.parameters = "", parameters.read(self)
        frames.check_names(self.parameters)
        if isinstance(loaded, BaseException):
            raise loaded
        if loaded is None:
            self._forget_settings()
        ready = loaded or make_ready(self._method_factory, self.parameters)
        model = str(ready.model)
        for sentence in parameters.remarks(self.parameters):
            self.get_logger().info(sentence)
        for sentence in parameters.doubts(self.parameters):
            self.get_logger().warning(sentence)
        self.get_logger().info(model)
        self.session = Session(self, ready, self._method_factory)
        return super().on_configure(state)

    @transition
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Listen to clouds."""
        result = super().on_activate(state)
        self._configured.send_model()
        self.subscriptions_in = Subscriptions(self, self._configured)
        unit = self.parameters.cloud_unit
        does = "waits for clouds" if self._configured.enabled else "but disabled (~/set_enabled): drops clouds"
        self.get_logger().info(f"active, {does} on {self.resolve_topic_name(CLOUDS)} (in {unit})")
        return result

    @transition
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Listen no more; clouds on their way are refused, and the last pose is withdrawn."""
        self._stop_listening()
        self._configured.withdraw()
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
        self._load_to_configure().add_done_callback(self._start)

    @guarded
    def _start(self, loading: Future) -> None:
        self._loaded = loading.result()
        if self.state == "unconfigured" and self.trigger_configure() is TransitionCallbackReturn.SUCCESS:
            self.trigger_activate()

    def _stop_listening(self) -> None:
        listening, self.subscriptions_in = self.subscriptions_in, None
        if listening is not None:
            listening.close()
            self._configured.stop_waiting("the node stopped listening")

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
        why = parameters.check_change(self, changes, configured=self.session is not None or self._loader.busy)
        return SetParametersResult(successful=not why, reason=why)

    @guarded
    def _on_changed(self, changes: list[Parameter]) -> None:
        self.parameters = parameters.read(self)
        if self.session is not None:
            self.session.parameters_changed()

    @guarded
    def _on_jump(self, jump: Any) -> None:
        if self.session is not None:
            self.session.clock_jumped(is_another=jump.clock_change != ClockChange.ROS_TIME_NO_CHANGE)

    def _on_bell(self) -> None:
        while self._calls:
            self._run_call(self._calls.popleft())

    @guarded
    def _run_call(self, call: Callable[[], None]) -> None:
        call()
