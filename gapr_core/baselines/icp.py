"""ICP as the paper compares with it: point to point, from centroid on centroid (Besl and McKay 1992; Open3D)."""

from __future__ import annotations

from typing import Any

import numpy as np

from gapr_core.baselines.base import Array, Baseline, BaselineTarget, NoPose, require


class Icp(Baseline):
    """Every source point pairs with its nearest target point, however far; up to 100 iterations."""

    name = "icp"
    iterations = 100

    def _prepare(self, points: Array, normals: Array | None) -> Any:
        return _cloud(self._library(), points)

    def _align(self, source: Array, target: BaselineTarget, seed: Array) -> Array:
        o3d = self._library()
        registration = o3d.pipelines.registration
        result = registration.registration_icp(
            _cloud(o3d, source), target.static, 4.0 * target.half_extent_mm, seed,
            registration.TransformationEstimationPointToPoint(),
            registration.ICPConvergenceCriteria(max_iteration=self.iterations),
        )  # fmt: skip
        if result.fitness == 0.0:
            raise NoPose("no source point found a target point")
        return np.array(result.transformation)

    def _library(self) -> Any:
        return require("open3d", "open3d", self.name)


def _cloud(o3d: Any, points: Array) -> Any:
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
