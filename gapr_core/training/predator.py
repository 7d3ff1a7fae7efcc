"""Train Predator by its authors on the pairs, in the batches and with the schedule of a run of `gapr train`.

python -m gapr_core.training.predator --checkout OverlapPredator --anatomy DIR --pairs 3000 --out runs/peer
"""

from __future__ import annotations

import sys

import numpy as np
from torch import Tensor, nn

from gapr_core.benchmark.predator import Checkout
from gapr_core.model.config import ModelConfig
from gapr_core.training import peer
from gapr_core.training.targets import TrainingPair

PARTS = ("circle", "overlap", "saliency")
RECALL, RECENT = 0.3, 25  # saliency is learned where features find so many of their matches, over the last steps


class Lessons:
    """Its own losses, weighted as in its own training: saliency counts once the features are good enough.

    Its authors ask for that after each epoch, on validation pairs; here the last 200 pairs are asked.

    Args:
        code: the authors'.
        sizes: of the network.
    """

    names = ("loss", *(f"{part}_loss" for part in PARTS), "recall")

    def __init__(self, code: Checkout, sizes: ModelConfig) -> None:
        self._code, self._sizes, self._losses = code, sizes, code.losses(sizes)
        self._weights = {part: getattr(code.settings(sizes), f"w_{part}_loss") for part in PARTS}

    def __call__(self, network: nn.Module, pair: TrainingPair, voxel: float, log: peer.Log) -> dict[str, Tensor] | None:
        """None where the clouds do not overlap."""
        batch = self._code.batch(pair.source, pair.target, voxel, self._sizes, pair.T[0])
        if not len(batch["correspondences"]):
            return None
        features, *scores = network(batch)
        count = int(batch["stack_lengths"][0][0])
        clouds = batch["src_pcd_raw"], batch["tgt_pcd_raw"], features[:count], features[count:]
        motion = batch["rot"], batch["trans"]
        found = self._losses(*clouds, batch["correspondences"], *motion, *scores)
        weights = self._weights | ({"saliency": 1.0} if knows_features(log) else {})
        return found | {"loss": sum(weights[part] * found[f"{part}_loss"] for part in PARTS)}


def knows_features(log: peer.Log) -> bool:
    """Tell whether features found enough true matches, on average over the last steps."""
    return len(log) >= RECENT and float(np.nanmean([step["recall"] for step in log[-RECENT:]])) > RECALL


if __name__ == "__main__":
    sys.exit(peer.main(__doc__, Checkout, Lessons))
