"""Global feature aggregation (paper, section IV-C, Fig. 2): three layers of self- and cross-attention."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn
from torch.nn.functional import normalize

from gapr_core.model.config import ModelConfig, choose
from gapr_core.model.encoding import make_transformer
from gapr_core.model.layers import pad, padding_mask
from gapr_core.model.pairs import DensePairs, cross_pairs, self_pairs
from gapr_core.model.repositioning import REPOSITIONING, move
from gapr_core.model.types import Cloud


@dataclass(frozen=True)
class Nodes:
    """Superpoints of a batch, padded: `points`, `normals`, `c_k` (B, n, 3), `reach` (B,), `valid` (B, n)."""

    points: Tensor
    normals: Tensor
    c_k: Tensor
    reach: Tensor
    valid: Tensor

    @classmethod
    def of(cls, cloud: Cloud, small_ball: str = "part") -> Nodes:
        """Take the coarsest level of a cloud; `small_ball` as `global_small_ball` of the configuration."""
        level = cloud.coarse
        inner = level.within.c_h if small_ball == "whole" else level.within.c_k
        points, normals, c_k = (pad(x, level.lengths) for x in (level.points, level.normals, inner))
        reach = pad(level.within.radius, level.lengths)[:, 0]
        return cls(points, normals, c_k, reach, padding_mask(level.lengths, points.device))

    def look_at_self(self) -> DensePairs:
        """Pairs of global self-attention."""
        return self_pairs(self.points, self.normals, self.valid, self.c_k, self.reach)

    def look_at(self, other: Nodes) -> DensePairs:
        """Pairs of cross-attention."""
        return cross_pairs(self.points, self.normals, other.points, other.normals, other.valid, other.reach)

    def moved(self, T: Tensor) -> Nodes:
        """Move the superpoints by (B, 3, 4)."""
        turned = self.normals @ T[:, :, :3].transpose(1, 2)
        return Nodes(move(T, self.points), turned, move(T, self.c_k), self.reach, self.valid)


@dataclass(frozen=True)
class Aggregated:
    """Unit superpoint features (B, n, C) of both clouds, before repositioning (`early_*`) and at the end.

    `T_reposition` (B, 3, 4) took the source to the target, in the clouds' units.
    """

    source: Tensor
    target: Tensor
    source_valid: Tensor
    target_valid: Tensor
    early_source: Tensor
    early_target: Tensor
    T_reposition: Tensor


class GlobalAggregation(nn.Module):
    """Superpoint features that know their own cloud and the other one."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        dim, layers = config.global_width, config.global_layers
        self.enter, self.leave = nn.Linear(config.stage_widths[-1], dim), nn.Linear(dim, dim)
        self.early = nn.Linear(dim, dim) if config.early_features == "projected" else nn.Identity()
        crosses = ["vanilla"] * (layers - 1) + [config.final_cross]
        self.self_layers = nn.ModuleList(make_transformer(config.encoding, dim, config) for _ in range(layers))
        self.cross_layers = nn.ModuleList(make_transformer(name, dim, config) for name in crosses)
        self.small_ball = config.global_small_ball
        self.reposition = choose("repositioning", REPOSITIONING, config.repositioning)(config)

    def forward(self, source: Cloud, target: Cloud, x_p: Tensor, x_q: Tensor) -> Aggregated:
        """Superpoint features (S, C) of both clouds, clouds one after the other, to padded unit features."""
        p, q = Nodes.of(source, self.small_ball), Nodes.of(target, self.small_ball)
        x_p, x_q = self.enter(pad(x_p, source.coarse.lengths)), self.enter(pad(x_q, target.coarse.lengths))
        self_p, self_q, cross_p, cross_q = p.look_at_self(), q.look_at_self(), p.look_at(q), q.look_at(p)
        for self_layer, cross_layer in zip(self.self_layers[:-1], self.cross_layers[:-1], strict=True):
            x_p, x_q = self_layer(x_p, x_p, self_p), self_layer(x_q, x_q, self_q)  # eq. (1), (2)
            x_p, x_q = cross_layer(x_p, x_q, cross_p), cross_layer(x_q, x_p, cross_q)  # eq. (3), (4)
        x_p, x_q = self.self_layers[-1](x_p, x_p, self_p), self.self_layers[-1](x_q, x_q, self_q)
        early_p, early_q = normalize(self.early(x_p), dim=-1), normalize(self.early(x_q), dim=-1)
        T = self.reposition(early_p, early_q, p.points, q.points, p.valid, q.valid)  # T_r
        p = p.moved(T)
        final = self.cross_layers[-1]
        x_p, x_q = final(x_p, x_q, p.look_at(q)), final(x_q, x_p, q.look_at(p))  # eq. (3), (5)
        f_p, f_q = normalize(self.leave(x_p), dim=-1), normalize(self.leave(x_q), dim=-1)
        return Aggregated(f_p, f_q, p.valid, q.valid, early_p, early_q, T)
