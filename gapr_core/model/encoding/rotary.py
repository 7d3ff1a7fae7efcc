"""Rotary encoding of absolute 3-D position (Li and Harada, Lepard, CVPR 2022): the dot product sees p_j - p_i only.

Channels in pairs are turned by angles proportional to x, y and z, a third of them each. Not invariant under rotation:
which is why Lepard repositions before it attends across clouds.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from gapr_core.model.attention import PairEncoding, TransformerLayer
from gapr_core.model.config import ModelConfig
from gapr_core.model.pairs import Pairs


class RotaryEncoding(PairEncoding):
    """Turns queries by their own position and keys by theirs; `turn_*` are (B, n or m, C/2) angles, rad."""

    def __init__(self, turn_i: Tensor, turn_j: Tensor) -> None:
        self.turn_i, self.turn_j = turn_i, turn_j

    def query(self, q: Tensor) -> Tensor:
        return _turn(q, self.turn_i)

    def key(self, k: Tensor) -> Tensor:
        return _turn(k, self.turn_j)


class RotaryEncoder(nn.Module):
    """Angles from positions in units of a quarter of the neighbourhood's reach (Lepard: of a voxel)."""

    frequency: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        each = -(-dim // 6)
        frequency = torch.exp(torch.arange(each) * (-math.log(10000.0) / each))
        self.turns = dim // 2
        self.register_buffer("frequency", frequency, persistent=False)

    def forward(self, pairs: Pairs) -> PairEncoding:
        unit = 0.25 * pairs.reach
        return RotaryEncoding(self._angles(pairs.p_i[:, :, 0] / unit), self._angles(pairs.p_j[:, 0] / unit))

    def _angles(self, position: Tensor) -> Tensor:
        """(B, n, C/2): frequencies of x, y, z interleaved, cut to the channels there are."""
        return (position[..., None, :] * self.frequency[:, None]).flatten(-2)[..., : self.turns]


def _turn(x: Tensor, angle: Tensor) -> Tensor:
    first, second = x[..., 0::2], x[..., 1::2]
    turned = first * angle.cos() - second * angle.sin(), first * angle.sin() + second * angle.cos()
    return torch.stack(turned, dim=-1).flatten(-2)


def layer(dim: int, config: ModelConfig) -> nn.Module:
    """Lepard's attention."""
    return TransformerLayer(dim, config.heads, RotaryEncoder(dim), config.mlp_projections)
