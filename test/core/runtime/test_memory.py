"""How much memory a call needs."""

import tracemalloc

import numpy as np
import pytest

from gapr_core.runtime.memory import allocated_mb


def test_the_largest_size_counts_also_of_what_is_gone_at_the_end():
    assert allocated_mb(lambda: np.zeros(2**20).sum()) == pytest.approx(8.0, abs=0.5)


def test_a_failed_call_leaves_nothing_running():
    with pytest.raises(ZeroDivisionError):
        allocated_mb(lambda: 1 / 0)
    assert not tracemalloc.is_tracing()
