"""Train GeoTransformer by its authors on the pairs, in the batches and with the schedule of a run of `gapr train`.

python -m gapr_core.training.geotransformer --checkout GeoTransformer --anatomy DIR --pairs 3000 --out runs/peer

Only its network and its losses are its own (`gapr_core.benchmark.geotransformer`); optimiser and schedule are
those of our networks. Call the same line again to go on after a stop; a checkpoint is written every two minutes.
"""

from __future__ import annotations

import csv
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
from gapr_core.training.bone_cache import PooledBone
from gapr_core.training.config import TrainConfig
from gapr_core.training.dataset import TrainingPairs
from gapr_core.training.targets import TrainingPair
from gapr_core.training.trainer import learning_rate

SAVE_S = 120.0


class WithVoxel(TrainingPairs):
    """The pairs of a run, with the first voxel of the last one, in its units."""

    voxel = 0.0

    def _prepare(self, made: Pair, bone: PooledBone) -> TrainingPair:
        self.voxel = bone.frame.voxel
        return super()._prepare(made, bone)


def main() -> None:
    """Train, or go on."""
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--checkout", type=Path, required=True, help="folder of the authors' code")
    parser.add_argument(
        "--config", type=Path, default=Path("config/train_paper.yaml"), help="of the pairs, the schedule and the sizes"
    )
    parser.add_argument("--anatomy", type=Path, help="corresponded meshes with splits.json; else parametric bones")
    parser.add_argument("--pairs", type=int, required=True, help="budget")
    parser.add_argument("--out", type=Path, required=True, help="folder of the run")
    args = parser.parse_args()
    config = replace(TrainConfig.from_yaml(args.config), pairs=args.pairs)
    args.out.mkdir(parents=True, exist_ok=True)
    train(Checkout.at(args.checkout), config, args.anatomy, args.out)


def train(code: Checkout, config: TrainConfig, anatomy: Path | None, folder: Path) -> None:
    """Run until the schedule ends; `folder` gets checkpoint.pt, log.csv and weights.safetensors."""
    torch.manual_seed(config.seed)
    np.random.seed(config.seed)  # its kernels are turned at random
    sizes = config.network()
    network, losses = code.network(sizes), code.losses(sizes)
    optimizer = torch.optim.AdamW(
        network.parameters(), config.learning_rate, betas=(0.9, 0.98), weight_decay=config.weight_decay
    )
    checkpoint, first, left_out = folder / "checkpoint.pt", 0, 0
    if checkpoint.exists():
        state = torch.load(checkpoint, weights_only=True)
        network.load_state_dict(state["network"])
        optimizer.load_state_dict(state["optimizer"])
        first, left_out = state["step"], state["left_out"]
    drawn = WithVoxel(config, geotransformer.thinning(sizes), anatomy)
    steps, saved = config.pairs // config.batch, time.monotonic()
    progress = tqdm(range(first, steps), initial=first, total=steps, unit="step")
    for step in progress:
        for parameters in optimizer.param_groups:
            parameters["lr"] = learning_rate(config, step / steps)
        found = [
            learn(code, network, losses, drawn, step * config.batch + i, config.batch) for i in range(config.batch)
        ]
        used = [losses_of_pair for losses_of_pair in found if losses_of_pair]
        left_out += len(found) - len(used)
        norm = nn.utils.clip_grad_norm_(network.parameters(), config.clip)
        if torch.isfinite(norm):
            optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        row = {key: round(float(np.mean([losses_of[key] for losses_of in used])), 4) for key in used[0]} if used else {}
        progress.set_postfix(row)
        write_row(
            folder / "log.csv", {"step": step + 1, "pairs": (step + 1) * config.batch, "left_out": left_out, **row}
        )
        if time.monotonic() - saved > SAVE_S or step + 1 == steps:
            saved = time.monotonic()
            state = {"network": network.state_dict(), "optimizer": optimizer.state_dict()}
            torch.save(state | {"step": step + 1, "left_out": left_out}, checkpoint)
            card = {"pairs": (step + 1) * config.batch, "left_out": left_out, "run": config.to_dict()}
            geotransformer.save(network, sizes, folder / "weights.safetensors", card)


def learn(
    code: Checkout, network: nn.Module, losses: nn.Module, drawn: WithVoxel, number: int, share: int
) -> dict[str, float]:
    """Add the gradient of one pair, a `share`-th of a step; its losses, none where the network sees no overlap."""
    pair = drawn.pair(number)
    batch = code.batch(pair.source, pair.target, drawn.voxel, pair.T[0])
    with without_cuda():
        output: dict[str, Any] = network(batch)
        if not len(output["gt_node_corr_indices"]):
            return {}
        found = losses(output, batch)
        (found["loss"] / share).backward()
    return {name: float(value.detach()) for name, value in found.items()}


def write_row(path: Path, row: dict[str, Any]) -> None:
    """Append to a table, with its header where it is new."""
    is_new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.writer(file)
        if is_new:
            writer.writerow(row)
        writer.writerow(row.values())


if __name__ == "__main__":
    main()
