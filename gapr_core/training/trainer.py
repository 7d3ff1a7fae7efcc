"""Train the network: the whole run on one screen.

One process on a CPU or a GPU, several under `torchrun`: the same call. Stop it at any time and call it again.
"""

from __future__ import annotations

import csv
import json
import logging
import math
import shutil
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.utils.data import DataLoader
from tqdm import tqdm

from gapr_core.errors import ConfigError
from gapr_core.model import weights
from gapr_core.model.config import ModelConfig
from gapr_core.model.network import GAPRNet
from gapr_core.runtime import files
from gapr_core.training import distributed, provenance
from gapr_core.training.checkpoint import load_checkpoint, save_checkpoint
from gapr_core.training.config import TrainConfig
from gapr_core.training.dataset import TrainingPairs, one_thread, prune
from gapr_core.training.losses import Losses, compute_losses
from gapr_core.training.subjects import Drawn
from gapr_core.training.targets import TrainingPair
from gapr_core.training.validation import validate, validation_set

log = logging.getLogger(__name__)

MOST_LOST = 10  # steps in a row without finite gradients: one is bad luck and is left out, so many are a defect


def train(config: TrainConfig, folder: Path, anatomy: Path | None, minutes: float = math.inf, card: Any = None) -> Path:
    """Run until the schedule ends or `minutes` are over, from where the last call in `folder` stopped.

    Args:
        config: the run; must be the one that `folder` was begun with.
        folder: gets config.json, provenance.json, checkpoint.safetensors, log.csv, validation.csv, curves.png and
            weights.safetensors.
        anatomy: real bones for training and validation; None for parametric ones.
        minutes: budget of this call.
        card: goes into the header of the weights.

    Returns:
        The averaged weights, ready for `NetworkProposer`.

    Raises:
        ConfigError: fewer pairs than one batch, another run in `folder`, or see `begin`.
        FloatingPointError: step after step had gradients that are not finite.
    """
    if config.pairs < config.batch:
        given = f"{config.pairs} pairs"
        raise ConfigError(f"a batch of {config.batch} or more", given, "raise --pairs, or lower batch and micro_batch")
    group = distributed.start(config.device)
    rank, world, device = group.rank, group.world, group.device
    model = config.network()
    per_step = group.share(config.batch, config.micro_batch)
    check_folder(folder, config, model)
    torch.manual_seed(config.seed)
    checkpoint = folder / "checkpoint.safetensors"
    network = (GAPRNet(model) if checkpoint.exists() else begin(config, model)).to(device)
    ema = GAPRNet(model).to(device)
    ema.load_state_dict(network.state_dict())
    learns = learning(network, config.trained)
    optimizer = optimizer_of(learns, config)
    state: dict[str, Any] = {"step": 0, "seconds": 0.0}
    if checkpoint.exists():
        state = load_checkpoint(checkpoint, network, ema, optimizer)
    learner = group.wrap(Learner(network, config))
    drawn = Drawn.of(anatomy, folder / f"subjects_{rank}.json")
    steps = config.pairs // config.batch
    bones = bones_folder(folder, config) if max(1, config.workers) * world > 1 else None
    first = state["step"] * config.batch // config.micro_batch
    batches = micro_batches(config, model, anatomy, first, rank, world, bones, device.type == "cuda")
    held_out = validation_set(config, model, anatomy) if rank == 0 else []
    origin = claim_folder(folder, config, model, anatomy, state["step"], world) if rank == 0 else []
    begun, saved, validated = time.monotonic(), time.monotonic(), time.monotonic()
    earlier, lost = state["seconds"], 0

    ahead = range(state["step"], steps)
    progress = tqdm(ahead, initial=state["step"], total=steps, disable=rank > 0 or None, unit="step")
    for step in progress:
        rate = learning_rate(config, step / steps)
        for parameters in optimizer.param_groups:
            parameters["lr"] = rate
        parts = []
        for part in range(per_step):
            number = (step * per_step + part) * world + rank  # of the micro-batch, however many processes there are
            generator = torch.Generator().manual_seed(config.seed + 7919 * number)
            pairs = next(batches)
            drawn.add(pairs.subjects)
            with distributed.without_sync(learner, part + 1 < per_step):
                losses = learner(pairs.to(device), generator)
                (losses.total / per_step).backward()
            parts.append(losses)
        norm = torch.nn.utils.clip_grad_norm_(learns, config.clip, foreach=True)
        lost = 0 if torch.isfinite(norm) else lost + 1
        if lost == MOST_LOST:
            raise FloatingPointError(f"{lost} steps in a row, up to {step + 1}, had gradients that are not finite")
        if not lost:
            optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        average(ema, network, min(config.ema, (1 + step) / (10 + step)))

        state = {"step": step + 1, "seconds": earlier + time.monotonic() - begun}
        last = step + 1 == steps or time.monotonic() - begun > 60.0 * minutes
        is_logged = last or (step + 1) % config.log_steps == 0
        if rank == 0 and is_logged:
            row = log_row(state, config, rate, float(norm), parts)
            progress.set_postfix(loss=row["loss"], coarse=row["coarse"], fine=row["fine"])
            append(folder / "log.csv", row)
            if last or time.monotonic() - validated > 60.0 * config.validate_minutes:
                validated = time.monotonic()
                report(folder, ema, held_out, state, config, device)
                draw_curves(folder)
        is_due = last or time.monotonic() - saved > 60.0 * config.checkpoint_minutes
        if is_due:
            saved = time.monotonic()
            drawn.write()
        if rank == 0 and is_due:
            save_checkpoint(checkpoint, network, ema, optimizer, state)
            header = {**(card or {}), "run": config.to_dict(), **state, "provenance": origin}
            weights.save(ema, folder / "weights.safetensors", header | {"subjects": drawn.count()})
            if bones:
                prune(bones, config, (step + 1) * config.batch)
        if group.agree(last):
            drawn.write()
            break
    distributed.stop(group)
    if bones and rank == 0 and state["step"] == steps:
        shutil.rmtree(bones, ignore_errors=True)
    return folder / "weights.safetensors"


def begin(config: TrainConfig, model: ModelConfig) -> GAPRNet:
    """A network to train: with the weights of `config.initial`, or random ones.

    Where the bone head alone is trained, `config.initial` need not have one. A network without a head begins with
    all but the head of `config.initial`.

    Raises:
        ConfigError: the tensors of `config.initial` are not those of this network, other settings may differ; or the
            bone head is to be trained alone, and there is none, or no network for it.
        WeightsError: `config.initial` cannot be read.
    """
    network = GAPRNet(model)
    if config.trained != "all":
        check_head(config, model)
    if not config.initial:
        return network
    given = weights.load(config.initial)[0].state_dict()
    own = network.state_dict()
    if config.trained != "all":
        given = tensors_of(own, config.trained) | given
    elif model.bone_head == "none":
        given = {name: given[name] for name in given.keys() - tensors_of(given, "bone_head").keys()}
    if {name: tensor.shape for name, tensor in given.items()} != {name: tensor.shape for name, tensor in own.items()}:
        raise ConfigError(
            "initial weights of the network that is trained",
            f"another in {config.initial}",
            "train the network of that file (--model), or begin without it",
        )
    network.load_state_dict(given)
    return network.train()


def tensors_of(state: dict[str, torch.Tensor], name: str) -> dict[str, torch.Tensor]:
    """The tensors of one part of a network, such as `bone_head`."""
    return {tensor: state[tensor] for tensor in state if tensor.startswith(f"{name}.")}


def check_head(config: TrainConfig, model: ModelConfig) -> None:
    """Raise `ConfigError` where there is no bone head to train alone, or no network that it could rest on."""
    if model.bone_head == "none":
        raise ConfigError("a network with a bone head", "bone_head: none", "train all, or choose bone_head: mlp")
    if not config.initial:
        raise ConfigError("weights of the network under the bone head", "no `initial`", "name them with --initial")


def learning(network: GAPRNet, trained: str) -> list[nn.Parameter]:
    """The parameters that a run changes, all or those of one part; the others get no gradient."""
    for name, parameter in network.named_parameters():
        parameter.requires_grad_(trained == "all" or name.startswith(f"{trained}."))
    return [parameter for parameter in network.parameters() if parameter.requires_grad]


def optimizer_of(learns: list[nn.Parameter], config: TrainConfig) -> torch.optim.AdamW:
    """AdamW in one pass over all parameters."""
    rates = {"lr": config.learning_rate, "weight_decay": config.weight_decay, "betas": (0.9, 0.98)}
    return torch.optim.AdamW(learns, fused=True, **rates)  # type: ignore[arg-type]


def bones_folder(folder: Path, config: TrainConfig) -> Path:
    """Where the bones in use of a run are kept: a scratch folder of this machine, the same at every call."""
    name = sha256(f"{folder.resolve()} {json.dumps(config.to_dict())}".encode()).hexdigest()[:16]
    scratch = Path(tempfile.gettempdir()) / f"gapr-bones-{name}"
    scratch.mkdir(exist_ok=True)
    return scratch


class Learner(nn.Module):
    """The network with its losses: what a training pass calls, in bfloat16 where asked for."""

    def __init__(self, network: GAPRNet, config: TrainConfig) -> None:
        super().__init__()
        self.network, self.config = network, config

    def forward(self, pair: TrainingPair, generator: torch.Generator) -> Losses:
        """The losses of one micro-batch."""
        with torch.autocast(pair.T.device.type, torch.bfloat16, enabled=self.config.precision == "bfloat16"):
            weights = self.config.early_loss, self.config.bone_loss
            return compute_losses(self.network, pair, generator, *weights)[0]


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


def learning_rate(config: TrainConfig, progress: float) -> float:
    """Linear warm-up, then a cosine; `progress` from 0 to 1."""
    if progress < config.warmup:
        return config.learning_rate * min(1.0, (progress + 1e-3) / config.warmup)
    fallen = 0.5 * (1.0 + math.cos(math.pi * (progress - config.warmup) / (1.0 - config.warmup)))
    return config.learning_rate * (config.final_rate + (1.0 - config.final_rate) * fallen)


@torch.no_grad()
def average(ema: GAPRNet, network: GAPRNet, decay: float) -> None:
    """Exponential moving average of the weights."""
    torch._foreach_lerp_(list(ema.parameters()), list(network.parameters()), 1.0 - decay)


def check_folder(folder: Path, config: TrainConfig, model: ModelConfig) -> None:
    """The folder is empty, or holds a run with these settings.

    The network's settings count, not the path of their yaml; an entry that did not exist then stood at its default.

    Raises:
        ConfigError: the folder holds another run.
    """
    path = folder / "config.json"
    if path.exists():
        begun = json.loads(path.read_text())
        there = TrainConfig.from_dict(begun["train"]), ModelConfig.from_dict(begun["model"])
        if (replace(there[0], model=config.model), there[1]) != (config, model):
            raise ConfigError("the settings this folder was begun with", f"others for {folder}", "choose a new folder")


def claim_folder(
    folder: Path, config: TrainConfig, model: ModelConfig, anatomy: Path | None, step: int, world: int
) -> list[dict[str, Any]]:
    """Write the run's settings, if they are not there yet, and where it goes on; returns all of provenance.json.

    Only now, when nothing that the settings name was refused: the next try may have others.
    """
    path = folder / "config.json"
    if not path.exists():
        files.write_json(path, {"train": config.to_dict(), "model": model.to_dict()})
    return provenance.append(folder, config, anatomy, step, world)


def log_row(
    state: dict[str, Any], config: TrainConfig, rate: float, norm: float, parts: list[Losses]
) -> dict[str, Any]:
    """One line of log.csv."""
    names = (
        ("coarse", "fine", "early", "bone") if isinstance(parts[0].bone, torch.Tensor) else ("coarse", "fine", "early")
    )
    means = {n: sum(float(getattr(p, n).detach()) for p in parts) / len(parts) for n in names}
    row = {"step": state["step"], "pairs": state["step"] * config.batch, "seconds": round(state["seconds"], 1)}
    total = sum(float(p.total.detach()) for p in parts) / len(parts)
    values = {"rate": rate, "norm": norm, "loss": total, **means}
    return row | {name: float(f"{value:.5g}") for name, value in values.items()}


def report(
    folder: Path, ema: GAPRNet, held_out: Any, state: dict[str, Any], config: TrainConfig, device: torch.device
) -> None:
    """Validate the averaged weights: lines of validation.csv, and one on the terminal."""
    if not held_out:
        return
    scores = validate(ema, held_out, device)
    for protocol, score in scores.items():
        values = {name: round(value, 4) for name, value in asdict(score).items()}
        row = {"pairs": state["step"] * config.batch, "seconds": round(state["seconds"], 1), "protocol": protocol}
        append(folder / "validation.csv", row | values)
    total = scores["all"]
    tqdm.write(
        f"{state['step'] * config.batch} pairs  {state['seconds'] / 60:.0f} min  inliers: coarse "
        f"{total.coarse_inliers:.2f}, fine {total.fine_inliers:.2f}  recall: 4 mm/5 deg {total.first:.2f}, "
        f"a near pose among the proposals {total.among:.2f}"
    )


def draw_curves(folder: Path) -> None:
    """Draw curves.png again; where even matplotlib cannot be loaded, a warning instead of the end of the run."""
    try:
        from gapr_core.training import curves
    except ImportError as error:
        log.warning("no curves of %s: %s", folder, error)
    else:
        curves.draw_or_warn(folder)


def append(path: Path, row: dict[str, Any]) -> None:
    """One line at the end of a CSV file, with a head if it is new; in place of one that a crash cut off."""
    with path.open("a+b") as file:
        size = file.seek(0, 2)
        file.seek(max(size - 4096, 0))
        whole = size - len(file.read().rpartition(b"\n")[2])
        file.truncate(whole)
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, list(row))
        if whole == 0:
            writer.writeheader()
        writer.writerow(row)
