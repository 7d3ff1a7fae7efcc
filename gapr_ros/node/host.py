"""What the rooms of the node share: its six members that they may use, timers, and guards against exceptions."""

from __future__ import annotations

import functools
import logging
import traceback
from collections.abc import Callable
from typing import Any, Protocol

from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.timer import Timer

from gapr_ros.node.outcome import Counters
from gapr_ros.parameters import NodeParameters

THROTTLE_S = 5.0  # between two lines of one kind in the log


class Host(Protocol):
    """The node, as its rooms see it.

    Attributes:
        parameters: as they are now.
        counters: what became of every cloud.
    """

    parameters: NodeParameters
    counters: Counters

    @property
    def ros(self) -> LifecycleNode:
        """To advertise, subscribe and log with."""
        ...

    def now_ns(self) -> int:
        """The node's time, ns; 0 while simulated time has not started."""
        ...

    def call_soon(self, call: Callable[[], None]) -> None:
        """Run in the executor's thread; from any thread."""
        ...

    def report(self) -> None:
        """Send the diagnostics now; in the executor's thread."""
        ...


def steady_timer(node: Node, period_s: float, call: Callable[[], Any]) -> Timer:
    """A timer that does not stop with simulated time."""
    return node.create_timer(period_s, call, clock=Clock(clock_type=ClockType.STEADY_TIME))


def guarded(callback: Callable[..., Any]) -> Callable[..., Any]:
    """For subscription, timer and event callbacks: an exception is logged (throttled), never raised."""

    @functools.wraps(callback)
    def wrapper(self: Any, *args: Any) -> Any:
        try:
            return callback(self, *args)
        except Exception as error:
            text = f"{callback.__name__} failed: {describe(error)}"
            self.get_logger().error(text, throttle_duration_sec=THROTTLE_S)
            return None

    return wrapper


def transition(callback: Callable[..., TransitionCallbackReturn]) -> Callable[..., TransitionCallbackReturn]:
    """For lifecycle callbacks: an exception makes the transition fail and leaves its reason in log and diagnostics."""

    @functools.wraps(callback)
    def wrapper(self: Any, state: Any) -> TransitionCallbackReturn:
        try:
            result = callback(self, state)
            self.failure = ""
            self.call_soon(self.report)  # after the state has changed
            return result
        except Exception as error:
            self.report_failure(f"{callback.__name__.removeprefix('on_')} failed: {describe(error)}")
            return TransitionCallbackReturn.FAILURE

    return wrapper


def describe(error: BaseException) -> str:
    """The sentence of an error that names its cure; anything else with the place where it happened."""
    if isinstance(error, ValueError) and str(error).startswith("expected "):
        return str(error)
    place = traceback.extract_tb(error.__traceback__)[-1:]
    where = f" ({place[0].filename.rsplit('/', 1)[-1]}:{place[0].lineno})" if place else ""
    return f"{type(error).__name__}: {error}{where}"


class RosLogHandler(logging.Handler):
    """Sends warnings of the library to the node's log."""

    def __init__(self, logger: Any) -> None:
        super().__init__(logging.WARNING)
        self._logger = logger

    def emit(self, record: logging.LogRecord) -> None:
        """One record, at its own level."""
        write = self._logger.error if record.levelno >= logging.ERROR else self._logger.warning
        error = record.exc_info[1] if record.exc_info else None
        write(f"{record.getMessage()}: {describe(error)}" if error else record.getMessage())
