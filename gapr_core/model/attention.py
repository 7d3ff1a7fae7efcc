"""The one attention path; everything that tells variants apart is a pair encoding with four hooks."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from gapr_core.model.pairs import Pairs


class PairEncoding:
    """Part of attention that geometry adds. This one adds nothing: vanilla attention is the identity of all four hooks.

    Heads are blocks of channels: `blocks` are (B, n, H, C) queries or values, of which head h owns the h-th block of
    channels and the rest is zero (queries) or ignored (values).
    """

    def query(self, q: Tensor) -> Tensor:
        """(B, n, C) projected queries."""
        return q

    def key(self, k: Tensor) -> Tensor:
        """(B, m, C) projected keys."""
        return k

    def bias(self, logits: Tensor, blocks: Tensor) -> Tensor:
        """(B, n, H, m) products of queries and keys, before the scale; `blocks` are the queries."""
        return logits

    def values(self, blocks: Tensor, weights: Tensor) -> Tensor:
        """(B, n, H, C) sums of values under `weights` (B, n, H, m)."""
        return blocks


class VanillaEncoder(nn.Module):
    """No geometry (Vaswani et al. 2017)."""

    def forward(self, pairs: Pairs) -> PairEncoding:
        return PairEncoding()


class FusedEncoder(nn.Module):
    """An encoder whose attention has a shorter way than by the four hooks, where it fits; both say the same."""

    def fits(self, pairs: Pairs, x: Tensor) -> bool:
        """Tell whether the fused way takes these pairs and features."""
        raise NotImplementedError

    def attend(self, q: Tensor, k: Tensor, v: Tensor, pairs: Pairs, heads: int) -> Tensor:
        """Return attention's context of projected queries, keys and values, in the layout of `pairs`."""
        raise NotImplementedError


class Attention(nn.Module):
    """Multi-head attention over pairs, eq. (1) to (5), Fig. 4.

    The heads are kept as a block-diagonal query, so that local attention (many tiny problems) and global attention
    (few large ones) are the same three batched products, without any permuted copy.
    """

    heads_of: Tensor

    def __init__(self, dim: int, heads: int, encoder: nn.Module, mlp: bool = False) -> None:
        super().__init__()
        self.dim, self.heads, self.encoder = dim, heads, encoder
        self.scale = (dim // heads) ** -0.5
        self.query = _projection(dim, dim, mlp)  # f_q W^Q
        self.key = _projection(dim, dim, mlp)  # f_k W^K
        self.value = _projection(dim, dim, mlp)  # f_v W^V
        owner = torch.arange(dim) // (dim // heads)
        self.register_buffer("heads_of", (owner == torch.arange(heads)[:, None]).float(), persistent=False)

    def forward(self, x_q: Tensor, x_s: Tensor, pairs: Pairs) -> Tensor:
        """Queries of x_q look at keys and values of x_s; both in the layout of `pairs`."""
        if isinstance(self.encoder, FusedEncoder) and self.encoder.fits(pairs, x_q):
            return self.encoder.attend(self.query(x_q), self.key(x_s), self.value(x_s), pairs, self.heads)
        encoding = self.encoder(pairs)
        q = encoding.query(pairs.queries(self.query(x_q)))
        k, v = pairs.keys(torch.cat([self.key(x_s), self.value(x_s)], dim=-1)).split(self.dim, dim=-1)
        blocks = q[:, :, None] * self.heads_of.to(q.dtype)  # (B, n, H, C)
        batch, n = q.shape[:2]
        logits = (blocks.flatten(1, 2) @ encoding.key(k).transpose(1, 2)).view(batch, n, self.heads, -1)
        logits = encoding.bias(logits, blocks) * self.scale  # in the softmax of eq. (2), (4), (5)
        weights = torch.softmax(logits.masked_fill(~pairs.valid[:, :, None], float("-inf")), dim=-1)
        out = (weights.flatten(1, 2) @ v).view(batch, n, self.heads, self.dim)  # eq. (1), (3)
        out = encoding.values(out, weights).view(batch, n, self.heads, self.heads, -1)
        return pairs.restore(out.diagonal(dim1=2, dim2=3).transpose(2, 3).reshape(batch, n, self.dim))


class TransformerLayer(nn.Module):
    """Attention and feed-forward network, each with a residual and a norm after it (GeoTransformer's arrangement)."""

    def __init__(self, dim: int, heads: int, encoder: nn.Module, mlp: bool = False) -> None:
        super().__init__()
        self.attention = Attention(dim, heads, encoder, mlp)
        self.out = nn.Linear(dim, dim)
        self.feed_forward = nn.Sequential(nn.Linear(dim, 2 * dim), nn.ReLU(), nn.Linear(2 * dim, dim))
        self.norm_attention, self.norm_out = nn.LayerNorm(dim), nn.LayerNorm(dim)

    def forward(self, x_q: Tensor, x_s: Tensor, pairs: Pairs) -> Tensor:
        """Features of the queries, from x_q and of what they look at, x_s; all in the layout of `pairs`."""
        x = self.norm_attention(x_q + self.out(self.attention(x_q, x_s, pairs)))
        return self.norm_out(x + self.feed_forward(x))


def _projection(width_in: int, width: int, mlp: bool) -> nn.Module:
    """Build W of the equations, behind the paper's MLP of the point's feature if configured."""
    if not mlp:
        return nn.Linear(width_in, width)
    return nn.Sequential(nn.Linear(width_in, width), nn.ReLU(), nn.Linear(width, width))
