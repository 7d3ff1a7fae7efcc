"""From points to a `Cloud`: voxels, neighbours, ball centroids and patches, with numpy and k-d trees on the CPU.

Nothing here depends on the pose of the cloud: the voxel grid lies along its principal axes, so that a moved cloud gives
the same voxels, neighbours and patches, only moved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from gapr_core.errors import InvalidPointCloudError
from gapr_core.geometry import extent
from gapr_core.model import pyramid_kernels
from gapr_core.model.config import ModelConfig
from gapr_core.model.types import Cloud, Level, Neighborhood

Array = NDArray[np.float64]
Index = NDArray[np.int64]
FEWEST_POINTS = 16
MOST_RADIUS_MM = 5.0  # but never less than the first voxel: two samplings of a surface lie that far apart


@dataclass(frozen=True)
class Frame:
    """The one scale of a pair: `scale_mm` is the target's half extent, `voxel` the first voxel in these units."""

    scale_mm: float
    voxel: float


def target_frame(target_mm: ArrayLike, config: ModelConfig) -> Frame:
    """Scale and first voxel of a target (M, 3), mm; both clouds of a pair share them."""
    points = _checked(target_mm)
    centred = points - points.mean(axis=0)
    scale_mm = extent.half_extent_mm(points)
    return Frame(scale_mm, choose_voxel(centred / scale_mm, config))


def matching_radius(frame: Frame) -> float:
    """Two first voxels, at most 5 mm, at least one voxel; in units."""
    return min(2.0 * frame.voxel, max(MOST_RADIUS_MM / frame.scale_mm, frame.voxel))


def build_cloud(points_mm: ArrayLike, frame: Frame, config: ModelConfig) -> Cloud:
    """Build the pyramid of one cloud (N, 3), mm, N >= 16.

    Raises:
        InvalidPointCloudError: for a wrong shape, too few or not finite points.
    """
    points = _checked(points_mm)
    centre = points.mean(axis=0)
    resolutions = pyramid((points - centre) / frame.scale_mm, frame.voxel, config)
    if len(resolutions[-1]) > 4 * config.superpoints[1]:
        raise InvalidPointCloudError(
            f"at most {4 * config.superpoints[1]} superpoints",
            f"{len(resolutions[-1])}: a cloud far larger than its target",
            "check the units of both clouds",
        )
    trees = [cKDTree(p) for p in resolutions]
    radii = stage_radii(frame.voxel, config)
    within = [
        neighborhood(p, tree, config.neighbors[s], radii[s], config.small_ball)
        for s, (p, tree) in enumerate(zip(resolutions, trees, strict=True))
    ]
    ups = [trees[s + 1].query(resolutions[s])[1].astype(np.int64) for s in range(config.stages - 1)]
    inside = _inside(ups, within[-1])
    levels = []
    for s, p in enumerate(resolutions):
        normals, certainty = oriented_normals(p, within[s], inside[s], radii[-1])
        below = None
        if s > 0:
            below = neighborhood(p, trees[s - 1], config.neighbors[s - 1], radii[s - 1], config.small_ball)
        up = torch.from_numpy(ups[s]) if s < config.stages - 1 else None
        levels.append(Level(_tensor(p), _tensor(normals), _tensor(certainty), (len(p),), within[s], below, up))
    patches, valid = group_patches(resolutions[config.fine_stage], trees[-1], config.patch_size)
    return Cloud(
        tuple(levels),
        torch.from_numpy(patches),
        torch.from_numpy(valid),
        config.fine_stage,
        torch.from_numpy(centre[None]),
        torch.tensor([frame.scale_mm], dtype=torch.float64),
    )


def choose_voxel(points: Array, config: ModelConfig, steps: int = 12) -> float:
    """First voxel, in units, for which the cloud keeps about the middle of `config.superpoints` at the bottleneck."""
    wanted = 0.5 * sum(config.superpoints)
    low, high, turned = 1e-3, 0.5, points @ principal_axes(points)
    for _ in range(steps):
        middle = float(np.sqrt(low * high))
        count = len(_stages(turned, middle, config)[-1])
        if config.superpoints[0] <= count <= config.superpoints[1] and abs(count - wanted) < 0.1 * wanted:
            return middle
        low, high = (middle, high) if count > wanted else (low, middle)
    return float(np.sqrt(low * high))


def stage_radii(voxel: float, config: ModelConfig) -> list[float]:
    """Radius of a neighbourhood of every stage, in the unit of the first voxel."""
    return [config.radius_voxels * voxel * config.voxel_growth**stage for stage in range(config.stages)]


def pyramid(points: Array, voxel: float, config: ModelConfig) -> list[Array]:
    """Sample the points of every stage, finest first."""
    axes = principal_axes(points)
    return [p @ axes.T for p in _stages(points @ axes, voxel, config)]


def _stages(turned: Array, voxel: float, config: ModelConfig) -> list[Array]:
    """Sample every stage of points along their principal axes."""
    resolutions = [voxel_means(turned, voxel)]
    for _ in range(config.stages - 1):
        voxel *= config.voxel_growth
        resolutions.append(voxel_means(resolutions[-1], voxel))
    return resolutions


def principal_axes(points: Array) -> Array:
    """(3, 3) columns: principal axes of a cloud, each pointing to its heavier tail."""
    centred = points - points.mean(axis=0)
    axes = np.ascontiguousarray(extent.principal(points).axes[::-1].T)  # shortest first, as trained
    skewness = ((centred @ axes) ** 3).sum(axis=0)
    return np.asarray(axes * np.where(skewness < 0, -1.0, 1.0))


def voxel_means(points: Array, voxel: float) -> Array:
    """Means of the points of each occupied voxel, in the order of the voxels."""
    cells = np.floor(np.ascontiguousarray(points.T) / voxel).astype(np.int64)
    cells -= cells.min(axis=1, keepdims=True)
    size = cells.max(axis=1) + 1
    keys = (cells[0] * size[1] + cells[1]) * size[2] + cells[2]
    _, inverse, counts = np.unique(keys, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(inverse, points[:, axis], len(counts)) for axis in range(3)], axis=1)
    return np.asarray(sums / counts[:, None])


def neighborhood(centres: Array, tree: cKDTree, cap: int, radius: float, small_ball: float) -> Neighborhood:
    """Find `cap` nearest support points within `radius` of each centre, and both balls' centroids.

    A centre without any neighbour gets its nearest point; an empty small ball has the centre as its centroid.
    """
    support = np.asarray(tree.data)
    distance, index = tree.query(centres, k=min(cap, len(support)))
    distance, index = distance.reshape(len(centres), -1), index.reshape(len(centres), -1).astype(np.int64)
    valid, c_h, c_k = np.empty(index.shape, dtype=bool), np.empty(centres.shape), np.empty(centres.shape)
    pyramid_kernels.balls(centres, support, distance, index, radius, small_ball * radius, valid, c_h, c_k)
    return Neighborhood(
        torch.from_numpy(index),
        torch.from_numpy(valid),
        _tensor(c_h),
        _tensor(c_k),
        torch.full((len(centres),), radius),
    )


def _inside(ups: list[Index], coarsest: Neighborhood) -> list[Array]:
    """Compute for each point of each level the coarsest ball's centroid around its nearest superpoint."""
    inside = [coarsest.c_h.double().numpy()]
    for up in reversed(ups):
        inside.insert(0, inside[0][up])
    return inside


def oriented_normals(points: Array, near: Neighborhood, inside: Array, reach: float) -> tuple[Array, Array]:
    """Plane normals turned away from `inside`, and how surely: 1 when `inside` is 0.15 `reach` or more behind."""
    spreads = pyramid_kernels.spreads(points, near.index.numpy(), near.valid.numpy(), near.c_h.double().numpy())
    normals = np.linalg.eigh(spreads)[1][:, :, 0]
    outward = np.einsum("ni,ni->n", normals, points - inside)
    return normals * np.where(outward < 0, -1.0, 1.0)[:, None], np.minimum(1.0, np.abs(outward) / (0.15 * reach))


def group_patches(fine: Array, superpoints: cKDTree, most: int) -> tuple[Index, NDArray[np.bool_]]:
    """Point-to-node grouping: every fine point goes to its nearest superpoint, which keeps the nearest `most`."""
    distance, node = superpoints.query(fine)
    order = np.lexsort((distance, node))
    node = node[order]
    rank = np.arange(len(node)) - np.searchsorted(node, node)
    kept = rank < most
    patches = np.zeros((superpoints.n, int(rank[kept].max()) + 1), dtype=np.int64)
    valid = np.zeros(patches.shape, dtype=bool)
    patches[node[kept], rank[kept]] = order[kept]
    valid[node[kept], rank[kept]] = True
    return patches, valid


def _checked(points_mm: ArrayLike) -> Array:
    points = np.asarray(points_mm, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < FEWEST_POINTS or not np.isfinite(points).all():
        raise InvalidPointCloudError(
            f"at least {FEWEST_POINTS} finite points (N, 3)", f"an array of shape {points.shape}", "clean the cloud"
        )
    if not np.ptp(points, axis=0).any():
        raise InvalidPointCloudError("points at different places", "one place only", "check the units")
    return points


def _tensor(array: Array) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))
