"""Shorten the profile that a Dask worker keeps of itself; needs dask.distributed."""

from __future__ import annotations

from collections import deque

from distributed import Worker, WorkerPlugin

SECONDS = 60


class ShortProfile(WorkerPlugin):
    """Keeps the last minute of a worker's statistical profile, for its dashboard.

    Dask keeps a call tree for each second of the last hours, 0.4 MB each with stacks as deep as those of a
    registration: a worker that registers for an hour would hold more than a gigabyte of them.
    """

    name = "gapr-short-profile"
    idempotent = True  # one of this name for a cluster

    def setup(self, worker: Worker) -> None:
        """Shorten the profile so far, and from now on; a worker makes one entry each second."""
        worker.profile_history = deque(worker.profile_history, maxlen=SECONDS)
        worker.profile_keys_history = deque(worker.profile_keys_history, maxlen=SECONDS)
