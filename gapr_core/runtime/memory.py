"""How much memory a call needs."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable


def allocated_mb(call: Callable[[], object]) -> float:
    """Measure the most memory, MiB, that Python and NumPy allocate during a call; the call is much slower."""
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1] / 2**20
    finally:
        tracemalloc.stop()
