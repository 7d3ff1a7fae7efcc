"""The cheap step between two assessments: the last sure pose, refined on a part of a newer source.

Nothing is compared with the pose and none of the safety rules is asked, so it has no confidence. It stands only near
one that was assessed: for a few sources, while the bound of its error is small, the source fits as the assessed one
did, and the bone does not jump. In all other cases there is no pose, and the source has to be assessed.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.clouds import finite_points
from gapr_core.config import RegistrarConfig
from gapr_core.geometry import sampling, se3
from gapr_core.geometry.twists import predicted_rmse_mm
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.fit.refinement import Fit, distances_mm, refine_fully, refine_many, tukey_limit
from gapr_core.registration.streams.evidence import AGREE_MM
from gapr_core.registration.uncertainty.linear_model import POSE_PRIOR

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

POINTS, MOST_SOURCES = 1000, 5  # points that are refined; sources in a row that are followed
LARGEST_TRE95_MM, LARGEST_TURN_DEG = 4.0, 2.5  # of the error's bound, and of the least certain turn
LARGEST_RESIDUAL, LEAST_INLIERS = 1.1, 0.95  # over those of the assessed source


@dataclass(frozen=True, eq=False)
class FollowedPose:
    """Where a bone is that was found before. It is not assessed: to be shown, and no answer to act on.

    Attributes:
        T_target_source: (4, 4) rigid transform, source to target frame, mm.
        inlier_ratio: share, 0 to 1, of the points it was refined on that lie on the bone.
        residual_mm: root mean square distance of these to the surface, mm.
        since_assessed: sources since the last one that was assessed, this one included.
    """

    T_target_source: Array
    inlier_ratio: float
    residual_mm: float
    since_assessed: int


@dataclass(frozen=True, eq=False)
class PartialFit:
    """How a part of a source lies on the target.

    Attributes:
        T: (4, 4) T_target_source, mm.
        moved_mm: root mean square distance of its points to where the pose before puts them.
        inlier_ratio, residual_mm: as in `FollowedPose`.
        spread_mm: error over the bone to expect of these points by their noise alone, root mean square.
    """

    T: Array
    moved_mm: float
    inlier_ratio: float
    residual_mm: float
    spread_mm: float


class Follower:
    """Carries the pose of an assessed source on to those that come after it.

    Args:
        assessment: of a source that was accepted and is sure.
        source: (N, 3), mm, this source as it was given.
        config: every setting of the registrar.
    """

    def __init__(self, assessment: Assessment, source: ArrayLike, config: RegistrarConfig) -> None:
        self._assessment, self._source, self._config = assessment, finite_points(source), config
        self._limit_mm = tukey_limit(assessment.fit.signed_mm, assessment.fit.sigma_mm, config.refinement)
        self._T, self._since = assessment.fit.T, 0

    def follow(self, source: ArrayLike) -> FollowedPose | None:
        """The pose of the next source (N, 3), mm; None where it has to be assessed.

        Raises:
            InvalidPointCloudError: wrong shape or type.
        """
        points = finite_points(source)
        if self._since >= MOST_SOURCES or len(points) < self._config.source.fewest_points:
            return None
        fit = self._fit_part(points, self._T)
        if why := self.why_not(fit):
            log.debug("a source has to be assessed: %s", why)
            return None
        self._T, self._since = fit.T, self._since + 1
        return FollowedPose(fit.T.copy(), fit.inlier_ratio, fit.residual_mm, self._since)

    def motion(self) -> Array:
        """(4, 4) how the source has moved since it was assessed, inv(T_then) T_now, mm."""
        return se3.inverse(self._assessment.fit.T) @ self._T

    def why_not(self, fit: PartialFit) -> str:
        """Why the source has to be assessed; empty where its pose may be followed."""
        then, a = self._assessed, self._assessment
        looser = fit.spread_mm / then.spread_mm
        largest_mm = min(LARGEST_TRE95_MM, self._config.max_tre_mm or np.inf)
        then_mm = max(then.residual_mm, self._config.refinement.smallest_sigma_mm)
        rules = {
            "the assessed pose is left": then.inlier_ratio > 0.0 and then.moved_mm <= self._tre95_mm,
            "the bone moved too far": fit.moved_mm <= AGREE_MM,
            "less of the source lies on the bone": fit.inlier_ratio >= LEAST_INLIERS * then.inlier_ratio,
            "the residuals are larger": fit.residual_mm <= LARGEST_RESIDUAL * then_mm,
            "the error over the bone is not bounded": looser * self._tre95_mm <= largest_mm,
            "a turn is not observed": looser * a.uncertainty.largest_turn_deg <= LARGEST_TURN_DEG,
        }
        return next((why for why, holds in rules.items() if not holds), "")

    @cached_property
    def _tre95_mm(self) -> float:
        return self._assessment.tre95_mm

    @cached_property
    def _assessed(self) -> PartialFit:
        """The assessed source, refined as those that follow."""
        return self._fit_part(self._source, self._assessment.fit.T)

    def _fit_part(self, source: Array, T: Array) -> PartialFit:
        """Refine a pose on a part of a source (N, 3), mm: without neighbours, which take most of the time."""
        config, target = self._config, self._assessment.target
        points = self._thinned(source)
        coarse_mm = np.linspace(*config.verification.coarse_limits_mm)
        near = refine_many(T[None], points, target, coarse_mm, num_threads=1)[0][0]
        fit = refine_fully(near, points, target, config.refinement, np.arange(len(points))[:, None])
        return self._described(fit, se3.rms_apart_mm(fit.T, T, points), points)

    def _thinned(self, source: Array) -> Array:
        some = source[:: 1 + len(source) // self._config.source.most_compared]
        return some[sampling.thin(some, POINTS)]

    def _described(self, fit: Fit, moved_mm: float, points: Array) -> PartialFit:
        """What the limits are set for, by the weights that the assessed source had."""
        a = self._assessment
        distance_mm = distances_mm(fit.T, points, a.target)
        on_bone = distance_mm[distance_mm < self._limit_mm]
        residual_mm = float(np.sqrt((on_bone**2).mean())) if len(on_bone) else np.inf
        return PartialFit(fit.T, moved_mm, len(on_bone) / len(points), residual_mm, self._spread_mm(fit))

    def _spread_mm(self, fit: Fit) -> float:
        """Expected error over the bone under s^2 (J^T W J + P)^-1, with the noise s of the assessed source."""
        a, J = self._assessment, fit.jacobian
        covariance = a.fit.sigma_mm**2 * np.linalg.inv((J * fit.weights[:, None]).T @ J + POSE_PRIOR)
        return predicted_rmse_mm(covariance, a.target.points, fit.moved.mean(axis=0))
