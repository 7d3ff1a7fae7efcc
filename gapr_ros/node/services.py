"""The node's four services. None blocks the executor: the long ones wait as coroutines."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from gapr_ros.node.guard import describe
from gapr_ros.node.host import Host
from gapr_ros.node.loader import Loader
from gapr_ros.node.session import Session


class NotNowError(Exception):
    """The node's state does not allow what was asked for."""


def answering(service: Callable[..., Any]) -> Callable[..., Any]:
    """A method that returns (success, message) as a service callback of rclpy; an exception is a failed answer."""

    @functools.wraps(service)
    async def callback(self: Services, request: Any, response: Any) -> Any:
        try:
            response.success, response.message = await service(self, request)
        except NotNowError as error:
            response.success, response.message = False, str(error)
        except Exception as error:
            response.success, response.message = False, describe(error)
        return response

    return callback


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
        group = ReentrantCallbackGroup()  # a second call must not wait for the first
        for name in ("register", "reset", "reload_model"):
            host.ros.create_service(Trigger, f"~/{name}", getattr(self, name), callback_group=group)
        host.ros.create_service(SetBool, "~/set_enabled", self.set_enabled, callback_group=group)

    @answering
    async def register(self, _: Trigger.Request) -> tuple[bool, str]:
        """Register the newest cloud now and answer with what became of it."""
        session, waiter = self._session(), Future()
        if self._state() != "active":
            raise NotNowError(f"the node is {self._state()}: activate it")
        if not session.enabled:
            raise NotNowError("the node is disabled: call ~/set_enabled")
        if not session.register_newest(waiter):
            raise NotNowError("no cloud has come yet, or none since the last reset or reload")
        outcome = await waiter
        return outcome.ok, str(outcome)

    @answering
    async def reset(self, _: Trigger.Request) -> tuple[bool, str]:
        """Forget the track, the seed, all clouds so far and the latched pose."""
        self._session().reset()
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
            self._host.ros.get_logger().error(f"reload_model failed, {why}")
            return False, why
        session.replace(ready)
        return True, str(ready.model)

    @answering
    async def set_enabled(self, request: SetBool.Request) -> tuple[bool, str]:
        """Take clouds, or leave them."""
        session = self._session()
        session.enabled = request.data
        if not request.data:
            session.stop_waiting("the node was disabled")
        return True, "enabled" if request.data else "disabled: clouds are counted as dropped"

    def _session(self) -> Session:
        session = self._configured()
        if session is None:
            raise NotNowError(f"the node is {self._state()}: configure it")
        return session
