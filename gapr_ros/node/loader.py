"""Reads bones in threads of their own, so that neither the executor nor a registration waits for a file."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.task import Future

from gapr_ros.node.host import Host
from gapr_ros.node.model import Ready, make_ready
from gapr_ros.parameters import NodeParameters


class Loader:
    """One bone at a time; all methods belong to the executor's thread.

    The threads are daemons: one that hangs in a file does not keep the process alive.

    Args:
        host: gets the result in the executor's thread.
        method_factory: makes the registration method from the parameters.
    """

    def __init__(self, host: Host, method_factory: Callable[[NodeParameters], Any]) -> None:
        self._host, self._method_factory = host, method_factory
        self._path, self._since = "", 0.0
        self._thread: threading.Thread | None = None

    @property
    def busy(self) -> bool:
        """A bone is being read."""
        return self._thread is not None

    def __str__(self) -> str:
        return f"loading {self._path} for {time.monotonic() - self._since:.0f} s" if self.busy else ""

    def load(self) -> Future:
        """Read and prepare the bone that the parameters name now; the future gets a `Ready`, or the exception.

        It is busy until those have been called who wait for the future (`add_done_callback`).
        """
        done, parameters = Future(), self._host.parameters
        self._path, self._since = parameters.model_path or "no model_path", time.monotonic()
        self._thread = threading.Thread(target=self._run, args=(parameters, done), name="loading", daemon=True)
        self._thread.start()
        if parameters.model_path:
            self._host.ros.get_logger().info(f"loading {self._path}")
        self._host.report()  # that it loads: with a short file nobody would see it otherwise
        return done

    def _run(self, parameters: NodeParameters, done: Future) -> None:
        """In the loading thread."""
        try:
            outcome: Ready | BaseException = make_ready(self._method_factory, parameters)
        except BaseException as error:  # who waits gets a MemoryError too
            outcome = error
        self._host.call_soon(partial(self._finish, done, outcome))

    def _finish(self, done: Future, outcome: Ready | BaseException) -> None:
        try:
            done.set_result(outcome)
        finally:
            self._thread = None
