"""Which points of the source are bone: a head on the features of both scales, and the null object that believes all."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from gapr_core.model.config import ModelConfig
from gapr_core.model.types import Cloud


class BelieveAll(nn.Module):
    """No head: every point is bone for sure, so that no score changes."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()

    def forward(self, cloud: Cloud, fine: Tensor, coarse: Tensor) -> Tensor:
        """Logits (N,) of infinity."""
        return fine.new_full((len(fine),), float("inf"), dtype=torch.float32)


class BoneHead(nn.Module):
    """An MLP of a fine point's own features and of its superpoint's, which have seen both clouds.

    The same question as Predator's overlap head (Huang et al., CVPR 2021), asked of the source alone: with soft tissue
    and instruments in the cloud most points are on nothing that the target shows.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        width = 2 * config.width
        self.layers = nn.Sequential(nn.Linear(width + config.global_width, width), nn.ReLU(), nn.Linear(width, 1))

    def forward(self, cloud: Cloud, fine: Tensor, coarse: Tensor) -> Tensor:
        """Logits (N,) of the cloud's fine points, from fine (N, C) and superpoint features (S, C')."""
        return self.layers(torch.cat([fine, coarse.index_select(0, ancestors(cloud))], dim=1))[:, 0].float()


BONE_HEADS: dict[str, type[nn.Module]] = {"none": BelieveAll, "mlp": BoneHead}


def ancestors(cloud: Cloud) -> Tensor:
    """(N,) the superpoint above each fine point: the nearest point of the next level, and so on up."""
    index = torch.arange(len(cloud.fine.points), device=cloud.fine.points.device)
    for level in cloud.levels[cloud.fine_stage : -1]:
        assert level.up is not None
        index = level.up.index_select(0, index)
    return index
