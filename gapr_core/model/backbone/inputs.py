"""Features of the points before the first layer."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from gapr_core.model.pairs import gather
from gapr_core.model.types import Cloud, Level


def ones(cloud: Cloud) -> Tensor:
    """(N, 1): the paper's 1."""
    return torch.ones_like(cloud.levels[0].points[:, :1])


def invariant(cloud: Cloud) -> Tensor:
    """(N, 4 x levels + 3): how each point lies to the balls of every scale, and the spread of its own neighbours.

    For each level, seen from the point's nearest ancestor there: distance to c_h and to c_k in radii, height of c_h
    over the tangent plane (signed as far as the side is certain) and its absolute value. None changes under motion.
    """
    with torch.no_grad():
        ancestor = torch.arange(len(cloud.levels[0].points), device=cloud.levels[0].points.device)
        features = [_spread(cloud.levels[0])]
        for level in cloud.levels:
            features.append(_placement(level).index_select(0, ancestor))
            ancestor = ancestor if level.up is None else level.up.index_select(0, ancestor)
        return torch.cat(features, dim=-1)


def _placement(level: Level) -> Tensor:
    radius = level.within.radius[:, None]
    to_h, to_k = (level.within.c_h - level.points) / radius, (level.within.c_k - level.points) / radius
    height = (to_h * level.normals).sum(-1, keepdim=True)
    lengths = [torch.linalg.vector_norm(v, dim=-1, keepdim=True) for v in (to_h, to_k)]
    return torch.cat([*lengths, height * level.certainty[:, None], height.abs()], dim=-1) * 4.0


def _spread(level: Level) -> Tensor:
    """(N, 3): trace, second invariant and determinant of the neighbours' covariance, each to the first power."""
    hood = level.within
    offset = (gather(level.points, hood.index) - hood.c_h[:, None]) / hood.radius[:, None, None] * hood.valid[..., None]
    cov = offset.transpose(1, 2) @ offset / hood.valid.sum(1)[:, None, None]
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = (row.unbind(-1) for row in cov.unbind(-2))
    trace = xx + yy + zz
    second = (xx * yy + yy * zz + zz * xx - xy * xy - yz * yz - xz * xz).clamp(min=0.0)
    determinant = (xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)).clamp(min=0.0)
    return torch.stack([trace, second.sqrt(), determinant ** (1.0 / 3.0)], dim=-1) * 4.0


# the function, its channels, and how many more there are for each stage
INPUTS: dict[str, tuple[Callable[[Cloud], Tensor], int, int]] = {"ones": (ones, 1, 0), "invariant": (invariant, 3, 4)}
