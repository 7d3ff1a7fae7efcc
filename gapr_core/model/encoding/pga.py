"""Point-wise Geometry-aware Attention (paper, section IV-B, Fig. 4): r_ij is an MLP of the PGF l_ij."""

from __future__ import annotations

from torch import nn

from gapr_core.model.attention import PairEncoding, TransformerLayer
from gapr_core.model.config import ModelConfig
from gapr_core.model.encoding.relative import RelativeEncoder
from gapr_core.model.pairs import Pairs
from gapr_core.model.pgf import EMBEDDED


class PGAEncoder(nn.Module):
    """l_ij -> MLP -> r_ij; local, global and cross alike, since `Pairs` brings the right ball centroids."""

    def __init__(self, dim: int, hidden: int, in_values: bool) -> None:
        super().__init__()
        self.first = nn.Sequential(nn.Linear(EMBEDDED, hidden), nn.ReLU(inplace=True))
        self.relative = RelativeEncoder(hidden, dim, in_values)

    def forward(self, pairs: Pairs) -> PairEncoding:
        return self.relative(self.first(pairs.pgf))


def layer(dim: int, config: ModelConfig) -> nn.Module:
    """self-PGA, or cross-PGA when the pairs are across clouds."""
    encoder = PGAEncoder(dim, config.pair_width or dim, config.values_encoded)
    return TransformerLayer(dim, config.heads, encoder, config.mlp_projections)
