"""Normals and curvatures of a cloud by fitting a quadric to each point's neighbours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

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


def spacing(points: Array, tree: cKDTree | None = None) -> float:
    """Median distance to the nearest other point, mm."""
    tree = cKDTree(points) if tree is None else tree
    return float(np.median(tree.query(points, k=2)[0][:, 1]))


def local_frames(points: Array, neighbours: NDArray[np.int64]) -> LocalFrames:
    """Principal axes of each point's neighbourhood; the normal's sign is arbitrary.

    Args:
        points: (N, 3), mm.
        neighbours: (M, k) indices into points, one row for each frame.
    """
    around = points[neighbours]
    around = around - around.mean(axis=1, keepdims=True)
    eigenvalues, eigenvectors = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around) / neighbours.shape[1])
    axes = eigenvectors[:, :, ::-1].transpose(0, 2, 1).copy()
    axes[:, 1] = np.cross(axes[:, 2], axes[:, 0])  # right-handed
    return LocalFrames(axes, np.sqrt(np.maximum(eigenvalues[:, 0], 0.0)))


def orient(normals: Array, towards: Array) -> Array:
    """Normals (N, 3) flipped where they point against `towards` (N, 3)."""
    return normals * np.where(np.einsum("ni,ni->n", normals, towards) < 0.0, -1.0, 1.0)[:, None]


def fit_quadrics(points: Array, normals: Array, neighbours: NDArray[np.int64]) -> tuple[Array, Array]:
    """Second fundamental form in each point, and the normal corrected by the fit.

    Fits h(u, v) = a + b u + c v + (d u^2 + 2 e u v + f v^2) / 2 over the tangent plane by least squares with weights
    that fall to zero at the farthest neighbour and for neighbours whose normals disagree (the other side of a blade).

    Args:
        points: (N, 3), mm.
        normals: (N, 3), unit, consistently oriented.
        neighbours: (N, k), k >= 10, indices into points.

    Returns:
        normals (N, 3), and shapes (N, 3, 3): symmetric matrices with shape @ normal = 0 so that the surface near a
        point lies at height t^T shape t / 2 over its tangent plane, in 1/mm.
    """
    offsets = points[neighbours] - points[:, None]
    tangents = tangent_basis(normals)
    uv = np.einsum("nki,nai->nka", offsets, tangents)
    height = np.einsum("nki,ni->nk", offsets, normals)
    reach = np.linalg.norm(offsets, axis=2).max(axis=1)[:, None] * 1.05
    weight = np.clip(1.0 - (np.linalg.norm(offsets, axis=2) / reach) ** 2, 0.0, 1.0) ** 2
    weight *= np.clip(np.einsum("nki,ni->nk", normals[neighbours], normals), 0.0, 1.0) ** 2
    scale = reach[..., None]
    u, v = uv[..., 0] / reach, uv[..., 1] / reach
    design = np.stack([np.ones_like(u), u, v, 0.5 * u * u, u * v, 0.5 * v * v], axis=2)
    gram = np.einsum("nka,nk,nkb->nab", design, weight, design) + 1e-6 * np.eye(6)
    coefficients = np.linalg.solve(gram, np.einsum("nka,nk,nk->na", design, weight, height)[..., None])[..., 0]
    gradient = coefficients[:, 1:3] / reach
    d, e, f = (coefficients[:, 3:] / scale[:, :, 0] ** 2).T
    corrected = normals - np.einsum("na,nai->ni", gradient, tangents)
    corrected /= np.linalg.norm(corrected, axis=1, keepdims=True)
    form = np.stack([np.stack([d, e], axis=1), np.stack([e, f], axis=1)], axis=1)
    tangents = tangent_basis(corrected, like=tangents[:, 0])
    return corrected, np.einsum("nai,nab,nbj->nij", tangents, form, tangents)


def misfit_mm(
    points: Array, normals: Array, shapes: Array, neighbours: NDArray[np.int64], most_mm: float = 5.0
) -> Array:
    """(N,) root-mean-square distance, mm, of each point's neighbours to its quadric, each at most `most_mm`.

    Args:
        points: (N, 3), mm.
        normals, shapes: (N, 3) and (N, 3, 3) from `fit_quadrics`.
        neighbours: (N, k) indices into points, without the points themselves.
        most_mm: beyond it a neighbour is simply elsewhere.
    """
    offsets = points[neighbours] - points[:, None]
    off = heights(offsets, normals[:, None], shapes[:, None])
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
