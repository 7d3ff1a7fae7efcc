"""What is registered as one: clouds on their way into the collection of the method, and the end of a collection."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from gapr_ros.node.guard import describe
from gapr_ros.node.refusal import Reason, RefusedError
from gapr_ros.node.worker import Job

log = logging.getLogger(__name__)
MOST_LATE = 100  # clouds that wait for their transform


class Late:
    """Clouds that a newer one pushed out of the mailbox, kept until their transform is there; waits for nothing.

    Args:
        collect: has the method keep a cloud; raises what is wrong with it.
        report: is called for every cloud: whether it was collected, and why not.
    """

    def __init__(self, collect: Callable[[Job], None], report: Callable[[bool, str], None]) -> None:
        self._collect, self._report = collect, report
        self._jobs: deque[tuple[float, Job]] = deque()  # with the time of the first try

    def add(self, job: Job) -> None:
        """One more; the oldest goes when there are too many."""
        if len(self._jobs) == MOST_LATE:
            self._jobs.popleft()
            self._report(False, f"more than {MOST_LATE} clouds wait for their transforms")
        self._jobs.append((time.monotonic(), job))

    def take(self, wait_s: float) -> None:
        """Collect those whose transform has come; one whose transform did not come for so long is dropped."""
        jobs, self._jobs = self._jobs, deque()
        self._jobs.extend(each for each in jobs if not self._is_done(*each, wait_s))

    def end(self, why: str) -> None:
        """Drop those that wait."""
        jobs, self._jobs = self._jobs, deque()
        for _ in jobs:
            self._report(False, why)

    def _is_done(self, since: float, job: Job, wait_s: float) -> bool:
        try:
            self._collect(job)
        except RefusedError as refusal:
            if refusal.reason is Reason.TF_MISSING and time.monotonic() - since < wait_s:
                return False
            self._report(False, str(refusal))
        except Exception as error:  # whatever is wrong with it, it is counted as dropped
            self._report(False, describe(error))
        else:
            self._report(True, "")
        return True


def forget(method: Any, why: str) -> None:
    """Poses and clouds that a method remembers, as `Tracker` and `Accumulator` do; says so where clouds are lost."""
    if not hasattr(method, "reset"):
        return
    count = len(getattr(method, "collected", ()))
    if count:
        log.warning("%s: the %d points collected so far are forgotten", why, count)
    method.reset()
