"""Local methods of small_gicp (Koide, JOSS 2024): generalised ICP and point-to-plane, coarse to fine."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from gapr_core.baselines.base import Array, Baseline, BaselineTarget, NoPose, require

NEIGHBOURS = 20  # for normals and covariances, the library's default


class _Cloud(NamedTuple):
    points: Any
    tree: Any


class _SmallGicp(Baseline):
    kind = ""

    def __init__(self, name: str, reach_mm: tuple[float, ...] = (20.0, 10.0, 5.0, 3.0), iterations: int = 30) -> None:
        """Aligns with one correspondence distance after another, `reach_mm`, each from the last pose."""
        self.name, self.reach_mm, self.iterations = name, reach_mm, iterations

    def _prepare(self, points: Array, normals: Array | None) -> _Cloud:
        return self._cloud(points)

    def _align(self, source: Array, target: BaselineTarget, seed: Array) -> Array:
        library, cloud, T = self._library(), self._source(source), seed
        for reach in self.reach_mm:
            result = library.align(
                target.static.points, cloud, target.static.tree, T, registration_type=self.kind,
                max_correspondence_distance=reach, max_iterations=self.iterations,
            )  # fmt: skip
            if result.num_inliers < 6:
                raise NoPose(f"{result.num_inliers} correspondences within {reach:g} mm")
            T = np.asarray(result.T_target_source, dtype=np.float64)
        return T

    def _source(self, source: Array) -> Any:
        return self._library().PointCloud(np.ascontiguousarray(source))

    def _cloud(self, points: Array) -> _Cloud:
        library = self._library()
        cloud = library.PointCloud(np.ascontiguousarray(points))
        tree = library.KdTree(cloud)
        library.estimate_normals_covariances(cloud, tree, NEIGHBOURS)
        return _Cloud(cloud, tree)

    def _library(self) -> Any:
        return require("small_gicp", "small_gicp", self.name)


class PointToPlane(_SmallGicp):
    """Point-to-plane ICP with the target's normals."""

    kind = "PLANE_ICP"

    def __init__(self, name: str = "point_to_plane", reach_mm: tuple[float, ...] = (20.0, 10.0, 5.0, 3.0)) -> None:
        super().__init__(name, reach_mm)


class Gicp(_SmallGicp):
    """Generalised ICP: plane to plane, with covariances of both clouds."""

    kind = "GICP"

    def __init__(self, name: str = "gicp", reach_mm: tuple[float, ...] = (20.0, 10.0, 5.0, 3.0)) -> None:
        super().__init__(name, reach_mm)

    def _source(self, source: Array) -> Any:
        return self._cloud(source).points
