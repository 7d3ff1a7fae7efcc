"""Verification: from many hypotheses to a few distinct, refined and ranked poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gapr_core.config import VerificationConfig
from gapr_core.registration.fit.kernels import distinct
from gapr_core.registration.fit.refinement import refine_many
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Candidates:
    """Distinct poses that explain the source, best first."""

    poses: Array  # (K, 4, 4) T_target_source, mm
    # (K,) small is good: mean squared distance of the drawn source points, truncated, mm^2; of a camera's cloud 1 / the
    # score of lines of sight
    scores: Array
    support: Array  # (K,) share of the hypotheses refined halfway that ended within `same_pose_mm` of the pose
    hypotheses: int = 1  # number of those that competed


def verify(
    poses: Array, source: PreparedSource, target: PreparedTarget, config: VerificationConfig, num_threads: int = 0
) -> Candidates:
    """Refine all poses on a few points, the distinct best on more, and the best of those on all.

    Args:
        poses: (K, 4, 4) hypotheses T_target_source, mm, K >= 1.
        source: the prepared source.
        target: the prepared target.
        config: numbers of points and poses of each stage.
        num_threads: 0 for all cores.
    """
    count = len(poses)
    few, some = source.subset(config.coarse_points), source.subset(config.middle_points)
    poses, scores = refine_many(poses, few, target, np.linspace(*config.coarse_limits_mm), num_threads)
    poses = _distinct(poses, scores, source, config, config.middle_poses)[0]
    poses, scores = refine_many(poses, some, target, np.linspace(*config.middle_limits_mm), num_threads)
    crowd = poses
    poses = _distinct(poses, scores, source, config, config.final_poses)[0]
    poses, scores = refine_many(poses, source.points, target, np.linspace(*config.final_limits_mm), num_threads)
    poses, scores = _distinct(poses, scores, source, config, config.final_poses)
    shares = support(poses, crowd, source, config.markers, config.same_pose_mm)
    return Candidates(poses, scores, shares, count)


def support(poses: Array, crowd: Array, source: PreparedSource, count: int, same_pose_mm: float) -> Array:
    """Compute the (K,) share of the crowd (M, 4, 4) within `same_pose_mm` of each pose, over `count` markers."""
    ends, others = (markers(T, source, count) for T in (poses, crowd))
    gaps = np.linalg.norm(ends[:, None] - others[None], axis=3)
    return np.asarray((np.sqrt((gaps**2).mean(axis=2)) < same_pose_mm).mean(axis=1))


def _distinct(
    poses: Array, scores: Array, source: PreparedSource, config: VerificationConfig, most: int
) -> tuple[Array, Array]:
    """Select the best poses, none within `same_pose_mm` (root mean square over the markers) of a better one."""
    ranked = np.argsort(scores, kind="stable")
    kept = distinct(markers(poses, source, config.markers), ranked, config.same_pose_mm, most)
    return poses[kept], scores[kept]


def markers(poses: Array, source: PreparedSource, count: int) -> Array:
    """Move the same spread points of a source (N, 3) by poses: (K, min(count, N), 3), mm, target frame."""
    return np.asarray(np.einsum("kij,nj->kni", poses[:, :3, :3], source.subset(count)) + poses[:, None, :3, 3])
