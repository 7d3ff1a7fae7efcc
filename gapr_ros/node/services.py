"""The node's four services. None blocks the executor: the long ones wait for the worker as coroutines."""

from __future__ import annotations

import functools
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from gapr_ros.guard import describe
from gapr_ros.model import Model
from gapr_ros.session import Session

if TYPE_CHECKING:
    from gapr_ros.register_node import RegisterNode


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
    """`~/register`, `~/reset`, `~/reload_model` and `~/set_enabled`."""

    def __init__(self, node: RegisterNode) -> None:
        self._node = node
        group = ReentrantCallbackGroup()  # a second call must not wait for the first
        for name in ("register", "reset", "reload_model"):
            node.create_service(Trigger, f"~/{name}", getattr(self, name), callback_group=group)
        node.create_service(SetBool, "~/set_enabled", self.set_enabled, callback_group=group)

    @answering
    async def register(self, _: Trigger.Request) -> tuple[bool, str]:
        """Register the newest cloud now and answer with what became of it."""
        session, waiter = self._session(), Future()
        if self._node.state != "active":
            raise NotNowError(f"the node is {self._node.state}: activate it")
        if not session.enabled:
            raise NotNowError("the node is disabled: call ~/set_enabled")
        if not session.register_newest(waiter):
            raise NotNowError("no cloud has come yet, or none since the last reset")
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
        session, waiter = self._session(), Future()
        session.worker.run(partial(self._load, session, waiter))
        model = await waiter
        if isinstance(model, Model):
            return True, f"{model.path}: {len(model.target.points)} points, {model.extent_mm:.0f} mm across"
        why = f"the old bone stays: {describe(model)}"
        self._node.get_logger().error(f"reload_model failed, {why}")
        return False, why

    @answering
    async def set_enabled(self, request: SetBool.Request) -> tuple[bool, str]:
        """Take clouds, or leave them."""
        session = self._session()
        session.enabled = request.data
        if not request.data:
            session.stop_waiting("the node was disabled")
        return True, "enabled" if request.data else "disabled: clouds are counted as dropped"

    def _session(self) -> Session:
        if self._node.session is None:
            raise NotNowError(f"the node is {self._node.state}: configure it")
        return self._node.session

    def _load(self, session: Session, waiter: Future) -> None:
        """In the worker's thread."""
        try:
            self._must_be_there(session)
            model: Model | Exception = session.read_model()
        except Exception as error:
            model = error
        self._node.call_soon(partial(self._swap, session, model, waiter))

    def _swap(self, session: Session, model: Model | Exception, waiter: Future) -> None:
        try:
            self._must_be_there(session)
            if isinstance(model, Model):
                session.replace_model(model)
        except Exception as error:
            model = error
        waiter.set_result(model)

    def _must_be_there(self, session: Session) -> None:
        if self._node.session is not session:
            raise NotNowError("the node was cleaned up meanwhile")
