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
        """Return the node's time, ns; 0 while simulated time has not started."""
        ...

    def call_soon(self, call: Callable[[], None]) -> None:
        """Run in the executor's thread; from any thread."""
        ...

    def report(self) -> None:
        """Send the diagnostics now; in the executor's thread."""
        ...


def steady_timer(node: Node, period_s: float, call: Callable[[], Any]) -> Timer:
    """Start a timer that goes on when simulated time stops."""
    return node.create_timer(period_s, call, clock=Clock(clock_type=ClockType.STEADY_TIME))


def guarded(callback: Callable[..., Any]) -> Callable[..., Any]:
    """Log an exception of a subscription, timer or event callback (throttled), and never raise it."""

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
    """Make a lifecycle callback fail on an exception, and leave the reason in log and diagnostics."""

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
    """Return the sentence of an error that names its cure; of another one also the place where it happened."""
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
        """Log one record at its own level."""
        write = self._logger.error if record.levelno >= logging.ERROR else self._logger.warning
        error = record.exc_info[1] if record.exc_info else None
        write(f"{record.getMessage()}: {describe(error)}" if error else record.getMessage())
