"""Train GeoTransformer by its authors on the pairs, in the batches and with the schedule of a run of `gapr train`.

python -m gapr_core.training.geotransformer --checkout GeoTransformer --anatomy DIR --pairs 3000 --out runs/peer

Only its network and its losses are its own (`gapr_core.benchmark.geotransformer`); optimiser and schedule are
those of our networks. Call the same line again to go on after a stop; a checkpoint is written every two minutes.
"""

from __future__ import annotations

import sys
import time
from argparse import ArgumentParser
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from tqdm import tqdm

from gapr_core.benchmark import geotransformer
from gapr_core.benchmark.geotransformer import Checkout, without_cuda
from gapr_core.data.protocols import Pair
from gapr_core.errors import ConfigError, GaprError, InvalidPointCloudError
from gapr_core.runtime import files
from gapr_core.training.bone_cache import PooledBone
from gapr_core.training.config import TrainConfig
from gapr_core.training.dataset import OWN_TARGET, TrainingPairs
from gapr_core.training.targets import TrainingPair
from gapr_core.training.trainer import learning_rate

SAVE_S = 120.0
LOSSES = ("loss", "c_loss", "f_loss")  # by their names in its code: all, coarse, fine


class WithVoxel(TrainingPairs):
    """The pairs of a run, with the first voxel of the last one, in its units."""

    voxel = 0.0

    def _prepare(self, made: Pair, bone: PooledBone) -> TrainingPair:
        self.voxel = bone.frame.voxel
        return super()._prepare(made, bone)


def main() -> int:
    """Train, or go on; 1 for what cannot be trained with."""
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--checkout", type=Path, required=True, help="folder of the authors' code")
    parser.add_argument(
        "--config", type=Path, default=Path("config/train_paper.yaml"), help="of the pairs, the schedule and the sizes"
    )
    parser.add_argument("--anatomy", type=Path, help="corresponded meshes with splits.json; else parametric bones")
    parser.add_argument("--pairs", type=int, required=True, help="budget")
    parser.add_argument("--out", type=Path, required=True, help="folder of the run")
    args = parser.parse_args()
    try:
        config = replace(TrainConfig.from_yaml(args.config), pairs=args.pairs)
        args.out.mkdir(parents=True, exist_ok=True)
        train(Checkout.at(args.checkout), config, args.anatomy, args.out)
    except GaprError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


def train(code: Checkout, config: TrainConfig, anatomy: Path | None, folder: Path) -> None:
    """Run until the schedule ends; `folder` gets checkpoint.pt, log.csv and weights.safetensors.

    Raises:
        ConfigError: a protocol whose target is not the whole bone, of which the first voxel is not known here.
    """
    if partial := sorted(set(config.mix) & set(OWN_TARGET)):
        raise ConfigError("protocols with whole targets", ", ".join(partial), "leave it out of `mix`")
    torch.manual_seed(config.seed)
    np.random.seed(config.seed)  # its kernels are turned at random
    learner = Learner(code, config, anatomy)
    checkpoint = folder / "checkpoint.pt"
    if checkpoint.exists():
        learner.go_on(torch.load(checkpoint, weights_only=True))
    steps, saved = config.pairs // config.batch, time.monotonic()
    progress = tqdm(range(learner.steps_done, steps), initial=learner.steps_done, total=steps, unit="step")
    for step in progress:
        progress.set_postfix(learner.step(learning_rate(config, step / steps)))
        if time.monotonic() - saved > SAVE_S or step + 1 == steps:
            saved = time.monotonic()
            with files.replacing(checkpoint) as new:
                torch.save(learner.state(), new)
            with files.replacing(folder / "weights.safetensors") as new:
                geotransformer.save(learner.network, learner.sizes, new, learner.card())
            files.write_text(folder / "log.csv", learner.log())


class Learner:
    """The network, what it learns from, and how far it has come.

    Args:
        code: the authors'.
        config: of the pairs, the schedule and the sizes.
        anatomy: real bones; None for parametric ones.
    """

    def __init__(self, code: Checkout, config: TrainConfig, anatomy: Path | None) -> None:
        self.code, self.config, self.sizes = code, config, config.network()
        self.network, self._losses = code.network(self.sizes), code.losses(self.sizes)
        self._optimizer = torch.optim.AdamW(
            self.network.parameters(), config.learning_rate, betas=(0.9, 0.98), weight_decay=config.weight_decay
        )
        self._drawn = WithVoxel(config, geotransformer.thinning(self.sizes), anatomy)
        self._rows: list[list[float]] = []  # of the log
        self.left_out = 0  # pairs in which the network sees no overlap, or too few points

    @property
    def steps_done(self) -> int:
        """Of the schedule."""
        return len(self._rows)

    def step(self, rate: float) -> dict[str, float]:
        """Learn from the next pairs; the mean of their losses."""
        for parameters in self._optimizer.param_groups:
            parameters["lr"] = rate
        first = self.steps_done * self.config.batch
        found = [self._learn(first + number) for number in range(self.config.batch)]
        used = [losses for losses in found if losses is not None]
        self.left_out += len(found) - len(used)
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip)
        if torch.isfinite(norm):
            self._optimizer.step()
        self._optimizer.zero_grad(set_to_none=True)
        means = np.mean(used, axis=0).tolist() if used else [np.nan] * len(LOSSES)
        self._rows.append([self.left_out, *means])
        return dict(zip(LOSSES, means, strict=True))

    def _learn(self, number: int) -> list[float] | None:
        """Add the gradient of a pair, and return its losses."""
        pair = self._drawn.pair(number)
        try:
            batch = self.code.batch(pair.source, pair.target, self._drawn.voxel, self.sizes.patch_size, pair.T[0])
        except InvalidPointCloudError:
            return None
        with without_cuda():
            output: dict[str, Any] = self.network(batch)
            if not len(output["gt_node_corr_indices"]):
                return None
            found = self._losses(output, batch)
            (found["loss"] / self.config.batch).backward()
        return [float(found[name].detach()) for name in LOSSES]

    def state(self) -> dict[str, Any]:
        """What `go_on` needs."""
        parts = {"network": self.network.state_dict(), "optimizer": self._optimizer.state_dict()}
        return parts | {"rows": self._rows, "left_out": self.left_out}

    def go_on(self, state: dict[str, Any]) -> None:
        """From where a run stopped."""
        self.network.load_state_dict(state["network"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._rows, self.left_out = state["rows"], state["left_out"]

    def card(self) -> dict[str, Any]:
        """What the weights were trained on."""
        pairs = self.steps_done * self.config.batch
        return {"pairs": pairs, "left_out": self.left_out, "run": self.config.to_dict()}

    def log(self) -> str:
        """One line a step, as CSV."""
        lines = (
            ",".join(f"{value:.5g}" for value in (step, step * self.config.batch, *row))
            for step, row in enumerate(self._rows, 1)
        )
        return "\n".join([",".join(("step", "pairs", "left_out", *LOSSES)), *lines, ""])


if __name__ == "__main__":
    sys.exit(main())
