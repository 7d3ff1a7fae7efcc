"""How much memory a call needs."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable


def allocated_mb(call: Callable[[], object]) -> float:
    """The largest size, MiB, of what Python and NumPy allocate during a call; it is much slower meanwhile."""
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1] / 2**20
    finally:
        tracemalloc.stop()
