"""The same call on many machines: tasks on a Dask cluster whose workers share a folder with this process."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import Any, TypeVar

from gapr_core.errors import ConfigError, MethodUnavailableError

Task = TypeVar("Task")
Result = TypeVar("Result")
PATIENCE_S = 20.0  # for the scheduler to answer
WAITING = 3  # tasks that wait for each worker: memory stays flat however long the list is
ARGUMENT = "address of a Dask scheduler, such as tcp://host:8786: run on its workers, which share the folders"


class WorkersDiedError(RuntimeError):
    """Three workers have died of one task."""


def results(address: str, call: Callable[..., Result], tasks: Iterable[Task], shared: Any = None) -> Iterator[Result]:
    """What the calls return, as `outcomes`; the first error of a task ends it, and is raised."""
    for _, outcome in outcomes(address, call, tasks, shared):
        if isinstance(outcome, Exception):
            raise outcome
        yield outcome


def outcomes(
    address: str, call: Callable[..., Result], tasks: Iterable[Task], shared: Any = None
) -> Iterator[tuple[Task, Result | Exception]]:
    """Every task with what its call returned or raised, in the order in which they finish.

    A task whose worker dies goes to another one. When three workers have died of it, its outcome is a
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
    try:
        client = distributed.Client(address, timeout=PATIENCE_S)
    except (OSError, ValueError) as error:
        how = "start one with `dask scheduler`, and workers with `dask worker ADDRESS --nthreads 1`"
        raise ConfigError("the address of a Dask scheduler that answers", f"{address} ({error})", how) from error
    with client:
        workers = client.nthreads()
        if not workers or max(workers.values()) > 1:
            given = f"{len(workers)} workers, threads {sorted(set(workers.values()))}"
            raise ConfigError("workers of one thread each", given, "start them with `--nthreads 1`, one for each core")
        more = () if shared is None else (client.scatter(shared, broadcast=True),)
        left, under_way = iter(tasks), {}

        def submit(count: int) -> list[Any]:
            new = {client.submit(call, task, *more, pure=False): task for task in islice(left, count)}
            under_way.update(new)
            return list(new)

        finished = distributed.as_completed(submit(WAITING * len(workers)))
        for future in finished:
            raised = future.exception()
            if isinstance(raised, distributed.KilledWorker):
                raised = WorkersDiedError(str(raised))
            yield under_way.pop(future), raised or future.result()
            finished.update(submit(1))


def _library() -> Any:
    try:
        import distributed
    except ImportError as error:
        how = "run: pip install 'gapr_ros[cluster]'"
        raise MethodUnavailableError("dask.distributed for --dask", str(error), how) from error
    return distributed
