"""Who looks at whom: pairs (i, j) of attention and convolution, with their geometry, local or dense.

Attention sees tensors (B, n, C) of n queries and (B, m, C) of m keys. Local pairs put every point into its own batch
entry with one query and K neighbours; dense pairs keep clouds as batch entries, padded and masked.
"""

from __future__ import annotations

from functools import cached_property

import torch
from torch import Tensor

from gapr_core.model import pgf
from gapr_core.model.types import Level, Neighborhood


class Pairs:
    """Geometry of pairs, broadcast over (B, n, m).

    Attributes:
        p_i, n_i: (B, n, 1, 3) queries and their normals.
        p_j, n_j: (B, 1, m, 3) keys and their normals.
        c_h, c_k: (B, n or 1, 1, 3) centroids of the larger and of the smaller ball.
        radius: (B, n, 1) of the larger ball.
        reach: (B, n, 1) of a neighbourhood at this resolution.
        valid: (B, 1, m) bool, keys that exist.
        same: queries and keys are the same points.
    """

    p_i: Tensor
    n_i: Tensor
    p_j: Tensor
    n_j: Tensor
    c_h: Tensor
    c_k: Tensor
    radius: Tensor
    reach: Tensor
    valid: Tensor
    same: bool = False

    @cached_property
    def pgf(self) -> Tensor:
        """(B, n, m, 11) embedded PGF; shared by all layers that look at these pairs."""
        with torch.no_grad():
            return pgf.embed(self.p_i, self.p_j, self.c_h, self.c_k, self.radius[..., None])

    @cached_property
    def offset(self) -> Tensor:
        """(B, n, m, 3) from query to key."""
        return self.p_j - self.p_i

    @cached_property
    def distance(self) -> Tensor:
        """(B, n, m); infinite for keys that do not exist."""
        return torch.linalg.vector_norm(self.offset, dim=-1).masked_fill(~self.valid, float("inf"))

    def nearest(self, count: int) -> Tensor:
        """(B, n, count) columns of the nearest keys, nearest first; the query itself, where it is one, is left out."""
        keys, skipped = self.distance.shape[-1], int(self.same)
        columns = self.distance.topk(min(count + skipped, keys), largest=False).indices
        return columns[..., skipped:] if keys > skipped else columns

    def table(self) -> tuple[Tensor, Tensor]:
        """Gather each query's rows (B n, m) of keys (B m, C) or (M, C), with a mask."""
        raise NotImplementedError

    def queries(self, x: Tensor) -> Tensor:
        """Features of the query points, in the layout of the pairs, as (B, n, C)."""
        raise NotImplementedError

    def keys(self, x: Tensor) -> Tensor:
        """Features of the support points as (B, m, C)."""
        raise NotImplementedError

    def restore(self, x: Tensor) -> Tensor:
        """(B, n, C) back to the layout of the query points."""
        raise NotImplementedError


class LocalPairs(Pairs):
    """Every point of `centres` and its neighbours in `support`; features are (N, C), clouds one after the other."""

    def __init__(self, centres: Level, support: Level, hood: Neighborhood, index: Tensor | None = None) -> None:
        self.centres, self.support, self.hood = centres, support, hood
        self.index = hood.index if index is None else index
        self.same = centres is support
        self.valid = hood.valid[:, None] if index is None else torch.ones_like(index, dtype=torch.bool)[:, None]
        self.p_i, self.n_i = centres.points[:, None, None], centres.normals[:, None, None]
        self.c_h, self.c_k = hood.c_h[:, None, None], hood.c_k[:, None, None]
        self.radius = self.reach = hood.radius[:, None, None]

    @cached_property
    def p_j(self) -> Tensor:  # type: ignore[override]
        """(N, 1, K, 3)."""
        return self.keys(self.support.points)[:, None]

    @cached_property
    def n_j(self) -> Tensor:  # type: ignore[override]
        """(N, 1, K, 3)."""
        return self.keys(self.support.normals)[:, None]

    def table(self) -> tuple[Tensor, Tensor]:
        return self.index, self.valid[:, 0]

    def queries(self, x: Tensor) -> Tensor:
        return x[:, None]

    def keys(self, x: Tensor) -> Tensor:
        return gather(x, self.index)

    def restore(self, x: Tensor) -> Tensor:
        return x[:, 0]

    def at_centres(self, x: Tensor) -> Tensor:
        """Features (M, C) of the support, at the centres: the mean over the points that are nearest to each centre.

        Taking the nearest point instead would toss a coin wherever a voxel held two points.
        """
        if self.same or self.support.up is None:
            return x
        zeros = x.new_zeros(len(self.centres.points), x.shape[1])
        count = zeros[:, :1].index_add(0, self.support.up, torch.ones_like(x[:, :1]))
        return zeros.index_add(0, self.support.up, x) / count.clamp(min=1.0)

    def regroup(self, index: Tensor) -> LocalPairs:
        """Pair the same centres with other support points, (N, K)."""
        return LocalPairs(self.centres, self.support, self.hood, index)


class DensePairs(Pairs):
    """All points of one cloud and all of another (or the same): features are (B, n, C), padded.

    Args:
        points_i, normals_i: (B, n, 3).
        points_j, normals_j, valid_j: (B, m, 3), (B, m, 3), (B, m).
        c_h, c_k: (B, n or 1, 3).
        reach: (B,) radius of a neighbourhood at the bottleneck. The larger ball is the whole cloud: radius 1.
    """

    def __init__(
        self,
        points_i: Tensor,
        normals_i: Tensor,
        points_j: Tensor,
        normals_j: Tensor,
        valid_j: Tensor,
        c_h: Tensor,
        c_k: Tensor,
        reach: Tensor,
    ) -> None:
        self.p_i, self.n_i = points_i[:, :, None], normals_i[:, :, None]
        self.p_j, self.n_j = points_j[:, None], normals_j[:, None]
        self.c_h, self.c_k = c_h[:, :, None], c_k[:, :, None]
        self.valid, self.reach = valid_j[:, None], reach[:, None, None]
        self.radius = torch.ones_like(self.reach)

    def table(self) -> tuple[Tensor, Tensor]:
        batch, _, keys = self.valid.shape
        rows = torch.arange(batch * keys, device=self.valid.device).view(batch, 1, keys)
        each = batch, self.p_i.shape[1], keys
        return rows.expand(each).flatten(0, 1), self.valid.expand(each).flatten(0, 1)

    def queries(self, x: Tensor) -> Tensor:
        return x

    def keys(self, x: Tensor) -> Tensor:
        return x

    def restore(self, x: Tensor) -> Tensor:
        return x


def gather(x: Tensor, index: Tensor) -> Tensor:
    """Rows of x (N, C) at `index` (...): (..., C). A plain index_select: its backward is one index_add."""
    return x.index_select(0, index.reshape(-1)).view(*index.shape, x.shape[-1])


def self_pairs(points: Tensor, normals: Tensor, valid: Tensor, c_k: Tensor, reach: Tensor) -> DensePairs:
    """Global self-attention: the larger ball is the whole cloud, so c_h is its centroid (paper, section IV-C)."""
    pairs = DensePairs(points, normals, points, normals, valid, _centroid(points, valid), c_k, reach)
    pairs.same = True
    return pairs


def cross_pairs(
    points_i: Tensor, normals_i: Tensor, points_j: Tensor, normals_j: Tensor, valid_j: Tensor, reach: Tensor
) -> DensePairs:
    """Cross-PGF: c_h is the centroid of the other cloud, c_k the mean of its points near p_i (paper, section IV-C)."""
    c_h = _centroid(points_j, valid_j)
    c_k = pgf.ball_centroids(points_i, points_j, valid_j, reach[:, None, None])
    return DensePairs(points_i, normals_i, points_j, normals_j, valid_j, c_h, c_k, reach)


def _centroid(points: Tensor, valid: Tensor) -> Tensor:
    weight = valid[..., None].to(points.dtype)
    return (points * weight).sum(1, keepdim=True) / weight.sum(1, keepdim=True)
