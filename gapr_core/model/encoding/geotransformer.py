"""Geometric structure embedding (Qin et al., CVPR 2022): pair-wise distances and triplet-wise angles, sinusoidal.

r_ij = d_ij W^D + max_x a_ijx W^A over the three nearest neighbours x of i, with angles between x - i and j - i.
The paper's sigma_d is an absolute length; here it is the reach of a neighbourhood over 5, so that it follows the
target's voxel; sigma_a is 15 degrees. Only in the keys, as there.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from gapr_core.model.attention import PairEncoding, TransformerLayer
from gapr_core.model.config import ModelConfig
from gapr_core.model.encoding.relative import RelativeEncoder
from gapr_core.model.pairs import Pairs

SIGMA_ANGLE = math.radians(15.0)
SIGMA_DISTANCE = 0.2
NEIGHBORS = 3


class GeometricEncoder(nn.Module):
    """Distances and angles of pairs."""

    frequency: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.distance, self.angle = nn.Linear(dim, dim), nn.Linear(dim, dim)
        self.relative = RelativeEncoder(dim, dim, in_values=False)
        frequency = torch.exp(torch.arange(0, dim, 2) * (-math.log(10000.0) / dim))
        self.register_buffer("frequency", frequency, persistent=False)

    def forward(self, pairs: Pairs) -> PairEncoding:
        distance = torch.linalg.vector_norm(pairs.offset, dim=-1) / (SIGMA_DISTANCE * pairs.reach)
        ranks = range(min(NEIGHBORS, pairs.offset.shape[2] - 1))
        angles = [_angles(pairs, rank) for rank in ranks] or [torch.zeros_like(distance)]
        embedded = torch.stack([self.angle(self._sinusoid(a / SIGMA_ANGLE)) for a in angles]).amax(0)
        return self.relative(self.distance(self._sinusoid(distance)) + embedded)

    def _sinusoid(self, value: Tensor) -> Tensor:
        phase = value[..., None] * self.frequency
        return torch.cat([phase.sin(), phase.cos()], dim=-1)


def _angles(pairs: Pairs, rank: int) -> Tensor:
    """(B, n, m) angle at i between its neighbour of this rank and j, rad."""
    column = pairs.nearest(NEIGHBORS)[..., rank, None, None].expand(*pairs.offset.shape[:2], 1, 3)
    towards = pairs.offset.gather(2, column).expand_as(pairs.offset)
    cross = torch.linalg.vector_norm(torch.linalg.cross(towards, pairs.offset), dim=-1)
    return torch.atan2(cross, (towards * pairs.offset).sum(-1))


def layer(dim: int, config: ModelConfig) -> nn.Module:
    """GeoTransformer's self-attention."""
    return TransformerLayer(dim, config.heads, GeometricEncoder(dim), config.mlp_projections)
