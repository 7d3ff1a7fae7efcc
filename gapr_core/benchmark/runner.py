"""Runs pairs x methods in worker processes and hands back one record each, whatever happens to a worker."""

from __future__ import annotations

import logging
import multiprocessing
import os
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from gapr_core.baselines import RegistrationMethod
from gapr_core.benchmark import methods
from gapr_core.benchmark.judge import answer_of, failure, judge, pair_facts, why_unusable
from gapr_core.benchmark.record import Answer, Record, Verdict
from gapr_core.config import RegistrarConfig
from gapr_core.data.pair import Pair
from gapr_core.data.pair_files import facts_hash, load_facts, load_pair, pair_hash
from gapr_core.errors import ConfigError, MethodUnavailableError, WeightsError
from gapr_core.geometry import se3
from gapr_core.results import RegistrationResult
from gapr_core.runtime import cluster, origin
from gapr_core.runtime.parallel import end_with_parent

log = logging.getLogger(__name__)

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
FAR_MM = 10.0  # median of a source to its target under a truth that is looked at
MUCH_NEARER = 0.3  # share of it that is left under the motion that was meant
LOOKED_AT = 500  # points of the source, about
_methods: dict[tuple[str, RegistrarConfig], RegistrationMethod] = {}  # of this worker process, made at their first use


class Task(NamedTuple):
    """One pair for one method; `config` are the settings of our own methods."""

    path: Path
    method: str
    config: RegistrarConfig = RegistrarConfig()


def run(tasks: Sequence[Task], jobs: int = 1, threads: int = 1) -> Iterator[Record]:
    """Records in the order in which they finish.

    Each worker is a fresh process bound to `threads` cores, so that times can be compared and random numbers repeat.
    When one dies (a crash inside a library), tasks under way are tried again, each task alone; one that dies then as
    well is recorded as a failure.
    """
    waiting = deque(tasks)
    while waiting:
        lost: list[Task] = []
        yield from _run_pool(waiting, jobs, threads, lost)
        for task in lost:
            deadly: list[Task] = []
            yield from _run_pool(deque([task]), 1, threads, deadly)
            if deadly:
                yield _failure(task, load_pair(task.path), "the process died")


def run_on_cluster(tasks: Sequence[Task], address: str) -> Iterator[Record]:
    """Run on the workers of a Dask cluster, which read the pairs from the same folder.

    A task whose worker dies goes to another one; one of which several have died is recorded as a failure.
    """
    for task, outcome in cluster.outcomes(address, run_task, tasks):
        if not isinstance(outcome, Exception):
            yield outcome
        elif isinstance(outcome, cluster.WorkersDiedError):
            yield _failure(task, load_pair(task.path), "the process died")
        else:
            raise outcome


def _run_pool(waiting: deque[Task], jobs: int, threads: int, lost: list[Task]) -> Iterator[Record]:
    """Take tasks off `waiting` until it is empty or the pool breaks; tasks under way then go to `lost`."""
    context = multiprocessing.get_context("spawn")
    under_way: dict[Future[Record], Task] = {}
    with _Environment(threads), ProcessPoolExecutor(jobs, context, _start, (context.Value("i", 0), threads)) as pool:
        try:
            while waiting or under_way:
                while waiting and len(under_way) < jobs:
                    under_way[pool.submit(run_task, waiting[0])] = waiting[0]
                    waiting.popleft()  # only now: a pool that is broken takes no task
                for future in wait(under_way, return_when=FIRST_COMPLETED).done:
                    yield future.result()
                    del under_way[future]
        except BrokenProcessPool:
            names = (f"{task.method} on {task.path.stem}" for task in under_way.values())
            log.warning("a worker process died during %s", " or ".join(names))
            lost.extend(under_way.values())


def run_task(task: Task) -> Record:
    """Prepare, register and judge one pair; run the first one of a method twice to warm up."""
    pair = load_pair(task.path)
    check_truth(pair)
    try:
        made_of = task.method, task.config
        if made_of not in _methods:
            method = methods.make(task.method, methods.config_of(task.method, task.config))
            _timed(method, pair)
            _methods[made_of] = method  # not before it has answered once
        result, times = _timed(_methods[made_of], pair)
        why = why_unusable(result)
    except (ConfigError, MethodUnavailableError, WeightsError):
        raise
    except (Exception, SystemExit) as error:  # a method that ends its process, too
        log.warning("%s failed on %s", task.method, pair.name, exc_info=True)
        return _failure(task, pair, " ".join(f"{type(error).__name__}: {error}".split()))
    if why:
        log.warning("%s on %s: %s", task.method, pair.name, why)
        return _failure(task, pair, why)
    return _record(task, pair, answer_of(result), judge(pair, result), *times)


def check_pairs(paths: Iterable[Path]) -> dict[str, str]:
    """Check the facts of every file before the first registration; the clouds are not read.

    Returns:
        Name of the file to `facts_hash`.

    Raises:
        InvalidPointCloudError: a file that is no pair, or says what cannot be.
        ConfigError: a pair without a truth.
    """
    hashes = {}
    for path in paths:
        pair = load_facts(path)
        check_truth(pair)
        hashes[path.stem] = facts_hash(pair)
    return hashes


def check_truth(pair: Pair) -> None:
    """Raise `ConfigError` for a pair that cannot be judged."""
    if not pair.has_truth and "wrong" not in pair.protocol:
        raise ConfigError(
            "a true `transform` (4, 4) in every pair", f"none in {pair.name}",
            "add it, or protocol='wrong' where no pose is right; gapr evaluate runs pairs without truth",
        )  # fmt: skip


def doubt_of_truth(pair: Pair) -> str:
    """Say why the truth of a pair seems to be written in another way; empty without a doubt."""
    if not pair.has_truth:
        return ""
    tree, T, some = cKDTree(pair.target), pair.T_target_source, pair.source[:: len(pair.source) // LOOKED_AT + 1]
    in_mm = se3.from_rotation_translation(T[:3, :3], 1000.0 * T[:3, 3])
    as_given_mm, turned, longer = (
        float(np.median(tree.query(se3.apply(motion, some))[0])) for motion in (T, se3.inverse(T), in_mm)
    )
    if as_given_mm < FAR_MM or min(turned, longer) > MUCH_NEARER * as_given_mm:
        return ""
    cause = "its inverse" if turned < longer else "with a translation in m, and not in mm, it would be"
    return f"lays the source {as_given_mm:.0f} mm from the target, {cause} {min(turned, longer):.0f} mm"


def _timed(method: RegistrationMethod, pair: Pair) -> tuple[RegistrationResult, tuple[float, float]]:
    """Register, and time registering and preparing, s."""
    start = time.perf_counter()
    target = method.prepare(pair.target, "mm")
    prepared = time.perf_counter()
    result = methods.register(method, pair.source, target, pair.viewpoint)
    return result, (time.perf_counter() - prepared, prepared - start)


def _failure(task: Task, pair: Pair, reason: str) -> Record:
    return _record(task, pair, failure(reason), judge(pair, None))


def _record(
    task: Task,
    pair: Pair,
    answer: Answer,
    verdict: Verdict,
    seconds: float | None = None,
    prepare_seconds: float | None = None,
) -> Record:
    facts = {**vars(pair_facts(pair)), **vars(answer), **vars(verdict), "pair": task.path.stem}
    return Record(
        **facts, file=task.path.name, sha256=pair_hash(pair), method=task.method, seconds=seconds,
        prepare_seconds=prepare_seconds, settings=methods.settings_of(task.method, task.config),
        facts=facts_hash(pair), machine=origin.machine(),
    )  # fmt: skip


def _start(counter: Any, threads: int) -> None:
    """Bind this worker to its own cores, as far as there are enough, and to the life of its parent."""
    end_with_parent()
    with counter.get_lock():
        number = counter.value
        counter.value += 1
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        first = number * threads % len(cores)
        os.sched_setaffinity(0, {cores[(first + k) % len(cores)] for k in range(threads)})


class _Environment:
    """Thread counts that libraries read when a worker imports them; put back afterwards."""

    def __init__(self, threads: int) -> None:
        self.wanted = dict.fromkeys(THREAD_VARIABLES, str(threads))

    def __enter__(self) -> None:
        self.before = {name: os.environ.get(name) for name in self.wanted}
        os.environ.update(self.wanted)

    def __exit__(self, *_: object) -> None:
        for name, value in self.before.items():
            os.environ.pop(name) if value is None else os.environ.__setitem__(name, value)
