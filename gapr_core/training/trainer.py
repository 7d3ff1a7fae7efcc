"""Train the network: the whole run on one screen.

One process on a CPU or a GPU, several under `torchrun`: the same call. Stop it at any time and call it again.
"""

from __future__ import annotations

import math
import shutil
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch
from torch import nn
from tqdm import tqdm

from gapr_core.errors import ConfigError, WeightsError
from gapr_core.model import weights
from gapr_core.model.network import GAPRNet
from gapr_core.runtime import files
from gapr_core.training import distributed, run_folder
from gapr_core.training.batches import bones_folder, micro_batches
from gapr_core.training.checkpoint import load_checkpoint, save_checkpoint
from gapr_core.training.config import TrainConfig
from gapr_core.training.dataset import prune
from gapr_core.training.distributed import Group
from gapr_core.training.losses import Losses, compute_losses
from gapr_core.training.start import begin, optimizer_of
from gapr_core.training.subjects import Drawn
from gapr_core.training.targets import TrainingPair
from gapr_core.training.validation import validation_set

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
        ConfigError: fewer pairs than one batch, another or a damaged run in `folder`, or one that another process
            trains; or see `start.begin`.
        WeightsError: a damaged checkpoint, or see `start.begin`.
        FloatingPointError: step after step had gradients that are not finite.
    """
    if config.pairs < config.batch:
        given = f"{config.pairs} pairs"
        raise ConfigError(f"a batch of {config.batch} or more", given, "raise --pairs, or lower batch and micro_batch")
    group = distributed.start(config.device)
    with files.alone_in(folder) if group.rank == 0 else nullcontext():
        run = Run(config, folder, anatomy, group, card or {})
        run.go_on(minutes)
        distributed.stop(group)
        run.leave()
    return run.weights


class Run:
    """One process's share of a run: the network, its averaged weights, the optimiser, and how far they are."""

    def __init__(
        self, config: TrainConfig, folder: Path, anatomy: Path | None, group: Group, card: dict[str, Any]
    ) -> None:
        model = config.network()
        self.config, self.folder, self.group, self.card = config, folder, group, card
        self.checkpoint, self.weights = folder / "checkpoint.safetensors", folder / "weights.safetensors"
        self.steps, self.per_step = config.pairs // config.batch, group.share(config.batch, config.micro_batch)
        run_folder.check(folder, config, model)
        torch.manual_seed(config.seed)
        begun = self.checkpoint.exists()
        self.network = (GAPRNet(model) if begun else begin(config, model)).to(group.device)
        self.ema = GAPRNet(model).to(group.device)
        self.ema.load_state_dict(self.network.state_dict())
        self.optimizer = optimizer_of(self.network, config)
        self.state: dict[str, Any] = {"step": 0, "seconds": 0.0}
        if begun:
            self.state = load_checkpoint(self.checkpoint, self.network, self.ema, self.optimizer)
        self.learner = group.wrap(Learner(self.network, config))
        self.lost = 0  # steps in a row without finite gradients
        self.drawn = Drawn.of(anatomy, folder / f"subjects_{group.rank}.json")
        self.bones = bones_folder(folder, config, anatomy) if max(1, config.workers) * group.world > 1 else None
        first = self.state["step"] * config.batch // config.micro_batch
        pinned = group.device.type == "cuda"
        self.batches = micro_batches(config, model, anatomy, first, group.rank, group.world, self.bones, pinned)
        self.held_out = validation_set(config, model, anatomy) if self.leads else []
        step, world = self.state["step"], group.world
        self.origin = run_folder.claim(folder, config, model, anatomy, step, world) if self.leads else []

    @property
    def leads(self) -> bool:
        """True in the process that writes the run's shared files."""
        return self.group.rank == 0

    def go_on(self, minutes: float) -> None:
        """Steps until the schedule ends or `minutes` are over; files on disk are up to date then."""
        begun, earlier = time.monotonic(), self.state["seconds"]
        to_validate, to_save = Interval(self.config.validate_minutes), Interval(self.config.checkpoint_minutes)
        ahead = range(self.state["step"], self.steps)
        if not ahead and self.leads and not self._has_weights():
            self._save()
        progress = tqdm(ahead, initial=ahead.start, total=self.steps, disable=None if self.leads else True, unit="step")
        for step in progress:
            rate = self._set_rate(step)
            parts = self._add_up_gradients(step)
            norm = self._move(step)
            spent = time.monotonic() - begun
            self.state = {"step": step + 1, "seconds": earlier + spent}
            ends = self.group.agree(step + 1 == self.steps or spent > 60.0 * minutes)
            if ends or (step + 1) % self.config.log_steps == 0:
                losses = self.group.mean(run_folder.mean_losses(parts))
                progress.set_postfix({name: losses[name] for name in ("loss", "coarse", "fine")})
                if self.leads:
                    row = run_folder.log_row(self.state, self.config, {"rate": rate, "norm": norm, **losses})
                    run_folder.append(self.folder / "log.csv", row)
                    if ends or to_validate.is_over():
                        self._validate()
            if ends:
                self.drawn.write()
                self.group.wait()  # the header of the weights counts the subjects of all processes
            if ends or to_save.is_over():
                self._save()
            if ends:
                break

    def leave(self) -> None:
        """Delete the processes' shared files, once the schedule has ended."""
        if self.bones and self.leads and self.state["step"] == self.steps:
            shutil.rmtree(self.bones, ignore_errors=True)

    def _set_rate(self, step: int) -> float:
        rate = learning_rate(self.config, step / self.steps)
        for parameters in self.optimizer.param_groups:
            parameters["lr"] = rate
        return rate

    def _add_up_gradients(self, step: int) -> list[Losses]:
        """Back through this process's micro-batches of a step; returns their losses."""
        parts = []
        for part in range(self.per_step):
            # the number of the micro-batch, however many processes there are
            number = (step * self.per_step + part) * self.group.world + self.group.rank
            generator = torch.Generator().manual_seed(self.config.seed + 7919 * number)
            pairs = next(self.batches)
            self.drawn.add(pairs.subjects)
            with distributed.without_sync(self.learner, part + 1 < self.per_step):
                losses = self.learner(pairs.to(self.group.device), generator)
                (losses.total / self.per_step).backward()
            parts.append(losses)
        return parts

    def _move(self, step: int) -> float:
        """Change the weights, unless a gradient is not finite, and the averaged ones; returns the gradients' norm.

        Raises:
            FloatingPointError: that happens again and again.
        """
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip, foreach=True)
        self.lost = 0 if torch.isfinite(norm) else self.lost + 1
        if self.lost == MOST_LOST:
            raise FloatingPointError(f"{self.lost} steps in a row, up to {step + 1}, had gradients that are not finite")
        if not self.lost:
            self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        average(self.ema, self.network, min(self.config.ema, (1 + step) / (10 + step)))
        return float(norm)

    def _validate(self) -> None:
        run_folder.report(self.folder, self.ema, self.held_out, self.state, self.config, self.group.device)
        run_folder.draw_curves(self.folder)

    def _has_weights(self) -> bool:
        """Tell whether whole weights of this step are on disk: a run can die between checkpoint and weights."""
        try:
            return bool(weights.load(self.weights)[1]["step"] == self.state["step"])
        except WeightsError:
            return False

    def _save(self) -> None:
        self.drawn.write()
        if not self.leads:
            return
        save_checkpoint(self.checkpoint, self.network, self.ema, self.optimizer, self.state)
        header = {**self.card, "run": self.config.to_dict(), **self.state, "provenance": self.origin}
        weights.save(self.ema, self.weights, header | {"subjects": self.drawn.count()})
        if self.bones:
            prune(self.bones, self.config, self.state["step"] * self.config.batch)


class Learner(nn.Module):
    """The network with its losses: what a training pass calls, in bfloat16 where asked for."""

    def __init__(self, network: GAPRNet, config: TrainConfig) -> None:
        super().__init__()
        self.network, self.config = network, config

    def forward(self, pair: TrainingPair, generator: torch.Generator) -> Losses:
        """Compute the losses of one micro-batch."""
        with torch.autocast(pair.T.device.type, torch.bfloat16, enabled=self.config.precision == "bfloat16"):
            return compute_losses(self.network, pair, generator, self.config.early_loss)[0]


class Interval:
    """So many minutes, again and again."""

    def __init__(self, minutes: float) -> None:
        self.minutes, self.begun = minutes, time.monotonic()

    def is_over(self) -> bool:
        """True once they have passed; the next ones begin then."""
        now = time.monotonic()
        over = now - self.begun > 60.0 * self.minutes
        if over:
            self.begun = now
        return over


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
