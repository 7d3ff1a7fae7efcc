"""True answers for the network: overlaps of patches and matches of fine points under the true motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import pad as pad_tensor

from gapr_core.geometry import se3
from gapr_core.model.pyramid import Frame, matching_radius
from gapr_core.model.repositioning import move
from gapr_core.model.types import Cloud, PatchPairs, collate, mapped, on_device

Array = NDArray[np.float64]
POSITIVE_OVERLAP = 0.1


@dataclass(frozen=True)
class TrainingPair:
    """One pair, or a batch of them, as the trainer sees it.

    Attributes:
        source, target: the clouds.
        T: (B, 3, 4) true T_target_source in the clouds' units.
        overlaps: (B, n, m) mean share of two patches' points that have a match in the other.
        radius: (B,) matching radius in units.
        distinct: the different targets, each once; None for a single pair.
        which: row of `distinct` for each pair.
        subjects: whose bones the pairs were made of, a name for each contribution.
    """

    source: Cloud
    target: Cloud
    T: Tensor
    overlaps: Tensor
    radius: Tensor
    distinct: Cloud | None = None
    which: tuple[int, ...] = ()
    subjects: tuple[str, ...] = ()

    def to(self, device: torch.device | str) -> TrainingPair:
        """Copy to another device."""
        return on_device(self, device)

    def pin_memory(self) -> TrainingPair:
        """Copy to pinned memory for a GPU; a `DataLoader` asks for it."""
        return mapped(self, Tensor.pin_memory)


def training_pair(source: Cloud, target: Cloud, T_target_source: Array, frame: Frame) -> TrainingPair:
    """Joins two clouds of one frame with the truth (4, 4), mm."""
    T = to_units(T_target_source, source, target)
    radius = matching_radius(frame)
    matches = _matches(source, target, T, radius)
    overlaps = _overlaps(source, target, matches)
    truth = torch.from_numpy(T[None, :3]).float()
    return TrainingPair(source, target, truth, torch.from_numpy(overlaps[None]), torch.tensor([radius]))


def to_units(T_target_source: Array, source: Cloud, target: Cloud) -> Array:
    """(4, 4) motion between the clouds' own unit coordinates from one in mm."""
    scale = float(source.scale_mm[0])
    T = np.array(T_target_source, dtype=np.float64)
    T[:3, 3] = (se3.apply(T, source.centre_mm.numpy())[0] - target.centre_mm.numpy()[0]) / scale
    return T


def _matches(source: Cloud, target: Cloud, T: Array, radius: float) -> NDArray[Any]:
    """Match fine points i of the source and j of the target within `radius`; v is their distance."""
    p, q = se3.apply(T, source.fine.points.numpy()), target.fine.points.double().numpy()
    return cKDTree(p).sparse_distance_matrix(cKDTree(q), radius, output_type="ndarray")  # type: ignore[no-any-return]


def _overlaps(source: Cloud, target: Cloud, matches: NDArray[Any]) -> NDArray[np.float32]:
    """(n, m): for every two patches, the share of points with a match in the other, averaged over both sides."""
    node_p, node_q = _nodes(source), _nodes(target)
    i, j = matches["i"], matches["j"]
    kept = (node_p[i] >= 0) & (node_q[j] >= 0)
    i, j = i[kept], j[kept]
    shape = len(source.patches), len(target.patches)
    hits_p, hits_q = _hits(i, node_p, node_q[j], shape), _hits(j, node_q, node_p[i], shape[::-1]).T
    size_p, size_q = (c.patches_valid.sum(1).clamp(min=1).numpy() for c in (source, target))
    return (0.5 * (hits_p / size_p[:, None] + hits_q / size_q)).astype(np.float32)


def _nodes(cloud: Cloud) -> NDArray[np.int64]:
    """Return the patch of every fine point, -1 without room in any."""
    node = np.full(len(cloud.fine.points), -1, dtype=np.int64)
    row, column = np.nonzero(cloud.patches_valid.numpy())
    node[cloud.patches.numpy()[row, column]] = row
    return node


def _hits(point: NDArray[np.int64], node: NDArray[np.int64], other: NDArray[np.int64], shape: tuple[int, int]) -> Array:
    """Count different points of each own patch, `node` of every point, with matches in each other patch."""
    has_match = np.zeros((len(node), shape[1]), dtype=bool)
    has_match[point, other] = True
    point, other = np.nonzero(has_match)
    counts = np.bincount(node[point] * shape[1] + other, minlength=shape[0] * shape[1])
    return counts.reshape(shape).astype(np.float64)


def join(pairs: list[TrainingPair]) -> TrainingPair:
    """Join a batch: pad overlaps with zeros, keep one copy of identical target objects."""
    if len(pairs) == 1:
        return pairs[0]
    n, m = (max(p.overlaps.shape[axis] for p in pairs) for axis in (1, 2))
    distinct = list({id(p.target): p.target for p in pairs}.values())
    which = tuple(next(row for row, cloud in enumerate(distinct) if cloud is p.target) for p in pairs)
    overlaps = [pad_tensor(p.overlaps, (0, m - p.overlaps.shape[2], 0, n - p.overlaps.shape[1])) for p in pairs]
    return TrainingPair(
        collate([p.source for p in pairs]),
        collate([p.target for p in pairs]),
        torch.cat([p.T for p in pairs]),
        torch.cat(overlaps),
        torch.cat([p.radius for p in pairs]),
        collate(distinct),
        which,
        tuple(name for p in pairs for name in p.subjects),
    )


def true_patch_pairs(pair: TrainingPair, count: int, generator: torch.Generator) -> PatchPairs:
    """Up to `count` patch pairs per pair of clouds, drawn from those that overlap by 10 % or more: the set C*."""
    which, rows, columns = (pair.overlaps > POSITIVE_OVERLAP).nonzero(as_tuple=True)  # padding overlaps nothing
    order = torch.rand(len(which), generator=generator).to(which.device).argsort()
    order = order[which[order].argsort(stable=True)]  # the pairs of clouds in turn, each in a random order
    each = torch.bincount(which, minlength=len(pair.overlaps))
    place = torch.arange(len(which), device=which.device) - (each.cumsum(0) - each).repeat_interleave(each)
    drawn = order[place < count]
    which, rows, columns = which[drawn], rows[drawn], columns[drawn]
    score = pair.overlaps[which, rows, columns]
    return PatchPairs(which, rows + _starts(pair.source, which), columns + _starts(pair.target, which), score)


def _starts(clouds: Cloud, which: Tensor) -> Tensor:
    """Return the row of the cloud's first superpoint for each entry of `which`."""
    counts = torch.tensor(clouds.coarse.lengths)
    return (counts.cumsum(0) - counts).to(which.device)[which]


def fine_labels(
    pair: TrainingPair, index_p: Tensor, index_q: Tensor, valid_p: Tensor, valid_q: Tensor, which: Tensor
) -> Tensor:
    """(P, a + 1, b + 1) bool: true matches of patch pairs, and the dustbin for existing points without any.

    Args:
        index_p, index_q: (P, a), (P, b) fine points of the patches. valid_*: which exist.
        which: (P,) the pair of clouds that a patch pair belongs to.
    """
    p = move(pair.T[which], pair.source.fine.points[index_p])
    q = pair.target.fine.points[index_q]
    near = torch.cdist(p, q, compute_mode="donot_use_mm_for_euclid_dist") < pair.radius[which, None, None]
    near &= valid_p[:, :, None] & valid_q[:, None]
    labels = pad_tensor(near, (0, 1, 0, 1))
    labels[:, :-1, -1] = ~near.any(2) & valid_p
    labels[:, -1, :-1] = ~near.any(1) & valid_q
    return labels
