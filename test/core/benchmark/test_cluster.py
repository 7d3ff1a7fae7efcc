"""A Dask cluster gives the records that one process gives, and survives the death of a worker."""

import os
import signal
import sys
import threading
import time
from itertools import islice

import pytest
from benchmark_cases import timeless

from gapr_core.benchmark import runner
from gapr_core.calibration import collect
from gapr_core.calibration.pairs import Task
from gapr_core.commands import benchmark
from gapr_core.errors import ConfigError, MethodUnavailableError
from gapr_core.runtime import cluster


def test_the_table_of_a_cluster_is_that_of_one_process(pairs, fakes, tmp_path, in_process, dask_address):
    methods = fakes("good", "turned", "raising")
    one = benchmark.benchmark(pairs, methods, tmp_path / "one")
    assert timeless(benchmark.benchmark(pairs, methods, tmp_path / "many", dask=dask_address)) == timeless(one)


def test_every_pair_of_the_calibration_gives_one_record(tmp_path, dask_address, monkeypatch):
    monkeypatch.setattr(collect.pairs, "bones_of", lambda folder, split: {})
    monkeypatch.setattr(collect, "record_of", lambda task: {"name": collect._name(task), "answers": {}})
    tasks = [Task("nowhere", "train", 0, number) for number in range(2 * collect.pairs.IN_A_ROW + 3)]
    found = collect.collect(tasks, tmp_path / "records.jsonl", 1, dask_address)
    assert sorted(record["name"] for record in found) == sorted(map(collect._name, tasks))


def test_no_more_than_a_few_tasks_wait_at_a_time(dask_address, monkeypatch):
    monkeypatch.setattr(cluster, "MOST", 2)
    begun, done = [], []

    def tasks():
        for number in range(40):
            begun.append(number)
            assert len(begun) <= len(done) + 2 * (cluster.WAITING + 1)
            yield number

    for task, outcome in cluster.outcomes(dask_address, abs, tasks()):
        done.append(task)
        assert outcome == task
    assert sorted(done) == list(range(40))


def test_short_tasks_share_a_message(dask_address, monkeypatch):
    import distributed

    turns, submit = [], distributed.Client.submit

    def submitted(client, turn, call, tasks, **how):
        turns.append(len(tasks))
        return submit(client, turn, call, tasks, **how)

    monkeypatch.setattr(distributed.Client, "submit", submitted)
    assert sorted(task for task, _ in cluster.outcomes(dask_address, abs, range(100))) == list(range(100))
    assert turns[:3] == [1, 1, 1] and 1 < max(turns) <= cluster.MOST and sum(turns) == 100


def test_what_does_not_fit_into_a_turn_is_done_in_another(dask_address, monkeypatch):
    outcomes = cluster.outcomes(dask_address, abs, range(100))
    seen = dict(islice(outcomes, 50))
    monkeypatch.setattr(cluster, "TURN_S", -1.0)
    assert seen | dict(outcomes) == {number: number for number in range(100)}


def test_what_a_task_raises_is_its_outcome(dask_address):
    outcomes = dict(cluster.outcomes(dask_address, int, ["1", "one"]))
    assert outcomes["1"] == 1 and isinstance(outcomes["one"], ValueError)


def test_workers_keep_a_minute_of_their_profile_those_that_come_later_too(dask_cluster):
    local = dask_cluster(processes=False)
    assert [outcome for _, outcome in cluster.outcomes(local.scheduler_address, abs, [-1, -2])] == [1, 2]
    local.scale(2)
    local.wait_for_workers(2, timeout=30)
    kept = [getattr(w, name) for w in local.workers.values() for name in ("profile_history", "profile_keys_history")]
    assert [each.maxlen for each in kept] == 4 * [60]


def test_workers_with_several_threads_are_refused(dask_cluster):
    address = dask_cluster(processes=False, threads_per_worker=2).scheduler_address
    with pytest.raises(ConfigError, match="--nthreads 1"):
        next(cluster.outcomes(address, abs, [1]))


def test_where_nobody_answers_the_error_says_how_to_start_one(monkeypatch):
    monkeypatch.setattr(cluster, "PATIENCE_S", 0.5)
    with pytest.raises(ConfigError, match="dask scheduler"):
        next(cluster.outcomes("tcp://127.0.0.1:9", abs, [1]))


def test_without_dask_the_error_is_its_install_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MethodUnavailableError, match="cluster"):
        next(cluster.outcomes("tcp://127.0.0.1:9", abs, [1]))


@pytest.mark.slow
def test_a_worker_that_is_killed_costs_no_record(pairs, fakes, tmp_path, no_report, dask_cluster):
    """And a method that kills every worker costs its own pair only."""
    two = dask_cluster(n_workers=2)
    pids = [worker.process.pid for worker in two.workers.values()]
    killer = threading.Thread(target=lambda: (time.sleep(1.0), os.kill(pids[0], signal.SIGKILL)))
    tasks = [runner.Task(path, name) for path in sorted(pairs.glob("*.npz")) for name in fakes("slow", "deadly")]
    killer.start()
    found = list(runner.run_on_cluster(tasks, two.scheduler_address))
    killer.join()
    assert len(found) == len(tasks)
    assert [record.pair for record in found if "died" in record.reason] == ["L1_tibia_0002"]
    assert all(record.status == "OK" for record in found if record.method == "fakes:slow")
