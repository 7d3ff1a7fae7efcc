"""The interface of proposers, and the weight-free one: every placement of a source normal on a target normal.

A reference point of the source is put on an anchor of the target, normal on normal, and turned about the normal in
steps. Each pose is scored by the distances of a few probe points in the target's distance field. Both signs of a normal
are tried unless the sensor's place decides it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numba
import numpy as np
from numpy.typing import NDArray

from gapr_core.config import SearchConfig
from gapr_core.geometry import quadrics, sampling
from gapr_core.geometry.distance_field import FARTHEST, DistanceField
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.runtime.parallel import in_threads

Array = NDArray[np.float64]

CANDIDATES = 8  # points of the spread order for each reference to choose from


class Proposer(Protocol):
    """Suggests poses; verification decides. A right one among many wrong ones is a success."""

    @property
    def name(self) -> str:
        """Name in tables and logs."""
        ...

    def prepare(self, target: PreparedTarget) -> object:
        """Prepare a target, so that the first `propose` is as fast as later ones; kept in its `cache`."""
        ...

    def propose(self, source: PreparedSource, target: PreparedTarget, rng: np.random.Generator) -> Array:
        """Propose poses (K, 4, 4) T_target_source, mm, best first, for one pair; may be none."""
        ...


@dataclass(frozen=True)
class NormalAlignedSearch:
    """Exhaustive search over normal-aligned poses; deterministic, no training."""

    config: SearchConfig = SearchConfig()
    num_threads: int = 0
    name: str = "search"

    def prepare(self, target: PreparedTarget) -> None:
        """Prepare nothing: the distance field is part of every prepared target."""

    def propose(self, source: PreparedSource, target: PreparedTarget, rng: np.random.Generator) -> Array:
        """Find the best spin of every (reference, sign, anchor), and return the best `keep` of them all."""
        references = _references(source, self.config.references)
        signs = np.array([1.0] if source.oriented else [1.0, -1.0])
        normals = target.normals[target.anchors]
        anchor_axes = np.concatenate([quadrics.tangent_basis(normals), normals[:, None]], axis=1)  # (A, 3, 3) rows
        local = np.stack([_probes_in_frame(source, i, sign, self.config) for i in references for sign in signs])
        anchors = target.points[target.anchors].astype(np.float32)
        score, spin = self._score(local, anchors, anchor_axes.astype(np.float32), target.field)
        best = np.argsort(score, axis=None, kind="stable")[: self.config.keep]
        view, anchor = np.unravel_index(best, score.shape)
        angles = 2.0 * np.pi * spin[view, anchor] / self.config.spins
        reference, sign = references[view // len(signs)], signs[view % len(signs)]
        return _poses(source, reference, sign, angles, target, anchor_axes, anchor)

    def _score(
        self, local: NDArray[np.float32], anchors: NDArray[np.float32], axes: NDArray[np.float32], field: DistanceField
    ) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        limit = self.config.first_limit_mm * FARTHEST / field.reach_mm
        corner = (field.origin - 0.5 * field.cell_mm).astype(np.float32)
        same = anchors, axes, field.distance, corner, np.float32(1.0 / field.cell_mm)
        first = self.config.first_probes, np.float32(limit)

        def work(turned: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
            return _best_spins(turned, *same, *first)  # type: ignore[no-any-return]

        scores, spins = zip(*in_threads(work, local, num_threads=self.num_threads), strict=True)
        return np.stack(scores), np.stack(spins)


def _references(source: PreparedSource, count: int) -> NDArray[np.int64]:
    """Choose points far apart, of the flatter half of the first ones in the spread order."""
    candidates = source.order[: CANDIDATES * count]
    flat = candidates[np.argsort(source.flatness_mm[candidates], kind="stable")[: max(count, len(candidates) // 2)]]
    return flat[sampling.farthest_points(source.points[flat], count)]


def _probes_in_frame(source: PreparedSource, reference: int, sign: float, config: SearchConfig) -> NDArray[np.float32]:
    """Turn the probe points about one reference's normal; (probes, 3, spins) in its frame."""
    axes = source.axes(np.array([reference]))[0] * np.array([1.0, sign, sign])[:, None]
    probes = (source.subset(config.probes) - source.points[reference]) @ axes.T
    angle = 2.0 * np.pi * np.arange(config.spins) / config.spins
    x, y, z = probes.T[:, :, None]
    turned = [
        np.cos(angle) * x - np.sin(angle) * y,
        np.sin(angle) * x + np.cos(angle) * y,
        np.broadcast_to(z, (len(z), len(angle))),
    ]
    return np.stack(turned, axis=1).astype(np.float32)


def _poses(
    source: PreparedSource,
    references: NDArray[np.int64],
    signs: Array,
    angles: Array,
    target: PreparedTarget,
    anchor_axes: Array,
    anchors: NDArray[np.intp],
) -> Array:
    """Compute (K, 4, 4) poses: R = axes_anchor^T Rz(angle) axes_reference, the reference point on the anchor."""
    c, s, o, i = np.cos(angles), np.sin(angles), np.zeros_like(angles), np.ones_like(angles)
    turn = np.stack([c, -s, o, s, c, o, o, o, i], axis=1).reshape(-1, 3, 3)
    flip = np.stack([i, signs, signs], axis=1)[:, :, None]
    poses = np.tile(np.eye(4), (len(angles), 1, 1))
    poses[:, :3, :3] = anchor_axes[anchors].transpose(0, 2, 1) @ turn @ (source.axes(references) * flip)
    moved = np.einsum("kij,kj->ki", poses[:, :3, :3], source.points[references])
    poses[:, :3, 3] = target.points[target.anchors[anchors]] - moved
    return poses


@numba.njit(cache=True, nogil=True, fastmath=True)
def _best_spins(local, anchors, axes, distance, origin, per_cell, first, limit):  # type: ignore[no-untyped-def]
    """Find for every anchor the lowest mean probe distance (in field steps) over the spins, and that spin.

    `local` (probes, 3, spins); `origin` is the corner of the field's first cell. All spins go side by side, which
    compilers vectorise; after the `first` probes only those within `limit` go on.
    """
    probes, _, spins = local.shape
    worst = FARTHEST * probes
    most = limit * np.float32(first) if first < probes else np.float32(worst)
    first = min(first, probes)
    score, best = np.empty(len(anchors), dtype=np.float32), np.zeros(len(anchors), dtype=np.int32)
    totals, cells = np.empty(spins, dtype=np.int32), np.empty(spins, dtype=np.int32)
    left = np.empty(spins, dtype=np.int32)
    rest = np.empty((probes - first, 3, spins), dtype=np.float32)
    for a in range(len(anchors)):
        place, m = (anchors[a] - origin) * per_cell, axes[a] * per_cell
        totals[:] = 0
        _add_probes(totals, spins, local[:first], place, m, distance, cells)
        count = np.intp(0)
        for s in range(spins):
            if totals[s] <= most:
                left[count], totals[count] = s, totals[s]
                count += 1
        if count:
            for k in range(first, probes):
                for axis in range(3):
                    for n in range(count):
                        rest[k - first, axis, n] = local[k, axis, left[n]]
            _add_probes(totals, count, rest, place, m, distance, cells)
        lowest = worst
        for n in range(count):
            if totals[n] < lowest:
                lowest, best[a] = totals[n], left[n]
        score[a] = np.float32(lowest) / np.float32(probes)
    return score, best


@numba.njit(cache=True, nogil=True, fastmath=True)
def _add_probes(totals, count, local, place, m, distance, cells):  # type: ignore[no-untyped-def]
    """Add to the first `count` totals the field's value at every probe (probes, 3, spins), `FARTHEST` outside of it."""
    nx, ny, nz = distance.shape
    flat = distance.ravel()
    for k in range(len(local)):
        for s in range(count):
            x, y, z = local[k, 0, s], local[k, 1, s], local[k, 2, s]
            i = np.int32(np.floor(place[0] + m[0, 0] * x + m[1, 0] * y + m[2, 0] * z))
            j = np.int32(np.floor(place[1] + m[0, 1] * x + m[1, 1] * y + m[2, 1] * z))
            h = np.int32(np.floor(place[2] + m[0, 2] * x + m[1, 2] * y + m[2, 2] * z))
            inside = (i >= 0) & (j >= 0) & (h >= 0) & (i < nx) & (j < ny) & (h < nz)
            cells[s] = (i * ny + j) * nz + h if inside else -1
        for s in range(count):
            totals[s] += flat[cells[s]] if cells[s] >= 0 else FARTHEST
