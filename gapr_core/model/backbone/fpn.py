"""The encoder-decoder shared by source and target (paper, section IV and Fig. 2)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from gapr_core.model.backbone.inputs import INPUTS
from gapr_core.model.backbone.kpconv import KPConvBlock
from gapr_core.model.backbone.local_attention import AttentionBlock
from gapr_core.model.config import ModelConfig, choose
from gapr_core.model.layers import Unary
from gapr_core.model.pairs import LocalPairs
from gapr_core.model.types import Cloud, Features

# what brings features to a stage, and what refines them there
STAGES: dict[str, tuple[type[nn.Module], type[nn.Module]]] = {
    "kpconv": (KPConvBlock, KPConvBlock),
    "pga": (AttentionBlock, AttentionBlock),
    "kpconv+pga": (KPConvBlock, AttentionBlock),
}


class Backbone(nn.Module):
    """Features of the fine points and of the superpoints.

    Shapes, for the default widths:
        level 0 (N0, C_in) -> (N0, 32); level 1 (N1, 64); level 2 (N2, 128); level 3 (S, 256) = superpoints
        decoder: (S, 256) up to (N2, 128), (N1, 64), (N0, 64) = fine
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        bring, refine = choose("backbone", STAGES, config.backbone)
        self.inputs, fixed, for_each_stage = choose("inputs", INPUTS, config.inputs)
        width_in, widths = fixed + for_each_stage * config.stages, config.stage_widths
        self.bring = nn.ModuleList(bring(i, o, config) for i, o in zip((width_in, *widths), widths, strict=False))
        self.refine = nn.ModuleList(refine(width, width, config) for width in widths)
        self.fine_stage, self.fine_width = config.fine_stage, 2 * config.width
        self.decoder = nn.ModuleList()
        width = widths[-1]
        for stage in range(config.stages - 2, config.fine_stage, -1):
            self.decoder.append(Unary(width + widths[stage], widths[stage], config.norm))
            width = widths[stage]
        self.last = nn.Linear(width + widths[config.fine_stage], self.fine_width)

    def forward(self, cloud: Cloud) -> Features:
        skips = self.encode(cloud)
        return Features(self.decode(cloud, skips), skips[-1])

    def encode(self, cloud: Cloud) -> list[Tensor]:
        """Features of every level, finest first."""
        x, skips = self.inputs(cloud), []
        finer = cloud.levels[0]
        for level, bring, refine in zip(cloud.levels, self.bring, self.refine, strict=True):
            within = LocalPairs(level, level, level.within)
            from_below = within if level.below is None else LocalPairs(level, finer, level.below)
            x = refine(bring(x, from_below), within)
            skips.append(x)
            finer = level
        return skips

    def decode(self, cloud: Cloud, skips: list[Tensor]) -> Tensor:
        """Superpoint features brought up to the fine level, joined with each level's own."""
        x = skips[-1]
        for stage in range(len(skips) - 2, self.fine_stage - 1, -1):
            up = cloud.levels[stage].up
            assert up is not None
            x = torch.cat([x.index_select(0, up), skips[stage]], dim=-1)
            if stage > self.fine_stage:
                x = self.decoder[len(skips) - 2 - stage](x, cloud.levels[stage].lengths)
        return self.last(x)
