"""Is the bone in a source twice? It or its reference moved between two passes, or a sweep lags behind its tracker.

The robust fit then takes one copy for the bone and the other one for outliers, and is sure of the first. So the points
that it rejects are registered by themselves, from where it lies: outliers, tissue and instruments have no pose there, a
second copy of the bone has. Which of the two is right nobody knows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gapr_core.config import RegistrarConfig
from gapr_core.errors import InvalidPointCloudError
from gapr_core.geometry import se3
from gapr_core.geometry.twists import error_twist
from gapr_core.registration import source as sources
from gapr_core.registration.assessment import Assessment
from gapr_core.registration.refinement import evaluate, refine_many
from gapr_core.registration.source import PreparedSource
from gapr_core.results import Refusal

Array = NDArray[np.float64]
Register = Callable[[PreparedSource, Array], Assessment | None]  # of a source and poses (K, 4, 4) to begin with

NAME = "doubled"
LIMITS_MM = np.array([20.0, 15.0, 10.0, 7.0, 5.0, 4.0, 3.0, 2.0])  # scale of the weights in each step of the first look
LOOKED_AT = 500  # points, in the first look
AS_PRECISE = 1.2  # a copy spreads about the bone by so many times the answer's residuals at most; outliers by 1.3 to 5
ON_BONE = 0.6  # share of the rejected points that count for their pose


def allowing_for_a_copy(assessment: Assessment, config: RegistrarConfig, register: Register) -> Assessment:
    """The same; where its rejected points are another copy of the bone, with the way there in its covariance.

    What else than bone is in a camera's cloud is rejected anyway: it is not asked.

    Args:
        assessment: an answer that may be accepted.
        config: how many points are asked, and how sure they have to be.
        register: a source in full, the poses among its hypotheses.
    """
    a, limits = assessment, config.rigidity
    if a.seen is not None:
        return a
    residuals = a.residuals
    rejected = residuals.points[~residuals.inlier]
    if len(rejected) < limits.rejected_points:
        return a
    T = _elsewhere(a, rejected, config)
    found = None if T is None else _registered(rejected, np.stack([T, a.fit.T]), config, register)
    if found is None or not _is_copy(found, a, config):
        return a
    twist = error_twist(found.fit.T, a.fit.T, a.source.points)
    covariance = a.uncertainty.covariance + np.outer(twist, twist)
    apart_mm = se3.rms_apart_mm(found.fit.T, a.fit.T, a.source.points)
    deformed = {NAME: apart_mm, **a.deformed}
    return replace(a, uncertainty=replace(a.uncertainty, covariance=covariance), deformed=deformed)


def _elsewhere(assessment: Assessment, rejected: Array, config: RegistrarConfig) -> Array | None:
    """The pose (4, 4) near the answer's in which rejected points (N, 3) lie on the bone as the others do, or None."""
    a = assessment
    some = rejected[:: -(-len(rejected) // LOOKED_AT)]
    T = refine_many(a.fit.T[None], some, a.target, LIMITS_MM, config.num_threads)[0][0]
    sigma_mm = evaluate(T, some, a.target, config.refinement).sigma_mm
    return T if sigma_mm <= AS_PRECISE * a.fit.sigma_mm else None


def _registered(points: Array, poses: Array, config: RegistrarConfig, register: Register) -> Assessment | None:
    """The points as a source of their own, from these poses on; None of a line, or of a heap too small for a piece."""
    try:
        prepared = sources.prepare(points, config.source, config.num_threads)
    except InvalidPointCloudError:
        return None
    return None if isinstance(prepared, Refusal) else register(prepared, poses)


def _is_copy(found: Assessment, assessment: Assessment, config: RegistrarConfig) -> bool:
    """Whether the pose of the rejected points is sure enough, is theirs, and is not far from the answer's."""
    limits = config.rigidity
    apart = se3.pose_error(found.fit.T, assessment.fit.T, found.source.points)
    on_bone = (found.fit.rests_on.weights > 0.0).mean()
    return bool(
        found.probability >= limits.doubled
        and on_bone >= ON_BONE
        and apart.within(limits.doubled_mm, limits.doubled_deg)
    )
