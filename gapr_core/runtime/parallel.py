"""How many threads to use, and processes that end with the one that started them."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, suppress
from functools import cache, wraps
from multiprocessing import parent_process
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

Given = ParamSpec("Given")
Result = TypeVar("Result")


def thread_count(requested: int) -> int:
    """Resolve the number of threads; 0 means every core that this process may use."""
    return requested or len(os.sched_getaffinity(0))


def in_threads(work: Callable[[Any], Result], items: Iterable[Any], num_threads: int = 0) -> list[Result]:
    """`list(map(work, items))`, in at most that many threads; 0 means every core. One item needs no other thread."""
    items = list(items)
    threads = min(thread_count(num_threads), len(items))
    if threads <= 1:
        return list(map(work, items))
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, items))


def in_pieces(work: Callable[[NDArray[Any]], Result], rows: NDArray[Any], num_threads: int = 0) -> list[Result]:
    """`work` of consecutive pieces of `rows`, in threads; four for each of several, so that none waits long."""
    threads = thread_count(num_threads)
    count = min(4 * threads, len(rows)) if threads > 1 else 1
    return in_threads(work, np.array_split(rows, max(count, 1)), num_threads=threads)


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


def single_threaded_libraries(call: Callable[Given, Result]) -> Callable[Given, Result]:
    """Run a call while linear algebra, OpenMP and torch use one thread.

    The matrices of a registration are small. Several threads gain little with them, and wait for each other busily: as
    soon as something else wants a core, a registration with two of them takes nine times as long. Threads of our own
    loops are not affected, nor is OpenMP in other threads. Linear algebra is, in the whole process. It may keep one
    thread after calls that overlapped in two threads, since each restores the number that it found.
    """

    @wraps(call)
    def limited(*args: Given.args, **kwargs: Given.kwargs) -> Result:
        controller = _controller("torch" in sys.modules)
        with nullcontext() if controller is None else controller.limit(limits=1):
            return call(*args, **kwargs)

    return limited


@cache
def _controller(with_torch: bool) -> Any | None:
    """Control the threads of the loaded libraries; torch brings its own OpenMP. None without threadpoolctl."""
    with suppress(ImportError):  # rosdep has no key for it; without it calls are slower on a busy machine
        from threadpoolctl import ThreadpoolController

        return ThreadpoolController()
    return None
