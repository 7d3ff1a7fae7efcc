"""Pairs on disk and methods that worker processes can import."""

import sys

import pytest
from benchmark_cases import FAKES, make_pair

from gapr_core.benchmark import runner
from gapr_core.data.pair_files import save_pair
from gapr_core.pages import benchmark_report


@pytest.fixture
def pairs(tmp_path):
    """Seven pairs: four L1 of two bones, one paper, two wrong."""
    folder = tmp_path / "pairs"
    folder.mkdir()
    made = [make_pair(k, bone="femur" if k % 2 else "tibia", count=240 if k == 2 else 260) for k in range(4)]
    made += [make_pair(4, "paper"), make_pair(5, "wrong"), make_pair(6, "wrong", "tibia")]
    for pair in made:
        save_pair(folder / f"{pair.name}.npz", pair)
    return folder


@pytest.fixture
def fakes(tmp_path, monkeypatch):
    """Puts the module `fakes` where worker processes find it."""
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "fakes.py").write_text(FAKES)
    monkeypatch.syspath_prepend(str(tmp_path / "modules"))
    monkeypatch.delitem(sys.modules, "fakes", raising=False)  # that of the test before
    return lambda *names: [f"fakes:{name}" for name in names]


@pytest.fixture
def no_report(monkeypatch):
    """Plots cost seconds and have their own tests."""
    monkeypatch.setattr(benchmark_report, "write", lambda *_: None)


@pytest.fixture
def in_process(monkeypatch, no_report):
    """No worker processes, which cost seconds each; the tests about processes do without this."""
    monkeypatch.setattr(runner, "_methods", {})
    monkeypatch.setattr(runner, "_run_pool", lambda tasks, *_: (runner.run_task(tasks.popleft()) for _ in list(tasks)))
