"""Micro-batches of a run, made by this process or by workers, and the folder through which they share bones."""

from __future__ import annotations

import json
import tempfile
from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from hashlib import sha256
from pathlib import Path
from typing import TypeVar

from torch.utils.data import DataLoader

from gapr_core.model.config import ModelConfig
from gapr_core.training.config import TrainConfig
from gapr_core.training.dataset import TrainingPairs, one_thread
from gapr_core.training.targets import TrainingPair

Made = TypeVar("Made")
AHEAD = 4  # micro-batches that are made before they are asked for


def bones_folder(folder: Path, config: TrainConfig) -> Path:
    """Where the bones in use of a run are kept: a scratch folder of this machine, the same at every call."""
    name = sha256(f"{folder.resolve()} {json.dumps(config.to_dict())}".encode()).hexdigest()[:16]
    scratch = Path(tempfile.gettempdir()) / f"gapr-bones-{name}"
    scratch.mkdir(exist_ok=True)
    return scratch


def micro_batches(
    config: TrainConfig,
    model: ModelConfig,
    anatomy: Path | None,
    first: int,
    rank: int,
    world: int,
    cache: Path | None = None,
    pinned: bool = False,
) -> Iterator[TrainingPair]:
    """This process's share of the micro-batches, in order, from number `first` on.

    With `cache`, a folder, the workers of all processes draw every bone once; `pinned` is for copies to a GPU. Without
    workers, one of several processes makes them in a thread: a bone that takes long then holds up none of the others.
    """
    dataset = TrainingPairs(config, model, anatomy, cache=cache)
    numbers = range(first + rank, config.pairs // config.micro_batch, world)
    loader = DataLoader(
        dataset,
        batch_size=None,
        sampler=list(numbers),
        num_workers=config.workers,
        worker_init_fn=one_thread,
        prefetch_factor=AHEAD if config.workers else None,
        multiprocessing_context="fork" if config.workers else None,
        pin_memory=pinned,
    )
    return ahead(iter(loader)) if world > 1 and not config.workers else iter(loader)


def ahead(batches: Iterator[Made]) -> Iterator[Made]:
    """The same in the same order; a thread makes the next ones while the caller is busy or waits for others."""
    pool, end = ThreadPoolExecutor(1, "batches"), object()
    try:
        coming = deque(pool.submit(next, batches, end) for _ in range(AHEAD))
        while (made := coming.popleft().result()) is not end:
            coming.append(pool.submit(next, batches, end))
            yield made  # type: ignore[misc]
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
