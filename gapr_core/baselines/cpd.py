"""Coherent Point Drift, rigid (Myronenko and Song 2010), of the library pycpd, with its scale held at one."""

from __future__ import annotations

from typing import Any

import numpy as np

from gapr_core.baselines.base import Array, Baseline, BaselineTarget, require
from gapr_core.geometry import se3


class Cpd(Baseline):
    """CPD on evenly drawn subsets: time and memory grow with source points x target points.

    pycpd solves for rotation, translation and scale; a scale would stretch a partial source over the whole bone, so
    it is fixed here.
    """

    name = "cpd"

    def __init__(self, source_points: int = 400, target_points: int = 1000, outlier_weight: float = 0.1) -> None:
        self.source_points, self.target_points, self.outlier_weight = source_points, target_points, outlier_weight

    def _prepare(self, points: Array, normals: Array | None) -> Array:
        self._library()
        return _subset(points, self.target_points)

    def _align(self, source: Array, target: BaselineTarget, seed: Array) -> Array:
        moved = se3.apply(seed, _subset(source, self.source_points))
        solver = _rigid(self._library())(X=target.static, Y=moved, w=self.outlier_weight, max_iterations=100)
        solver.register()
        _, rotation, shift = solver.get_registration_parameters()
        return se3.from_rotation_translation(rotation.T, np.ravel(shift)) @ seed  # pycpd multiplies rows: y R + t

    def _library(self) -> Any:
        return require("pycpd", "pycpd", self.name)


def _rigid(library: Any) -> Any:
    class Rigid(library.RigidRegistration):
        """Scale one: t and sigma^2 of Myronenko and Song, fig. 2, with s = 1."""

        def update_transform(self) -> None:
            super().update_transform()
            self.s = 1.0
            mean_target, mean_source = self.P.sum(axis=0) @ self.X / self.Np, self.P.sum(axis=1) @ self.Y / self.Np
            self.t = mean_target - mean_source @ self.R

        def update_variance(self) -> None:
            before = float(self.sigma2)
            spread = self.Pt1 @ (self.X_hat**2).sum(axis=1)
            variance = (spread - 2.0 * np.trace(self.A @ self.R) + self.YPY) / (self.Np * self.D)
            self.sigma2: float = max(float(variance), self.tolerance / 10.0)
            self.diff = abs(self.sigma2 - before)

    return Rigid


def _subset(points: Array, count: int) -> Array:
    """`count` points, always the same ones."""
    if len(points) <= count:
        return points
    return points[np.random.default_rng(0).choice(len(points), count, replace=False)]
