"""Train GeoTransformer by its authors on the pairs, in the batches and with the schedule of a run of `gapr train`.

python -m gapr_core.training.geotransformer --checkout GeoTransformer --anatomy DIR --pairs 3000 --out runs/peer
"""

from __future__ import annotations

import sys

from torch import Tensor, nn

from gapr_core.benchmark.geotransformer import Checkout
from gapr_core.model.config import ModelConfig
from gapr_core.training import peer
from gapr_core.training.targets import TrainingPair


class Lessons:
    """Its own losses: all, coarse, fine.

    Args:
        code: the authors'.
        sizes: of the network.
    """

    names: tuple[str, ...] = ("loss", "c_loss", "f_loss")

    def __init__(self, code: Checkout, sizes: ModelConfig) -> None:
        self._code, self._sizes, self._losses = code, sizes, code.losses(sizes)

    def __call__(self, network: nn.Module, pair: TrainingPair, voxel: float, log: peer.Log) -> dict[str, Tensor] | None:
        """None where the network sees no overlap."""
        batch = self._code.batch(pair.source, pair.target, voxel, self._sizes, pair.T[0])
        output = network(batch)
        return self._losses(output, batch) if len(output["gt_node_corr_indices"]) else None


if __name__ == "__main__":
    sys.exit(peer.main(__doc__, Checkout, Lessons))
