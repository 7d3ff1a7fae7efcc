"""Data of the network: clouds with their pyramid, and matches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass, replace
from itertools import accumulate
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

T = TypeVar("T")


@dataclass(frozen=True)
class Neighborhood:
    """For each of N centres, up to K points of a support cloud, nearest first.

    Attributes:
        index: (N, K) int64 rows of the support; missing ones point at row 0 of their cloud.
        valid: (N, K) bool.
        c_h: (N, 3) centroid of the ball (paper, section IV-A).
        c_k: (N, 3) centroid of the smaller ball.
        radius: (N,) radius of the ball.
    """

    index: Tensor
    valid: Tensor
    c_h: Tensor
    c_k: Tensor
    radius: Tensor

    def turned(self, R: Tensor) -> Neighborhood:
        """Turn the neighbours by R (3, 3)."""
        return replace(self, c_h=self.c_h @ R.T, c_k=self.c_k @ R.T)


@dataclass(frozen=True)
class Level:
    """One resolution of a cloud, or of several clouds one after the other.

    Attributes:
        points: (N, 3) in units of the target's half extent, centred on the cloud's own mean.
        normals: (N, 3) unit, away from the bone's inside as far as the points tell.
        certainty: (N,) 0 to 1, how surely they point outward; near 0 on thin plates, where points alone do not tell.
        lengths: points of each cloud.
        within: neighbours in this level.
        below: neighbours in the finer level; None at the finest.
        up: (N,) nearest point of the next coarser level; None at the coarsest.
    """

    points: Tensor
    normals: Tensor
    certainty: Tensor
    lengths: tuple[int, ...]
    within: Neighborhood
    below: Neighborhood | None
    up: Tensor | None

    def turned(self, R: Tensor) -> Level:
        """Turn the level by R (3, 3)."""
        below = self.below.turned(R) if self.below is not None else None
        return replace(
            self, points=self.points @ R.T, normals=self.normals @ R.T, within=self.within.turned(R), below=below
        )


@dataclass(frozen=True)
class Cloud:
    """One cloud, or a batch of them by concatenation, with everything about its geometry that the network asks for.

    Attributes:
        levels: finest first; the last holds the superpoints.
        patches: (S, P) fine points of each superpoint, nearest first; missing ones point at row 0 of their cloud.
        patches_valid: (S, P) bool.
        fine_stage: which level the patches index.
        centre_mm: (B, 3) float64 mean that was taken off each cloud.
        scale_mm: (B,) float64 length of one unit: the target's half extent.
    """

    levels: tuple[Level, ...]
    patches: Tensor
    patches_valid: Tensor
    fine_stage: int
    centre_mm: Tensor
    scale_mm: Tensor

    @property
    def fine(self) -> Level:
        """The level that is matched finely."""
        return self.levels[self.fine_stage]

    @property
    def coarse(self) -> Level:
        """The superpoints."""
        return self.levels[-1]

    def __len__(self) -> int:
        return len(self.coarse.lengths)

    def to(self, device: torch.device | str) -> Cloud:
        """Copy to another device."""
        return on_device(self, device)

    def turned(self, T: NDArray[np.float64]) -> Cloud:
        """Turn one cloud by a rigid motion (4, 4), mm, without a new search."""
        R = torch.from_numpy(T[:3, :3]).float()
        centre = self.centre_mm @ torch.from_numpy(T[:3, :3]).T + torch.from_numpy(T[:3, 3])
        return replace(self, levels=tuple(level.turned(R) for level in self.levels), centre_mm=centre)


@dataclass(frozen=True)
class Features:
    """Backbone features of a cloud: `fine` (N, C_fine) of its fine points, `coarse` (S, C) of its superpoints."""

    fine: Tensor
    coarse: Tensor

    def chosen(self, clouds: Cloud, rows: tuple[int, ...]) -> Features:
        """Choose the features of some of `clouds`, in this order; one may repeat."""
        fine, coarse = self.fine.split(clouds.fine.lengths), self.coarse.split(clouds.coarse.lengths)
        return Features(torch.cat([fine[row] for row in rows]), torch.cat([coarse[row] for row in rows]))


@dataclass(frozen=True)
class Matches:
    """Fine correspondences of a batch of pairs, in the clouds' units.

    Attributes:
        source, target: (C, 3) points.
        score: (C,) soft assignment times the patch pair's score.
        patch: (C,) row of the patch pair.
        pair: (C,) which pair of the batch.
    """

    source: Tensor
    target: Tensor
    score: Tensor
    patch: Tensor
    pair: Tensor


@dataclass(frozen=True)
class PatchPairs:
    """Rows of source and target superpoints that are matched finely: `pair`, `source`, `target`, `score`, (P,) each."""

    pair: Tensor
    source: Tensor
    target: Tensor
    score: Tensor

    def __len__(self) -> int:
        return len(self.source)


def on_device(value: T, device: torch.device | str) -> T:
    """Moves every tensor inside nested dataclasses and tuples."""
    return mapped(value, lambda tensor: tensor.to(device, non_blocking=True))


def mapped(value: T, change: Callable[[Tensor], Tensor]) -> T:
    """Change every tensor inside nested dataclasses and tuples."""
    if isinstance(value, Tensor):
        return change(value)  # type: ignore[return-value]
    if isinstance(value, tuple):
        return tuple(mapped(v, change) for v in value)  # type: ignore[return-value]
    if is_dataclass(value) and not isinstance(value, type):
        moved: dict[str, Any] = {f.name: mapped(getattr(value, f.name), change) for f in fields(value)}
        return replace(value, **moved)
    return value


def collate(clouds: list[Cloud]) -> Cloud:
    """Several clouds as one, by concatenation; indices are shifted, nothing is padded but the patches."""
    if len(clouds) == 1:
        return clouds[0]
    levels = tuple(_join_levels([c.levels for c in clouds], depth) for depth in range(len(clouds[0].levels)))
    fine = clouds[0].fine_stage
    starts = _starts([len(c.levels[fine].points) for c in clouds])
    size = max(c.patches.shape[1] for c in clouds)
    return Cloud(
        levels,
        _shifted([c.patches for c in clouds], starts, size),
        torch.cat([_pad(c.patches_valid, size) for c in clouds]),
        fine,
        torch.cat([c.centre_mm for c in clouds]),
        torch.cat([c.scale_mm for c in clouds]),
    )


def _join_levels(pyramids: list[tuple[Level, ...]], depth: int) -> Level:
    own = [levels[depth] for levels in pyramids]
    starts = _starts([level.points.shape[0] for level in own])
    below = up = None
    if depth > 0:
        finer = _starts([len(levels[depth - 1].points) for levels in pyramids])
        below = _join([level.below for level in own if level.below is not None], finer)
    if depth < len(pyramids[0]) - 1:
        coarser = _starts([len(levels[depth + 1].points) for levels in pyramids])
        up = torch.cat([level.up + start for level, start in zip(own, coarser, strict=True) if level.up is not None])
    points, normals, certainty = (
        torch.cat([getattr(level, name) for level in own]) for name in ("points", "normals", "certainty")
    )
    return Level(
        points,
        normals,
        certainty,
        tuple(n for level in own for n in level.lengths),
        _join([level.within for level in own], starts),
        below,
        up,
    )


def _join(parts: list[Neighborhood], starts: list[int]) -> Neighborhood:
    width = max(p.index.shape[1] for p in parts)
    return Neighborhood(
        _shifted([p.index for p in parts], starts, width),
        torch.cat([_pad(p.valid, width) for p in parts]),
        *(torch.cat([getattr(p, name) for p in parts]) for name in ("c_h", "c_k", "radius")),
    )


def _starts(lengths: list[int]) -> list[int]:
    return [0, *accumulate(lengths[:-1])]


def _shifted(tables: list[Tensor], starts: list[int], width: int) -> Tensor:
    """Tables of rows one after the other, each with its start added, padded with it to `width` columns."""
    joined = tables[0].new_empty(sum(table.shape[0] for table in tables), width)
    for table, start, place in zip(tables, starts, joined.split([table.shape[0] for table in tables]), strict=True):
        torch.add(table, start, out=place[:, : table.shape[1]])
        place[:, table.shape[1] :] = start
    return joined


def _pad(table: Tensor, size: int) -> Tensor:
    missing = size - table.shape[1]
    return torch.nn.functional.pad(table, (0, missing)) if missing else table
