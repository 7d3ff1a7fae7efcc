"""The same call on many machines: tasks on a Dask cluster whose workers share a folder with this process."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from typing import Any, TypeVar

from gapr_core.errors import ConfigError, MethodUnavailableError

Task = TypeVar("Task")
Result = TypeVar("Result")
PATIENCE_S = 20.0  # for the scheduler to answer
WAITING = 3  # turns that wait for each worker: memory stays flat however long the list is
TURN_S = 0.5  # work of one message to a worker: the scheduler's share of short tasks stays small
MOST = 64  # tasks of one turn, however short they are
ARGUMENT = "address of a Dask scheduler, such as tcp://host:8786: run on its workers, which share the folders"


class WorkersDiedError(RuntimeError):
    """Three workers have died of one task."""


def results(address: str, call: Callable[..., Result], tasks: Iterable[Task], shared: Any = None) -> Iterator[Result]:
    """Return the results of the calls, as `outcomes`; raise the first error of a task."""
    for _, outcome in outcomes(address, call, tasks, shared):
        if isinstance(outcome, Exception):
            raise outcome
        yield outcome


def outcomes(
    address: str, call: Callable[..., Result], tasks: Iterable[Task], shared: Any = None
) -> Iterator[tuple[Task, Result | Exception]]:
    """Give every task with the result or the error of its call, in the order in which they finish.

    A worker gets several short tasks at a time, and hands back tasks not begun within `TURN_S`. When three workers have
    died of such a turn, each of its tasks is tried alone; when three have died of one task, its outcome is a
    `WorkersDiedError`.

    Args:
        address: of the scheduler.
        call: `call(task)`, or `call(task, shared)` where `shared` is given.
        tasks: what to do.
        shared: sent to each worker once.

    Raises:
        MethodUnavailableError: Dask is not installed.
        ConfigError: nobody answers there, or a worker has several threads, which share a process's libraries.
    """
    distributed = _library()
    with _client(distributed, address) as client:
        workers = _checked_workers(client)
        from gapr_core.runtime.short_profile import ShortProfile  # needs Dask

        client.register_plugin(ShortProfile())
        more = () if shared is None else (client.scatter(shared, broadcast=True),)
        left, size = iter(tasks), 1
        again, alone = deque[Task](), deque[Task]()  # handed back; to be tried without others
        under_way: dict[Any, list[Task]] = {}

        def submit() -> list[Any]:
            new = []
            while len(under_way) < WAITING * workers:
                turn = [alone.popleft()] if alone else [again.popleft() for _ in range(min(size, len(again)))]
                turn = turn or list(islice(left, size))
                if not turn:
                    break
                new.append(client.submit(_turn, call, turn, *more, pure=False))
                under_way[new[-1]] = turn
            return new

        finished = distributed.as_completed(submit())
        for future in finished:
            turn, raised = under_way.pop(future), future.exception()
            if raised is None:
                done, seconds = future.result()
                again.extend(turn[len(done) :])
                size = max(1, min(MOST, 2 * size, int(len(done) * TURN_S / max(seconds, 1e-9))))
                yield from zip(turn, done, strict=False)
            elif len(turn) > 1:
                alone.extend(turn)
            else:
                has_died = isinstance(raised, distributed.KilledWorker)
                yield turn[0], WorkersDiedError(str(raised)) if has_died else raised
            finished.update(submit())


def _client(distributed: Any, address: str) -> Any:
    """Connect to the scheduler."""
    try:
        return distributed.Client(address, timeout=PATIENCE_S)
    except (OSError, ValueError) as error:
        how = "start one with `dask scheduler`, and workers with `dask worker ADDRESS --nthreads 1`"
        raise ConfigError("the address of a Dask scheduler that answers", f"{address} ({error})", how) from error


def _checked_workers(client: Any) -> int:
    """Count the workers, each of one thread."""
    threads = client.nthreads().values()
    if not threads or max(threads) > 1:
        given = f"{len(threads)} workers, threads {sorted(set(threads))}"
        raise ConfigError("workers of one thread each", given, "start them with `--nthreads 1`, one for each core")
    return len(threads)


def _turn(call: Callable[..., Result], tasks: Sequence[Task], *shared: Any) -> tuple[list[Result | Exception], float]:
    """On a worker: what `call` makes of as many tasks as fit into a turn, at least one, and the seconds it took."""
    found: list[Result | Exception] = []
    begun = time.monotonic()
    for task in tasks:
        try:
            found.append(call(task, *shared))
        except Exception as error:
            found.append(error)
        if time.monotonic() - begun > TURN_S:
            break
    return found, time.monotonic() - begun


def _library() -> Any:
    try:
        import distributed
    except ImportError as error:
        how = "run: pip install 'gapr_ros[cluster]'"
        raise MethodUnavailableError("dask.distributed for --dask", str(error), how) from error
    return distributed
