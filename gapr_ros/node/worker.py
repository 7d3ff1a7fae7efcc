"""One thread and a one-slot mailbox: the newest cloud wins; what becomes of the others is the caller's to say."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

log = logging.getLogger(__name__)


@dataclass(eq=False)
class Job:
    """One cloud on its way through the worker.

    Attributes:
        cloud: serialised message, as it came from the middleware.
        epoch: the reset count when it arrived; a later reset makes its result worthless.
        received_ns: the node's clock when it arrived, ns.
        waiters: futures of service calls that want its outcome.
        urgent: asked for by a service: neither `continuous` nor `max_rate` holds it back.
        arrived_s: by the wall clock (`time.monotonic`).
    """

    cloud: bytes
    epoch: int
    received_ns: int
    waiters: list[Any] = field(default_factory=list)
    urgent: bool = False
    arrived_s: float = field(default_factory=time.monotonic)


class Worker:
    """Runs `process(job)` for the newest cloud and `run(task)` for others, one after the other, off the executor.

    Args:
        process: what to do with a job, in the worker's thread; must not raise.
        held: asked before a job that is not urgent; true leaves it in the mailbox (`continuous: false`).
        period_s: asked for the least time between the starts of two jobs that are not urgent.
    """

    def __init__(self, process: Callable[[Job], None], held: Callable[[], bool], period_s: Callable[[], float]) -> None:
        self._process, self._held, self._period_s = process, held, period_s
        self._wake = threading.Condition()
        self._slot: Job | None = None
        self._tasks: deque[Callable[[], None]] = deque()
        self._last: Job | None = None
        self._oldest = 0
        self._last_start = float("-inf")
        self._since: float | None = None  # the job that is processed was taken, `time.monotonic`
        self._stopping = False
        self._thread = threading.Thread(target=self._loop, name="registration", daemon=True)
        self._thread.start()

    def put(self, job: Job, leave: Callable[[Job], None] | None = None) -> bool:
        """Make this the next cloud. True when it pushes one out, whose waiters wait for this one instead.

        Args:
            job: the cloud.
            leave: task for a cloud that is pushed out, run before the next one is processed.
        """
        with self._wake:
            old, self._slot = self._slot, job
            if old is not None:
                job.waiters += old.waiters
                job.urgent |= old.urgent
                if leave is not None:
                    self._tasks.append(partial(leave, old))
            self._wake.notify()
        return old is not None

    def ask(self, waiter: Any, epoch: int) -> bool:
        """Process the newest cloud now, as of this epoch, and tell the waiter. False when there is none.

        A cloud that was processed before is processed once more; one that is outdated is not.
        """
        with self._wake:
            newest = self._slot or self._last
            if newest is None or newest.epoch < self._oldest:
                return False
            if self._slot is None:
                self._slot = Job(newest.cloud, epoch, newest.received_ns, arrived_s=newest.arrived_s)
            self._slot.epoch, self._slot.urgent = epoch, True
            self._slot.waiters.append(waiter)
            self._wake.notify()
        return True

    def outdate(self, epoch: int) -> None:
        """Clouds from before this epoch cannot be asked for any more."""
        with self._wake:
            self._oldest = epoch

    def run(self, task: Callable[[], None]) -> None:
        """Run a task that must not raise, before the next cloud."""
        with self._wake:
            self._tasks.append(task)
            self._wake.notify()

    def wake(self) -> None:
        """Look again: `held` or `period_s` may have changed."""
        with self._wake:
            self._wake.notify()

    def clear(self) -> Job | None:
        """Forget every cloud. Returns the one that was waiting, with those who wait for it."""
        with self._wake:
            waiting, self._slot, self._last = self._slot, None, None
        return waiting

    @property
    def busy_s(self) -> float:
        """How long the cloud in hand has been processed; 0 while there is none."""
        since = self._since
        return 0.0 if since is None else time.monotonic() - since

    def stop(self, timeout_s: float = 0.0) -> bool:
        """End the thread after what it is doing and the tasks. False when that takes longer than `timeout_s`."""
        with self._wake:
            self._stopping = True
            self._wake.notify()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _loop(self) -> None:
        while (work := self._next()) is not None:
            try:
                work()
            except Exception:  # neither process nor task may raise; if one does, the thread lives on
                log.exception("work failed")

    def _next(self) -> Callable[[], None] | None:
        with self._wake:
            while self._tasks or not self._stopping:
                if self._tasks:
                    return self._tasks.popleft()
                wait_s = self._wait_s()
                if wait_s is not None and wait_s <= 0.0:
                    return self._take()
                self._wake.wait(wait_s)
        return None

    def _wait_s(self) -> float | None:
        """Seconds until the cloud in the mailbox is due; None while there is none to wait for."""
        if self._slot is None or (self._held() and not self._slot.urgent):
            return None
        return 0.0 if self._slot.urgent else self._last_start + self._period_s() - time.monotonic()

    def _take(self) -> Callable[[], None]:
        job, self._slot = self._slot, None
        assert job is not None
        self._last, self._last_start = job, time.monotonic()
        return partial(self._run, job)

    def _run(self, job: Job) -> None:
        self._since = self._last_start
        try:
            self._process(job)
        finally:
            self._since = None
