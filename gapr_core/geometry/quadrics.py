"""Normals and curvatures of a cloud by fitting a quadric to each point's neighbours."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gapr_core.geometry import quadric_kernels
from gapr_core.runtime.parallel import in_pieces, thread_count

Array = NDArray[np.float64]
FEWEST_NEIGHBOURS = 16  # that give a trustworthy normal and quadric


@dataclass(frozen=True)
class LocalFrames:
    """A tangent frame in every point.

    Attributes:
        axes: (N, 3, 3); the rows are two tangents and the unit normal.
        flatness_mm: (N,) root-mean-square distance of the neighbours from their plane.
    """

    axes: Array
    flatness_mm: Array

    @property
    def normals(self) -> Array:
        """(N, 3) unit normals."""
        return self.axes[:, 2]


def nearest(
    points: Array, count: int, tree: cKDTree | None = None, num_threads: int = 1
) -> tuple[Array, NDArray[np.int64]]:
    """Distances (N, k), mm, and indices (N, k) of each point's nearest ones in the tree, itself the first.

    k is `count`, or as many as there are in the tree where there are fewer. Without a tree it is that of the points.
    """
    tree = cKDTree(points) if tree is None else tree
    k = list(range(1, min(count, tree.n) + 1))  # a list: else a column is missing where there is one
    return tree.query(points, k=k, workers=thread_count(num_threads))  # type: ignore[no-any-return]


def spacing(points: Array, num_threads: int = 1) -> float:
    """Median distance to the nearest other point, mm."""
    return float(np.median(nearest(points, 2, num_threads=num_threads)[0][:, 1]))


def local_frames(points: Array, neighbours: NDArray[np.int64], num_threads: int = 1) -> LocalFrames:
    """Principal axes of each point's neighbourhood; the normal's sign is arbitrary.

    Args:
        points: (N, 3), mm.
        neighbours: (M, k) indices into points, one row for each frame.
        num_threads: 0 for all cores.
    """
    around = points[neighbours]
    around = around - around.mean(axis=1, keepdims=True)
    spread = np.einsum("nki,nkj->nij", around, around) / neighbours.shape[1]
    parts = zip(*in_pieces(np.linalg.eigh, spread, num_threads), strict=True)
    eigenvalues, eigenvectors = map(np.concatenate, parts)
    axes = eigenvectors[:, :, ::-1].transpose(0, 2, 1).copy()
    axes[:, 1] = np.cross(axes[:, 2], axes[:, 0])  # right-handed
    return LocalFrames(axes, np.sqrt(np.maximum(eigenvalues[:, 0], 0.0)))


def orient(normals: Array, towards: Array) -> Array:
    """Normals (N, 3) flipped where they point against `towards` (N, 3)."""
    return normals * np.where(np.einsum("ni,ni->n", normals, towards) < 0.0, -1.0, 1.0)[:, None]


def fit_quadrics(
    points: Array, normals: Array, neighbours: NDArray[np.int64], num_threads: int = 1
) -> tuple[Array, Array]:
    """Second fundamental form in each point, and the normal corrected by the fit.

    Fits h(u, v) = a + b u + c v + (d u^2 + 2 e u v + f v^2) / 2 over the tangent plane by least squares. Weights fall
    to zero at the farthest neighbour, and for neighbours whose normals disagree (the other side of a blade).

    Args:
        points: (N, 3), mm.
        normals: (N, 3), unit, consistently oriented.
        neighbours: (N, k), k >= 10, indices into points.
        num_threads: 0 for all cores.

    Returns:
        normals (N, 3), and shapes (N, 3, 3): symmetric matrices with shape @ normal = 0 so that the surface near a
        point lies at height t^T shape t / 2 over its tangent plane, in 1/mm.
    """

    def work(rows: NDArray[np.int64]) -> tuple[Array, Array]:
        gram, right, tangents, reach = quadric_kernels.equations(points, normals, neighbours, rows)
        return quadric_kernels.elements(normals[rows], np.linalg.solve(gram, right), tangents, reach)  # type: ignore[no-any-return]

    corrected, shapes = zip(*in_pieces(work, np.arange(len(points)), num_threads), strict=True)
    return np.concatenate(corrected), np.concatenate(shapes)


def misfit_mm(
    points: Array,
    normals: Array,
    shapes: Array,
    neighbours: NDArray[np.int64],
    most_mm: float = 5.0,
    num_threads: int = 1,
) -> Array:
    """(N,) root-mean-square distance, mm, of each point's neighbours to its quadric, each at most `most_mm`.

    Args:
        points: (N, 3), mm.
        normals, shapes: (N, 3) and (N, 3, 3) from `fit_quadrics`.
        neighbours: (N, k) indices into points, without the points themselves.
        most_mm: beyond it a neighbour is simply elsewhere.
        num_threads: 0 for all cores.
    """
    work = partial(quadric_kernels.heights, points, normals, shapes, neighbours)
    off = np.concatenate(in_pieces(work, np.arange(len(points)), num_threads))
    return np.asarray(np.sqrt((np.minimum(np.abs(off), most_mm) ** 2).mean(axis=1)))


def heights(offsets: Array, normals: Array, shapes: Array) -> Array:
    """(...) signed distances to quadrics of points that lie `offsets` (..., 3) from the quadrics' own points, mm.

    Args:
        offsets: (..., 3), mm.
        normals, shapes: (..., 3) and (..., 3, 3) from `fit_quadrics`.
    """
    height = (offsets * normals).sum(axis=-1)
    tangents = offsets - height[..., None] * normals
    bent = np.einsum("...ij,...j->...i", shapes, tangents)
    slope = np.linalg.norm(normals - bent, axis=-1)
    return np.asarray((height - 0.5 * (bent * tangents).sum(axis=-1)) / slope)


def tangent_basis(normals: Array, like: Array | None = None) -> Array:
    """(N, 2, 3) orthonormal tangents to (N, 3) unit normals; the first one close to `like` (N, 3) when given."""
    helper = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]) if like is None else like
    first = helper - np.einsum("ni,ni->n", helper, normals)[:, None] * normals
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first)], axis=1)
