"""KISS-Matcher (Lim et al., ICRA 2025): FasterPFH, ROBIN pruning and a graduated non-convexity solver."""

from __future__ import annotations

from typing import Any

import numpy as np

from gapr_core.baselines.base import Array, Baseline, BaselineTarget, NoPose, require
from gapr_core.baselines.refined import Refined
from gapr_core.baselines.small_gicp import PointToPlane

KISS4_VOXELS_MM = (2.5, 3.5, 4.0, 6.0)  # the best four of nine on training subjects at L1 to L3


class KissMatcher(Baseline):
    """KISS-Matcher at one voxel size, mm.

    The library's noise bounds are meant for metres and clamped to 1.0; here the unit is mm, so clamping is off.
    On several cores its poses differ in the last digits from call to call (issue 89 of MIT-SPARK/KISS-Matcher).

    Args:
        voxel_mm: edge of the voxels that thin both clouds; features look at 5 of them.
        keep_invalid: also answer poses that the library itself calls invalid; for compositions that judge them.
    """

    identity_is_failure = True

    def __init__(self, voxel_mm: float = 4.0, name: str = "kiss_matcher", keep_invalid: bool = False) -> None:
        self.voxel_mm, self.name, self.keep_invalid = voxel_mm, name, keep_invalid

    def _prepare(self, points: Array, normals: Array | None) -> list[Array]:
        require("kiss_matcher", "kiss-matcher", self.name)
        return _as_list(points)

    def _align(self, source: Array, target: BaselineTarget, seed: Array) -> Array:
        matcher = self._matcher()
        solution = matcher.estimate(_as_list(source), target.static)
        if not (solution.valid or self.keep_invalid):
            raise NoPose(f"KISS-Matcher kept {matcher.get_num_final_inliers()} correspondences")
        T = np.eye(4)
        T[:3, :3] = np.asarray(solution.rotation, dtype=np.float64)
        T[:3, 3] = np.ravel(solution.translation)
        return T

    def _matcher(self) -> Any:
        library = require("kiss_matcher", "kiss-matcher", self.name)
        return library.KISSMatcher(library.KISSMatcherConfig(self.voxel_mm, enable_noise_bound_clamping=False))


def _as_list(points: Array) -> list[Array]:
    return list(points.astype(np.float32))


def kiss4() -> Refined:
    """KISS-Matcher at four voxel sizes, each refined point-to-plane, the best by residual."""
    coarse = [KissMatcher(voxel, f"kiss_{voxel:g}mm", keep_invalid=True) for voxel in KISS4_VOXELS_MM]
    return Refined(coarse, PointToPlane(), name="kiss4")
