"""How many threads to use."""

from __future__ import annotations

import os


def thread_count(requested: int) -> int:
    """The number asked for; 0 means every core that this process may use."""
    return requested or len(os.sched_getaffinity(0))
