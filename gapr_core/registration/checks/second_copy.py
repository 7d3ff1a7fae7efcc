"""Is the bone in a source twice? It or its reference moved between two passes, or a sweep lags behind its tracker.

The robust fit then takes one copy for the bone and the other one for outliers, and is sure of the first. So the points
that it rejects are registered by themselves: outliers, tissue and instruments have no pose on the bone, a second copy
has. Which of the two is right nobody knows: where they differ, the answer is refused, or where the second is doubtful,
as probable as its share of their points.
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
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.fit.refinement import evaluate, refine_many
from gapr_core.registration.problem import source as sources
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.results import Refusal, RegistrationStatus

Array = NDArray[np.float64]
Register = Callable[[PreparedSource, Array], Assessment | None]  # of a source and poses (K, 4, 4) to begin with

NAME = "doubled"
LIMITS_MM = np.array([20.0, 15.0, 10.0, 7.0, 5.0, 4.0, 3.0, 2.0])  # scale of the weights in each step of the first look
LOOKED_AT = 500  # points, in the first look
AS_PRECISE = 1.2  # a copy spreads about the bone by so many times the answer's residuals at most; outliers by 1.3 to 5
SURE_COPY = 0.8  # after knocks against references of train subjects copies have .87 and more, but for one of 17
ON_BONE = 0.6  # share of the rejected points that count for their pose


def allowing_for_a_copy(assessment: Assessment, config: RegistrarConfig, register: Register) -> Assessment:
    """The same; where its rejected points are another copy of the bone, with the way there, refused if that is long.

    Near the answer a copy is looked for first, which costs little. Only where much is rejected it may lie anywhere, but
    not in a camera's cloud, where tissue is rejected. The way goes into the covariance. A pose that is not right if the
    copy is, more than 4 mm or 5 deg away, is refused where the copy is sure: in which of the two the bone is now nobody
    knows.

    Args:
        assessment: an answer that may be accepted.
        config: how many points are asked, and how sure they have to be.
        register: a source in full, the poses among its hypotheses.
    """
    a, limits = assessment, config.rigidity
    residuals = a.residuals
    rejected = residuals.points[~residuals.inlier]
    if len(rejected) < limits.rejected_points:
        return a
    T = _elsewhere(a, rejected, config)
    rejects_much = len(rejected) >= limits.doubled_share * len(residuals.points)
    if T is None and (a.seen is not None or not rejects_much):
        return a
    found = _registered(rejected, a.fit.T[None] if T is None else np.stack([T, a.fit.T]), config, register)
    if found is None:
        return a
    on_bone = float((found.fit.rests_on.weights > 0.0).mean())
    is_same = se3.pose_error(found.fit.T, a.fit.T, found.source.points).is_right
    if found.probability < limits.doubled or on_bone < ON_BONE:
        return a
    if T is None and (is_same or found.fit.sigma_mm > AS_PRECISE * a.fit.sigma_mm):
        return a
    own, others = len(residuals.points) - len(rejected), on_bone * len(rejected)
    both = _with_copy(a, found, 1.0 if is_same else own / (own + others))
    is_refused = not is_same and found.probability >= SURE_COPY
    return both.with_refusal(_in_two_poses(a, found) if is_refused else None, config.rules)


def is_in_two_poses(assessment: Assessment) -> bool:
    """True where a source was refused for a copy of the bone."""
    refusal = assessment.refusal
    return NAME in assessment.deformed and refusal is not None and refusal.status is RegistrationStatus.AMBIGUOUS


def _in_two_poses(assessment: Assessment, copy: Assessment) -> Refusal:
    shift_mm, turn_deg = se3.pose_error(copy.fit.T, assessment.fit.T, assessment.source.points)
    reason = (
        f"the points that do not fit lie on the bone in another pose, {shift_mm:.0f} mm and {turn_deg:.0f} deg away"
    )
    how = "did the bone, its reference or the sensor move meanwhile? Measure it again; if it stays, is it this bone?"
    return Refusal(RegistrationStatus.AMBIGUOUS, f"{reason}: {how}")


def _with_copy(assessment: Assessment, copy: Assessment, share: float) -> Assessment:
    """The same with the way to a copy in its covariance, and no more probable than its share of both one's points."""
    a = assessment
    twist = error_twist(copy.fit.T, a.fit.T, a.source.points)
    uncertainty = a.uncertainty.with_more(np.outer(twist, twist))
    deformed = {NAME: se3.rms_apart_mm(copy.fit.T, a.fit.T, a.source.points), **a.deformed}
    return replace(a.capped(share, NAME), uncertainty=uncertainty, deformed=deformed, most=min(a.most, share))


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
