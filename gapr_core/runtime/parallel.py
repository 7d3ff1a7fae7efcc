"""How many threads to use."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager
from functools import cache

from threadpoolctl import ThreadpoolController


def thread_count(requested: int) -> int:
    """The number asked for; 0 means every core that this process may use."""
    return requested or len(os.sched_getaffinity(0))


def single_threaded_blas() -> AbstractContextManager[object]:
    """Within it, NumPy's and SciPy's linear algebra uses one thread, in the whole process.

    The matrices of a registration are small. Several threads gain nothing with them, and waste whole cores in busy
    waiting as soon as something else wants one. Threads of our own kernels are not affected.
    """
    return _controller().limit(limits=1, user_api="blas")


@cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController()
