"""Graph convolution (Huang et al., Predator, CVPR 2021): EdgeConv over nearest neighbours instead of attention.

x' = max_j lrelu(norm(W [x_i, x_j - x_i])), twice, and the three states concatenated; the graph is in space.
W [x_i, x_j - x_i] = (W_a - W_b) x_i + W_b x_j: both products are taken before the neighbours are gathered.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from gapr_core.model.config import ModelConfig
from gapr_core.model.pairs import Pairs

NEIGHBORS = 10


class EdgeConv(nn.Module):
    """One EdgeConv (Wang et al., DGCNN 2019), max over the neighbours."""

    def __init__(self, width_in: int, width: int) -> None:
        super().__init__()
        self.own, self.other = nn.Linear(width_in, width, bias=False), nn.Linear(width_in, width, bias=False)
        self.norm = nn.LayerNorm(width)

    def forward(self, x_q: Tensor, x_s: Tensor, pairs: Pairs) -> Tensor:
        near = pairs.keys(self.other(x_s))[:, None]  # (B, 1, m, C)
        own = pairs.queries(self.own(x_q))[:, :, None]  # (B, n, 1, C)
        column = pairs.nearest(NEIGHBORS)
        exists = pairs.valid.expand(-1, column.shape[1], -1).gather(2, column)
        near = near.expand(-1, column.shape[1], -1, -1).gather(2, column[..., None].expand(-1, -1, -1, near.shape[-1]))
        edges = nn.functional.leaky_relu(self.norm(own + near), 0.2)
        pooled = edges.masked_fill(~exists[..., None], float("-inf")).amax(2)
        return pairs.restore(torch.where(pooled.isinf(), own[:, :, 0], pooled))


class GraphLayer(nn.Module):
    """Predator's self-update: two EdgeConvs and a linear layer over all three states."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.first, self.second = EdgeConv(dim, dim), EdgeConv(dim, 2 * dim)
        self.out = nn.Sequential(nn.Linear(4 * dim, dim), nn.LayerNorm(dim), nn.LeakyReLU(0.2))

    def forward(self, x_q: Tensor, x_s: Tensor, pairs: Pairs) -> Tensor:
        first = self.first(x_q, x_s, pairs)
        support = first if pairs.same else x_s
        return self.out(torch.cat([x_q, first, self.second(first, support, pairs)], dim=-1))


def layer(dim: int, config: ModelConfig) -> nn.Module:
    """Predator's graph convolution."""
    return GraphLayer(dim)
