"""Micro-batches of a run, made by this process or by workers, and the folder through which they share bones."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path

from torch.utils.data import DataLoader

from gapr_core.model.config import ModelConfig
from gapr_core.training import provenance
from gapr_core.training.config import TrainConfig
from gapr_core.training.dataset import TrainingPairs, one_thread
from gapr_core.training.targets import TrainingPair


def bones_folder(folder: Path, config: TrainConfig, anatomy: Path | None) -> Path:
    """Return a run's scratch folder of bones in use, the same at every call.

    Other meshes, and other code that draws parametric bones, have another one: it outlives a run that is stopped.
    """
    made_of = [str(folder.resolve()), config.to_dict(), provenance.data(config.bones, anatomy)]
    name = sha256(json.dumps(made_of).encode()).hexdigest()[:16]
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

    With `cache`, a folder, the workers of all processes draw every bone once; `pinned` is for copies to a GPU.
    """
    dataset = TrainingPairs(config, model, anatomy, cache=cache)
    numbers = range(first + rank, config.pairs // config.micro_batch, world)
    loader = DataLoader(
        dataset,
        batch_size=None,
        sampler=list(numbers),
        num_workers=config.workers,
        worker_init_fn=one_thread,
        prefetch_factor=4 if config.workers else None,
        multiprocessing_context="fork" if config.workers else None,
        pin_memory=pinned,
    )
    return iter(loader)
