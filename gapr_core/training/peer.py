"""Train a network of others on the pairs, in the batches and with the optimiser and the schedule of `gapr train`.

`gapr_core.training.geotransformer` and `predator` are the commands; networks and losses are their own. Call one again
to go on after a stop; a checkpoint is written every two minutes.
"""

from __future__ import annotations

import sys
import time
from argparse import ArgumentParser
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from gapr_core.benchmark import peer
from gapr_core.benchmark.checkout import without_cuda
from gapr_core.benchmark.peer import Checkout
from gapr_core.data.protocols import Pair
from gapr_core.errors import ConfigError, GaprError, InvalidPointCloudError
from gapr_core.model.config import ModelConfig
from gapr_core.runtime import files
from gapr_core.training import run_folder
from gapr_core.training.bone_cache import PooledBone
from gapr_core.training.config import TrainConfig, read_config
from gapr_core.training.dataset import OWN_TARGET, TrainingPairs
from gapr_core.training.targets import TrainingPair
from gapr_core.training.trainer import learning_rate

SAVE_S = 120.0
Log = list[dict[str, float]]


class Lessons(Protocol):
    """Lessons of a network from a pair.

    Attributes:
        names: of what a pair gives and the log keeps; the first is the loss.
    """

    names: tuple[str, ...]

    def __call__(self, network: nn.Module, pair: TrainingPair, voxel: float, log: Log) -> dict[str, Tensor] | None:
        """Return losses by name; None where the pair teaches nothing.

        Args:
            network: the one that learns.
            pair: a single pair.
            voxel: the first voxel in its units.
            log: means of the steps before.

        Raises:
            InvalidPointCloudError: the network needs more points.
        """


Teacher = Callable[[Any, ModelConfig], Lessons]


class WithVoxel(TrainingPairs):
    """The pairs of a run, with the first voxel of the last one, in its units."""

    voxel = 0.0

    def _prepare(self, made: Pair, bone: PooledBone, model: ModelConfig) -> TrainingPair:
        self.voxel = bone.frame.voxel
        return super()._prepare(made, bone, model)


def main(description: str, checkout: type[Checkout], teacher: Teacher) -> int:
    """Train, or go on, as the command line says; 1 for settings without a training."""
    parser = ArgumentParser(description=description.splitlines()[0])
    parser.add_argument("--checkout", type=Path, required=True, help="folder of the authors' code")
    parser.add_argument(
        "--config", type=Path, default=Path("config/ablate_paper.yaml"), help="of the pairs, the schedule and the sizes"
    )
    parser.add_argument("--anatomy", type=Path, help="corresponded meshes with splits.json; else parametric bones")
    parser.add_argument("--pairs", type=int, required=True, help="budget")
    parser.add_argument("--out", type=Path, required=True, help="folder of the run")
    args = parser.parse_args()
    try:
        config = replace(read_config(args.config), pairs=args.pairs)
        code = checkout.at(args.checkout)
        args.out.mkdir(parents=True, exist_ok=True)
        train(code, teacher, config, args.anatomy, args.out)
    except GaprError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


def train(code: Checkout, teacher: Teacher, config: TrainConfig, anatomy: Path | None, folder: Path) -> None:
    """Run until the schedule ends, or go on; the same as a run that was never stopped.

    `folder` gets config.json, provenance.json, checkpoint.pt, log.csv and weights.safetensors.

    Raises:
        ConfigError: a protocol whose target is not the whole bone, of which the first voxel is not known here; a folder
            that holds another run.
    """
    if partial := sorted(set(config.mix) & set(OWN_TARGET)):
        raise ConfigError("protocols with whole targets", ", ".join(partial), "leave it out of `mix`")
    run_folder.check(folder, config, config.network())
    seed(config.seed)
    learner = Learner(code, teacher, config, anatomy)
    checkpoint = folder / "checkpoint.pt"
    if checkpoint.exists():
        learner.go_on(torch.load(checkpoint, weights_only=True))
    run_folder.claim(folder, config, config.network(), anatomy, learner.steps_done, world=1)
    steps, saved = config.pairs // config.batch, time.monotonic()
    progress = tqdm(range(learner.steps_done, steps), initial=learner.steps_done, total=steps, unit="step")
    for step in progress:
        progress.set_postfix(learner.step(learning_rate(config, step / steps)))
        if time.monotonic() - saved > SAVE_S or step + 1 == steps:
            saved = time.monotonic()
            with files.replacing(checkpoint) as new:
                torch.save(learner.state(), new)
            with files.replacing(folder / "weights.safetensors") as new:
                peer.save(code, learner.network, learner.sizes, new, learner.card())
            files.write_text(folder / "log.csv", learner.table())


def seed(number: int) -> None:
    """Seed all draws of the authors' code: turned kernels, and the loss's pairs of points."""
    torch.manual_seed(number)
    np.random.seed(number)


class Learner:
    """The network, what it learns from, and how far it has come.

    Args:
        code: the authors'.
        teacher: makes lessons from it and the sizes.
        config: of the pairs, the schedule and the sizes.
        anatomy: real bones; None for parametric ones.
    """

    def __init__(self, code: Checkout, teacher: Teacher, config: TrainConfig, anatomy: Path | None) -> None:
        self.config, self.sizes, self._name = config, config.network(), code.origin.name
        self.network, self._lessons = code.network(self.sizes), teacher(code, self.sizes)
        self._optimizer = torch.optim.AdamW(
            self.network.parameters(), config.learning_rate, betas=(0.9, 0.98), weight_decay=config.weight_decay
        )
        self._drawn = WithVoxel(config, peer.thinning(self.sizes), anatomy)
        self._log: Log = []
        self._left_out: list[int] = []  # pairs that taught nothing, up to each step

    @property
    def steps_done(self) -> int:
        """Of the schedule."""
        return len(self._log)

    def step(self, rate: float) -> dict[str, float]:
        """Learn from the next pairs; the mean of their losses."""
        for parameters in self._optimizer.param_groups:
            parameters["lr"] = rate
        first = self.steps_done * self.config.batch
        seed(self.config.seed + 1 + self.steps_done)  # of each step, so that a run that goes on draws the same
        found = [self._learn(first + number) for number in range(self.config.batch)]
        used = [losses for losses in found if losses is not None]
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip)
        if torch.isfinite(norm):
            self._optimizer.step()
        self._optimizer.zero_grad(set_to_none=True)
        means = np.mean(used, axis=0).tolist() if used else [np.nan] * len(self._lessons.names)
        self._left_out.append((self._left_out or [0])[-1] + len(found) - len(used))
        self._log.append(dict(zip(self._lessons.names, means, strict=True)))
        return self._log[-1]

    def _learn(self, number: int) -> list[float] | None:
        """Add the gradient of a pair, and return its losses."""
        pair = self._drawn.pair(number)
        with without_cuda():
            try:
                found = self._lessons(self.network, pair, self._drawn.voxel, self._log)
            except InvalidPointCloudError:
                return None
            loss = found[self._lessons.names[0]] if found else torch.tensor(torch.nan)
            if found is None or not torch.isfinite(loss):
                return None
            (loss / self.config.batch).backward()
        return [float(found[name].detach()) for name in self._lessons.names]

    def state(self) -> dict[str, Any]:
        """Return everything `go_on` needs."""
        parts = {"network": self.network.state_dict(), "optimizer": self._optimizer.state_dict()}
        return parts | {"of": self._name, "log": self._log, "left_out": self._left_out}

    def go_on(self, state: dict[str, Any]) -> None:
        """From where a run stopped.

        Raises:
            ConfigError: it trained the network of other authors.
        """
        if state["of"] != self._name:
            raise ConfigError(f"a run of {self._name}", f"one of {state['of']} in this folder", "choose a new folder")
        self.network.load_state_dict(state["network"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._log, self._left_out = state["log"], state["left_out"]

    def card(self) -> dict[str, Any]:
        """Return the data of the weights' training."""
        pairs = self.steps_done * self.config.batch
        return {"pairs": pairs, "left_out": self._left_out[-1], "run": self.config.to_dict()}

    def table(self) -> str:
        """Write the log, one line a step, as CSV."""
        rows = zip(self._left_out, self._log, strict=True)
        lines = (
            ",".join(f"{value:.5g}" for value in (step, step * self.config.batch, left_out, *losses.values()))
            for step, (left_out, losses) in enumerate(rows, 1)
        )
        return "\n".join([",".join(("step", "pairs", "left_out", *self._lessons.names)), *lines, ""])
