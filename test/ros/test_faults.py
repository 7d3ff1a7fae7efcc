"""The table of faults: one of them every day, all of them with the slow tests (`make faults`)."""

from __future__ import annotations

import pytest
from faults import FAULTS, Bench, inject

DAILY = ("model_is_a_fifo",)


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    made = Bench(tmp_path_factory.mktemp("faults"))
    yield made
    made.close()


@pytest.mark.timeout(300)
@pytest.mark.parametrize("name", DAILY)
def test_a_fault_of_every_day_is_survived(bench, name):
    assert inject(bench, name) == ""


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", [name for name in FAULTS if name not in DAILY])
def test_a_fault_is_survived(bench, name):
    assert inject(bench, name) == ""
