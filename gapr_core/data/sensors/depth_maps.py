"""Errors of cameras that match depth over windows: near points err alike, and the range of all of them is wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gapr_core.data.sensors.acquired import View, tangents
from gapr_core.geometry import sampling

Array = NDArray[np.float64]

IN_WINDOW, MOST_STEP_MM = 80, 8.0  # points that a window looks at, and the step of depth that ends it
RANGE = 0.01  # standard deviation of the relative error of the range; Intel states up to 2 % for the RealSense D400


@dataclass(frozen=True, eq=False)
class Windows:
    """Gaussian windows about the N points of a view; a step of depth ends them.

    Attributes:
        near: (N, K) indices of the points in each window.
        weights: (N, K), a sum of 1 in each.
    """

    near: NDArray[np.intp]
    weights: Array

    def mean(self, values: Array) -> Array:
        """(N,) means of values (N,) over the windows."""
        return np.einsum("nk,nk->n", self.weights, values[self.near])

    def patchy(self, size: float, rng: np.random.Generator) -> Array:
        """(N,) noise of standard deviation `size` that is alike within a window."""
        noise = self.mean(rng.normal(size=len(self.near)))
        return np.asarray(size * noise / max(float(noise.std()), 1e-9))


def windows(view: View, size_mm: float) -> Windows:
    """Windows of a standard deviation of `size_mm` across the look."""
    depth_mm, across = view.points @ view.towards, view.points @ np.stack(tangents(view), axis=1)
    some = sampling.voxel_indices(view.points, 0.5 * size_mm)
    apart, near = cKDTree(across[some]).query(across, k=min(IN_WINDOW, len(some)))
    near = some[near]
    weights = np.exp(-0.5 * (apart / size_mm) ** 2) * (np.abs(depth_mm[near] - depth_mm[:, None]) < MOST_STEP_MM)
    return Windows(near, weights / weights.sum(axis=1, keepdims=True))


@dataclass(frozen=True, eq=False)
class Range:
    """A range that is wrong by a factor: rays keep their directions, the size changes.

    The shift along the look that comes with it is left out: it is part of the pose, which registration looks for.

    Attributes:
        factor: 1 is true to size.
        centre: (3,) mm, the point that stays.
    """

    factor: float
    centre: Array

    def of(self, points: Array) -> Array:
        """Points (..., 3) of the bone or the viewpoint, as far from each other as the camera says."""
        return self.centre + self.factor * (points - self.centre)


def wrong_range(points: Array, rng: np.random.Generator) -> Range:
    """Scale the range of a camera that sees points (N, 3) by about 1 %."""
    return Range(1.0 + float(rng.normal(0.0, RANGE)), points.mean(axis=0))
