"""Fast point feature histograms (Rusu 2009) with RANSAC, and Fast Global Registration (Zhou 2016), both of Open3D."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, NamedTuple

import numpy as np

from gapr_core.baselines.base import Array, Baseline, BaselineTarget, NoPose, require


class _Features(NamedTuple):
    cloud: Any
    fpfh: Any


class _Fpfh(Baseline):
    """Thins both clouds, orients normals outward (FPFH depends on their signs) and matches histograms."""

    identity_is_failure = True

    def __init__(self, voxel_mm: float = 4.0) -> None:
        self.voxel_mm = voxel_mm

    def _prepare(self, points: Array, normals: Array | None) -> _Features:
        return self._features(points, normals)

    def _align(self, source: Array, target: BaselineTarget, seed: Array) -> Array:
        o3d = self._library()
        features = self._features(source, None)
        if len(features.cloud.points) < 4:
            raise NoPose(f"{len(features.cloud.points)} points left after thinning to {self.voxel_mm:g} mm")
        o3d.utility.random.seed(0)
        result = self._solve(o3d.pipelines.registration, features, target.static)
        if len(result.correspondence_set) < 4:
            raise NoPose(f"{len(result.correspondence_set)} correspondences")
        return np.array(result.transformation)

    @abstractmethod
    def _solve(self, registration: Any, source: _Features, target: _Features) -> Any:
        """Open3D result of aligning the two sets of features."""

    def _features(self, points: Array, normals: Array | None) -> _Features:
        o3d = self._library()
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        if normals is not None:
            cloud.normals = o3d.utility.Vector3dVector(normals)
        cloud = cloud.voxel_down_sample(self.voxel_mm)
        if normals is None:
            self._estimate_outward_normals(o3d, cloud)
        around = o3d.geometry.KDTreeSearchParamHybrid(radius=5.0 * self.voxel_mm, max_nn=100)
        return _Features(cloud, o3d.pipelines.registration.compute_fpfh_feature(cloud, around))

    def _estimate_outward_normals(self, o3d: Any, cloud: Any) -> None:
        """Consistent signs by propagation, then outward as seen from the centroid; good for convex patches too."""
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=2.5 * self.voxel_mm, max_nn=30))
        if len(cloud.points) > 12:
            cloud.orient_normals_consistent_tangent_plane(12)
        points, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
        if ((points - points.mean(axis=0)) * normals).sum() < 0.0:
            cloud.normals = o3d.utility.Vector3dVector(-normals)

    def _library(self) -> Any:
        return require("open3d", "open3d", self.name)


class FpfhRansac(_Fpfh):
    """RANSAC over three FPFH matches at a time, checked by edge length and distance."""

    name = "fpfh_ransac"
    iterations = 100_000

    def _solve(self, registration: Any, source: _Features, target: _Features) -> Any:
        reach = 1.5 * self.voxel_mm
        return registration.registration_ransac_based_on_feature_matching(
            source.cloud, target.cloud, source.fpfh, target.fpfh, False, reach,
            registration.TransformationEstimationPointToPoint(False), 3,
            [registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
             registration.CorrespondenceCheckerBasedOnDistance(reach)],
            registration.RANSACConvergenceCriteria(self.iterations, 0.999),
        )  # fmt: skip


class Fgr(_Fpfh):
    """Graduated non-convexity over mutual FPFH matches, at the clouds' own scale."""

    name = "fgr"

    def _solve(self, registration: Any, source: _Features, target: _Features) -> Any:
        option = registration.FastGlobalRegistrationOption(
            use_absolute_scale=True, decrease_mu=True, maximum_correspondence_distance=1.5 * self.voxel_mm
        )
        return registration.registration_fgr_based_on_feature_matching(
            source.cloud, target.cloud, source.fpfh, target.fpfh, option
        )
