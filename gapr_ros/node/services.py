"""The node's four services. None blocks the executor: the long ones wait as coroutines."""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from rclpy.timer import Timer
from std_srvs.srv import SetBool, Trigger

from gapr_ros.node.host import Host, describe, steady_timer
from gapr_ros.node.model import Loader
from gapr_ros.node.session import Session

# calls that come while the executor is busy wait in the middleware, whose default drops the oldest of more than 10
CALLS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
PACE_S = 0.01  # between two answers: a client keeps 10 by default, and those to other clients are among them


class NotNowError(Exception):
    """The node's state does not allow what was asked for."""


def answering(service: Callable[..., Any]) -> Callable[..., Any]:
    """Turn a method that returns (success, message) into a service callback; an exception is a failed answer."""

    @functools.wraps(service)
    async def callback(self: Services, request: Any, response: Any) -> Any:
        try:
            response.success, response.message = await service(self, request)
        except NotNowError as error:
            response.success, response.message = False, str(error)
        except Exception as error:
            response.success, response.message = False, describe(error)
        await self._answers.in_turn()
        return response

    return callback


class Answers:
    """Lets answers go out one after the other, in the order in which they are known; rclpy's is the reverse.

    Args:
        host: the node.
    """

    def __init__(self, host: Host) -> None:
        self._host = host
        self._pause: Timer | None = None
        self._waiting: deque[Future] = deque()

    async def in_turn(self, known: Future | None = None) -> None:
        """Wait until an answer is known, now or with a future, and those before have gone."""
        turn = Future()
        if known is None:
            self._line_up(turn)
        else:
            known.add_done_callback(lambda _: self._line_up(turn))
        await turn

    def _line_up(self, turn: Future) -> None:
        self._waiting.append(turn)
        if self._pause is None and self._host.ros.context.ok():  # a node that ends answers nobody
            self._pause = steady_timer(self._host.ros, PACE_S, self._next)
            self._next()

    def _next(self) -> None:
        if self._waiting:
            self._waiting.popleft().set_result(None)
            return
        pause, self._pause = self._pause, None
        if pause is not None:
            self._host.ros.destroy_timer(pause)


class Services:
    """`~/register`, `~/reset`, `~/reload_model` and `~/set_enabled`.

    Args:
        host: the node.
        loader: reads bones.
        state: its lifecycle state, asked for with every call.
        session: what lives between configure and cleanup; None before and after.
    """

    def __init__(
        self, host: Host, loader: Loader, state: Callable[[], str], session: Callable[[], Session | None]
    ) -> None:
        self._host, self._loader, self._state, self._configured = host, loader, state, session
        self._answers = Answers(host)
        group = ReentrantCallbackGroup()  # a second call must not wait for the first
        for name in ("register", "reset", "reload_model"):
            self._offer(Trigger, name, group)
        self._offer(SetBool, "set_enabled", group)

    @answering
    async def register(self, _: Trigger.Request) -> tuple[bool, str]:
        """Register the newest cloud now and answer with what became of it."""
        session, waiter = self._session(), Future()
        if self._state() != "active":
            raise NotNowError(f"the node is {self._state()}: activate it")
        if not session.enabled:
            raise NotNowError("the node is disabled: call ~/set_enabled")
        if not session.register_newest(waiter):
            raise NotNowError("no cloud has come yet, or none since the last reset, reload or pause")
        await self._answers.in_turn(waiter)
        outcome = waiter.result()
        return outcome.ok, outcome.line

    @answering
    async def reset(self, _: Trigger.Request) -> tuple[bool, str]:
        """Forget the track, the initial pose, all clouds so far and the latched pose."""
        self._session().reset()
        self._host.ros.get_logger().info("reset: the track is forgotten")
        return True, "the track is forgotten; clouds on their way will be refused"

    @answering
    async def reload_model(self, _: Trigger.Request) -> tuple[bool, str]:
        """Read the bone again; clouds are registered to the old one until the new one is ready."""
        session = self._session()
        if self._loader.busy:
            raise NotNowError(f"{self._loader}: one bone at a time")
        ready = await self._loader.load()
        if self._configured() is not session:
            raise NotNowError("the node was cleaned up meanwhile")
        if isinstance(ready, BaseException):
            why = f"the old bone stays: {describe(ready)}"
            session.reload_failed(why)
            return False, why
        session.replace(ready)
        return True, str(ready.model)

    @answering
    async def set_enabled(self, request: SetBool.Request) -> tuple[bool, str]:
        """Take clouds, or leave them."""
        session = self._session()
        session.enabled = request.data
        self._host.ros.get_logger().info("enabled" if request.data else "disabled: clouds are dropped")
        if not request.data:
            session.stop_waiting("the node was disabled")
        return True, "enabled" if request.data else "disabled: clouds are counted as dropped"

    def _offer(self, kind: Any, name: str, group: ReentrantCallbackGroup) -> None:
        self._host.ros.create_service(kind, f"~/{name}", getattr(self, name), qos_profile=CALLS, callback_group=group)

    def _session(self) -> Session:
        session = self._configured()
        if session is None:
            state = self._state()
            raise NotNowError(f"the node is {state}: {'start it again' if state == 'finalized' else 'configure it'}")
        return session
