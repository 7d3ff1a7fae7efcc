"""PPF attention (Yu et al., RoITr, CVPR 2023): point-pair features as pose-agnostic coordinates in keys and values.

PPF(i, j) = (|d|, angle(n_i, d), angle(n_j, d), angle(n_i, n_j)). Signs of normals that points alone cannot tell make
its angles ambiguous on thin plates; that is this variant's own weakness, kept.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from gapr_core.model.attention import PairEncoding, TransformerLayer
from gapr_core.model.config import ModelConfig
from gapr_core.model.encoding.relative import RelativeEncoder
from gapr_core.model.pairs import Pairs


def point_pair_features(pairs: Pairs) -> Tensor:
    """(B, n, m, 4): distance in units of the neighbourhood's reach, and three angles in [0, pi] rad."""
    d = pairs.offset
    n_i, n_j = pairs.n_i.expand_as(d), pairs.n_j.expand_as(d)
    length = torch.linalg.vector_norm(d, dim=-1) / pairs.reach
    return torch.stack([length, _angle(n_i, d), _angle(n_j, d), _angle(n_i, n_j)], dim=-1)


def _angle(a: Tensor, b: Tensor) -> Tensor:
    return torch.atan2(torch.linalg.vector_norm(torch.linalg.cross(a, b), dim=-1), (a * b).sum(-1))


class PPFEncoder(nn.Module):
    """PPF of every pair through an MLP, added to keys and values."""

    def __init__(self, dim: int, hidden: int) -> None:
        super().__init__()
        self.first = nn.Sequential(nn.Linear(4, hidden), nn.ReLU(inplace=True))
        self.relative = RelativeEncoder(hidden, dim, in_values=True)

    def forward(self, pairs: Pairs) -> PairEncoding:
        return self.relative(self.first(point_pair_features(pairs)))


def layer(dim: int, config: ModelConfig) -> nn.Module:
    """RoITr's PPF attention."""
    return TransformerLayer(dim, config.heads, PPFEncoder(dim, config.pair_width or dim), config.mlp_projections)
