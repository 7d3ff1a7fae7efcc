"""One thread and a one-slot mailbox: the newest cloud wins; what becomes of the others is the caller's to say."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

from gapr_ros.node.outcome import Job

log = logging.getLogger(__name__)


class Worker:
    """Runs `process(job)` for the newest cloud and `run(task)` for others, one after the other, off the executor.

    Args:
        process: what to do with a job, in the worker's thread; must not raise.
        held: asked before a job that is not urgent; true leaves it in the mailbox (`continuous: false`).
    """

    def __init__(self, process: Callable[[Job], None], held: Callable[[], bool]) -> None:
        self._process, self._held = process, held
        self._wake = threading.Condition()
        self._slot: Job | None = None
        self._tasks: deque[Callable[[], None]] = deque()
        self._last: Job | None = None
        self._oldest = 0
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
        """Look again: `held` may have changed."""
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
                if self._slot is not None and (self._slot.urgent or not self._held()):
                    self._last, self._slot = self._slot, None
                    return partial(self._run, self._last)
                self._wake.wait()
        return None

    def _run(self, job: Job) -> None:
        self._since = time.monotonic()
        try:
            self._process(job)
        finally:
            self._since = None
