"""One thread, one slot: newest wins, nothing is lost without being counted."""

from __future__ import annotations

import threading
import time

import pytest
from harness import wait_until

from gapr_ros.node.outcome import Job
from gapr_ros.node.worker import Worker


class Bench:
    """A worker whose process waits for a gate."""

    def __init__(self, held=False):
        self.done, self.gate, self.held = [], threading.Event(), held
        self.worker = Worker(self._process, lambda: self.held)

    def _process(self, job):
        self.gate.wait(10.0)
        self.done.append((job, time.monotonic()))

    def names(self):
        return [job.cloud for job, _ in self.done]


def job(name: bytes) -> Job:
    return Job(name, epoch=0, received_ns=0)


@pytest.fixture
def busy():
    """A bench whose worker has taken a cloud, b"busy", and waits for the gate."""
    bench = Bench()
    bench.worker.put(job(b"busy"))
    wait_until(lambda: bench.worker._slot is None)
    yield bench
    bench.gate.set()
    assert bench.worker.stop(5.0)


def test_a_cloud_that_is_pushed_out_is_left_to_a_task_before_the_next_one_is_processed(busy):
    order = []
    for i in range(1, 5):
        busy.worker.put(job(b"%d" % i), leave=lambda old: order.append((old.cloud, len(busy.done))))
    busy.gate.set()
    wait_until(lambda: len(busy.done) == 2)
    assert busy.names() == [b"busy", b"4"]
    assert order == [(b"1", 1), (b"2", 1), (b"3", 1)]


def test_those_who_wait_for_a_cloud_wait_for_the_newer_one(busy):
    busy.worker.put(job(b"old"))
    assert busy.worker.ask("waiter", epoch=0)
    busy.worker.put(job(b"new"))
    busy.gate.set()
    wait_until(lambda: len(busy.done) == 2)
    assert busy.names() == [b"busy", b"new"] and busy.done[1][0].waiters == ["waiter"]


def test_a_held_cloud_waits_until_it_is_asked_for():
    bench = Bench(held=True)
    bench.gate.set()
    bench.worker.put(job(b"1"))
    assert bench.worker.put(job(b"2")) == 1
    time.sleep(0.05)
    assert not bench.done
    assert bench.worker.ask("waiter", epoch=3)
    wait_until(lambda: bench.names() == [b"2"])
    assert bench.done[0][0].epoch == 3, "as of now"
    assert bench.worker.ask("again", epoch=7)
    wait_until(lambda: bench.names() == [b"2", b"2"])
    assert bench.done[1][0].epoch == 7
    bench.held = False
    bench.worker.wake()
    bench.worker.put(job(b"3"))
    wait_until(lambda: bench.names()[-1] == b"3")
    bench.worker.stop(5.0)


def test_a_cloud_that_takes_the_place_of_one_that_was_asked_for_is_not_held(busy):
    busy.held = True
    busy.worker.put(job(b"old"))
    assert busy.worker.ask("waiter", epoch=0)
    busy.worker.put(job(b"new"))
    busy.gate.set()
    wait_until(lambda: busy.names() == [b"busy", b"new"], 5.0)
    assert busy.done[1][0].waiters == ["waiter"]


def test_what_was_cleared_cannot_be_asked_for_again():
    """Neither the cloud that waits nor the one that was processed last, of whatever epoch they are."""
    bench = Bench()
    bench.gate.set()
    bench.worker.put(job(b"1"))
    wait_until(lambda: bench.names() == [b"1"])
    bench.held = True
    bench.worker.put(job(b"2"))
    assert bench.worker.clear().cloud == b"2"
    assert not bench.worker.ask("waiter", epoch=0)
    assert bench.worker.stop(5.0) and bench.names() == [b"1"]


def test_without_a_cloud_there_is_nothing_to_ask_for():
    bench = Bench()
    assert not bench.worker.ask("waiter", epoch=0)
    assert bench.worker.clear() is None
    bench.worker.stop(5.0)


def test_tasks_go_before_clouds_and_an_exception_ends_nothing(busy, caplog):
    order = []
    busy.worker.put(job(b"1"))
    busy.worker.run(lambda: 1 / 0)
    busy.worker.run(lambda: order.append(list(busy.names())))
    busy.gate.set()
    wait_until(lambda: len(busy.done) == 2)
    assert order == [[b"busy"]]
    assert "ZeroDivisionError" in caplog.text


def test_stop_says_when_the_work_does_not_end(busy):
    assert not busy.worker.stop(0.05)


def test_an_outdated_cloud_cannot_be_asked_for_again():
    bench = Bench(held=True)
    bench.gate.set()
    bench.worker.put(job(b"1"))
    assert bench.worker.ask("waiter", epoch=0)
    wait_until(lambda: bench.names() == [b"1"])
    bench.worker.outdate(1)
    assert not bench.worker.ask("again", epoch=1)
    bench.worker.put(Job(b"2", epoch=1, received_ns=0))
    assert bench.worker.ask("again", epoch=1)
    wait_until(lambda: bench.names() == [b"1", b"2"])
    bench.worker.stop(5.0)


def test_tasks_are_done_before_the_thread_ends(busy):
    order = []
    busy.worker.run(lambda: order.append("task"))
    threading.Timer(0.1, busy.gate.set).start()
    assert busy.worker.stop(5.0)
    assert order == ["task"]
