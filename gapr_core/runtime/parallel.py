"""How many threads to use, and processes that end with the one that started them."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, wraps
from multiprocessing import parent_process
from typing import Any, ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController

Given = ParamSpec("Given")
Result = TypeVar("Result")


def thread_count(requested: int) -> int:
    """The number asked for; 0 means every core that this process may use."""
    return requested or len(os.sched_getaffinity(0))


def in_threads(work: Callable[..., Result], *columns: Iterable[Any], num_threads: int = 0) -> list[Result]:
    """`list(map(work, *columns))`, in that many threads; 0 means every core. One thread is the caller's own."""
    threads = thread_count(num_threads)
    if threads == 1:
        return list(map(work, *columns))
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, *columns))


def end_with_parent() -> None:
    """End this worker process when its parent has ended, however that happened; nothing in the first process.

    Workers of a `ProcessPoolExecutor` wait for their next task for ever when a signal ends their parent.
    """
    parent = parent_process()
    if parent is None:
        return

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, name="end with parent", daemon=True).start()


def single_threaded_blas(call: Callable[Given, Result]) -> Callable[Given, Result]:
    """The same call; while it runs, NumPy's and SciPy's linear algebra uses one thread, in the whole process.

    The matrices of a registration are small. Several threads gain nothing with them, and waste whole cores in busy
    waiting as soon as something else wants one. Threads of our own kernels are not affected.
    """

    @wraps(call)
    def limited(*args: Given.args, **kwargs: Given.kwargs) -> Result:
        with _controller().limit(limits=1, user_api="blas"):
            return call(*args, **kwargs)

    return limited


@cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController()
