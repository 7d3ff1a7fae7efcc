"""Threads of libraries during a registration, and workers that end with their parent."""

import signal
import subprocess
import sys
import threading
import time

import numpy as np
import psutil
import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from gapr_core import Registrar
from gapr_core.data.parametric import make_bone
from gapr_core.runtime.parallel import in_pieces


def threads(api):
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == api}


class Witness:
    """Proposes nothing, and remembers how many threads linear algebra and torch had."""

    name = "search"

    def prepare(self, target):
        self.prepared_with = threads("blas"), torch.get_num_threads()

    def propose(self, source, target, rng):
        self.proposed_with = threads("blas"), torch.get_num_threads()
        return np.empty((0, 4, 4))


@pytest.fixture(scope="module")
def cloud():
    return make_bone("tibia", 0).sample(3000, np.random.default_rng(0))[0]


def test_libraries_have_one_thread_while_a_cloud_is_registered_and_as_many_as_before_afterwards(cloud):
    witness = Witness()
    registrar = Registrar(proposers=[witness])
    with threadpool_limits(2):
        assert (threads("blas"), threads("openmp"), torch.get_num_threads()) == ({2}, {2}, 2)
        target = registrar.prepare(cloud)
        registrar.register(cloud[:1500], target)
        assert (threads("blas"), threads("openmp"), torch.get_num_threads()) == ({2}, {2}, 2)
    assert witness.prepared_with == witness.proposed_with == ({1}, 1)


@pytest.mark.parametrize(("rows", "num_threads"), [(0, 2), (1, 2), (3, 1), (50, 1), (50, 3)])
def test_pieces_are_consecutive_and_four_for_each_of_several_threads(rows, num_threads):
    pieces = in_pieces(lambda piece: piece, np.arange(rows), num_threads)
    assert len(pieces) == (1 if num_threads == 1 or not rows else min(4 * num_threads, rows))
    assert list(np.concatenate(pieces)) == list(range(rows))


@pytest.mark.parametrize(("rows", "num_threads", "own"), [(1, 2, True), (8, 1, True), (8, 2, False)])
def test_a_single_piece_starts_no_thread(rows, num_threads, own):
    """A thread for the refinement of one pose costs ten times as much as the refinement."""
    ran_in = set(in_pieces(lambda piece: threading.get_ident(), np.arange(rows), num_threads))
    assert (ran_in == {threading.get_ident()}) is own


def test_torch_that_is_loaded_after_the_first_registration_has_one_thread_too():
    done = subprocess.run([sys.executable, "-c", LATE_TORCH], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr


LATE_TORCH = """
from gapr_core.runtime.parallel import single_threaded_libraries

@single_threaded_libraries
def threads():
    import sys
    return sys.modules["torch"].get_num_threads() if "torch" in sys.modules else None

assert threads() is None
import torch
from threadpoolctl import threadpool_limits
with threadpool_limits(2):
    assert threads() == 1 and torch.get_num_threads() == 2
"""


PARENT = """
import os, time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from gapr_core.runtime.parallel import end_with_parent

if __name__ == "__main__":
    with ProcessPoolExecutor(1, get_context("spawn"), end_with_parent) as pool:
        print(pool.submit(os.getpid).result(), flush=True)
        time.sleep(600.0)
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_worker_ends_when_a_signal_ends_its_parent(tmp_path, number):
    (tmp_path / "parent.py").write_text(PARENT)
    parent = subprocess.Popen([sys.executable, tmp_path / "parent.py"], stdout=subprocess.PIPE, text=True)
    worker = psutil.Process(int(parent.stdout.readline()))
    parent.send_signal(number)
    parent.wait()
    deadline = time.monotonic() + 60.0
    while worker.is_running() and worker.status() != psutil.STATUS_ZOMBIE and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not worker.is_running() or worker.status() == psutil.STATUS_ZOMBIE
