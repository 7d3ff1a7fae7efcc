"""Serialised attention (Wu et al., Point Transformer V3, CVPR 2024): patches along a space-filling curve.

Points are ordered by the z-order code of their voxel, cut into patches, and attend within their patch, without any
relative encoding. In place of the sparse convolution before attention (xCPE) stands its continuous form, a depth-wise
convolution over the neighbours with a learned kernel of the offset, with a skip.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from gapr_core.model.attention import PairEncoding, TransformerLayer, VanillaEncoder
from gapr_core.model.config import ModelConfig
from gapr_core.model.pairs import LocalPairs, Pairs

PATCH = 32
ELSEWHERE = -1e9  # finite: a padded point has no valid partner in its patch, and a row of infinities makes NaN
BITS = 10


def z_order(points: Tensor, cell: Tensor) -> Tensor:
    """Morton code (...,) of points (..., 3) in cells of edge `cell` (broadcast), at most 1024 cells an axis."""
    grid = torch.floor(points / cell[..., None]).long() + 2 ** (BITS - 1)
    grid = grid.clamp(0, 2**BITS - 1)
    code = torch.zeros_like(grid[..., 0])
    for bit in range(BITS):
        for axis in range(3):
            code |= ((grid[..., axis] >> bit) & 1) << (3 * bit + axis)
    return code


def local_patches(pairs: LocalPairs) -> Tensor:
    """(N, PATCH) support points of each centre's stretch of the curve, cloud by cloud."""
    index, start_q, start_s = [], 0, 0
    cell = 0.4 * pairs.hood.radius[0]
    for n_q, n_s in zip(pairs.centres.lengths, pairs.support.lengths, strict=True):
        codes, order = z_order(pairs.support.points[start_s : start_s + n_s], cell).sort(stable=True)
        own = z_order(pairs.centres.points[start_q : start_q + n_q], cell)
        rank = torch.searchsorted(codes, own)
        if pairs.same:
            rank = torch.empty_like(order).scatter_(0, order, torch.arange(n_s, device=order.device))
        first = (rank // PATCH * PATCH).clamp(max=max(n_s - PATCH, 0))
        columns = (first[:, None] + torch.arange(min(PATCH, n_s), device=order.device)).clamp(max=n_s - 1)
        columns = torch.nn.functional.pad(columns, (0, PATCH - columns.shape[1]), mode="replicate")
        index.append(order[columns] + start_s)
        start_q, start_s = start_q + n_q, start_s + n_s
    return torch.cat(index)


class SamePatch(PairEncoding):
    """Nothing outside of the own patch."""

    def __init__(self, same: Tensor) -> None:
        self.same = same

    def bias(self, logits: Tensor, blocks: Tensor) -> Tensor:
        return logits.masked_fill(~self.same[:, :, None], ELSEWHERE)


class SerialEncoder(nn.Module):
    """Dense pairs: same patch or not. Local pairs have been regrouped by patches before."""

    def forward(self, pairs: Pairs) -> PairEncoding:
        if isinstance(pairs, LocalPairs):
            return VanillaEncoder()(pairs)
        code = z_order(pairs.p_j[:, 0], 0.4 * pairs.reach[:, 0])
        code = code.masked_fill(~pairs.valid[:, 0], 2**62)
        patch = code.argsort(stable=True).argsort() // PATCH
        return SamePatch(patch[:, :, None] == patch[:, None])


class OffsetConvolution(nn.Module):
    """x_i + W mean_j k(p_j - p_i) * x_j over the neighbours within reach: depth-wise, in continuous space."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.kernel = nn.Sequential(nn.Linear(3, dim // 2), nn.ReLU(), nn.Linear(dim // 2, dim))
        self.out = nn.Sequential(nn.Linear(dim, dim), nn.LayerNorm(dim))

    def forward(self, x_q: Tensor, x_s: Tensor, pairs: Pairs) -> Tensor:
        near = (pairs.distance <= pairs.reach)[..., None]
        kernel = self.kernel(pairs.offset / pairs.reach[..., None]) * near
        mixed = (kernel * pairs.keys(x_s)[:, None]).sum(2) / near.sum(2).clamp(min=1)
        return x_q + self.out(pairs.restore(mixed))


class SerializedLayer(nn.Module):
    """xCPE, then attention within patches."""

    def __init__(self, dim: int, config: ModelConfig) -> None:
        super().__init__()
        self.position = OffsetConvolution(dim)
        self.transformer = TransformerLayer(dim, config.heads, SerialEncoder(), config.mlp_projections)

    def forward(self, x_q: Tensor, x_s: Tensor, pairs: Pairs) -> Tensor:
        x = self.position(x_q, x_s, pairs)
        if isinstance(pairs, LocalPairs):
            return self.transformer(x, x if pairs.same else x_s, pairs.regroup(local_patches(pairs)))
        return self.transformer(x, x, pairs)


def layer(dim: int, config: ModelConfig) -> nn.Module:
    """Point Transformer V3's layer."""
    return SerializedLayer(dim, config)
