"""Local self-attention of an encoder stage (paper, section IV-B): over the neighbours that KPConv uses."""

from __future__ import annotations

from torch import Tensor, nn

from gapr_core.model.config import ModelConfig
from gapr_core.model.encoding import make_transformer
from gapr_core.model.pairs import LocalPairs


class AttentionBlock(nn.Module):
    """A transformer layer on neighbourhoods, (M, C_in) at the support to (N, C_out) at the centres.

    The support is the next finer level (table IV, "PGA only") or the level itself.
    """

    def __init__(self, width_in: int, width: int, config: ModelConfig) -> None:
        super().__init__()
        self.enter = nn.Linear(width_in, width) if width_in != width else nn.Identity()
        self.layer = make_transformer(config.encoding, width, config)

    def forward(self, x: Tensor, pairs: LocalPairs) -> Tensor:
        x = self.enter(x)
        return self.layer(pairs.at_centres(x), x, pairs)
