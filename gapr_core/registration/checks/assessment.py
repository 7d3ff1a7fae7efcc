"""The assessment of a pose: its fit, its two numbers, and the findings of the checks; `conclude` folds them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from gapr_core.geometry import se3
from gapr_core.geometry.twists import bound_mm, predicted_rmse_mm
from gapr_core.registration.confidence.classifier import Judgement, joint
from gapr_core.registration.fit import kernels
from gapr_core.registration.fit.refinement import Fit
from gapr_core.registration.fit.verification import Candidates
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.uncertainty.covariance import PoseUncertainty
from gapr_core.registration.uncertainty.error_calibration import Precision
from gapr_core.results import Effect, Finding, Hypothesis, LookAnswer, Residuals

Array = NDArray[np.float64]

INDEPENDENT_POINTS = 30.0  # independent residuals of a source, where hypotheses share the probability


@dataclass(frozen=True, eq=False)
class Assessment:
    """The best pose of a source on a target, and everything known about it."""

    fit: Fit  # the refined pose with its residuals
    candidates: Candidates  # the compared distinct poses, best first
    uncertainty: PoseUncertainty  # covariance of the pose
    features: Mapping[str, float]  # measurements from which the two numbers are computed
    judgement: Judgement  # the two numbers, and the log odds that each feature adds to the first
    other_bone_prior: float  # probability, before the data, that the source is of another subject's bone
    source: PreparedSource
    target: PreparedTarget
    findings: tuple[Finding, ...] = ()  # of the checks, in their order
    proposer: str = ""  # name of the last proposer used
    rounds: int = 0  # number of proposers used
    seen: PreparedSource | None = None  # the whole cloud, where `source` is only the part that the pose explains
    members: NDArray[np.bool_] | None = None  # (N,) mask of that part in `seen`; None with it
    viewpoint: Array | None = None  # (3,) mm, source frame: place of the camera of `seen`, the mean of several
    look: NDArray[np.int64] | None = None  # (N,) number of the look that each point of `source` is of; None for one
    inferred_viewpoint: Array | None = None  # (3,) mm, source frame: `viewpoint`, if it was inferred
    factor95: float = 1.0  # bound of 95 % of the true errors, over that of the covariance
    looks: tuple[LookAnswer, ...] = field(default=())  # fit of each of several looks (`look_agreement`)

    @property
    def confidence(self) -> float:
        """Probability, 0 to 1, of the right pose on the right bone."""
        return joint(self.judgement, self.other_bone_prior)

    @property
    def refusal(self) -> Finding | None:
        """First finding that refuses the pose; None without one."""
        return next((each for each in self.findings if each.effect is Effect.REFUSE), None)

    @property
    def centre_mm(self) -> Array:
        """(3,) mean of the source points in the target frame: the centre of rotation of the covariance."""
        return np.asarray(self.fit.moved.mean(axis=0))

    @property
    def tre_mm(self) -> float:
        """Expected error, root mean square over the bone, mm."""
        return predicted_rmse_mm(self.uncertainty.covariance, self.target.points, self.centre_mm)

    @property
    def tre95_mm(self) -> float:
        """95 % bound of the error over the bone, mm."""
        return self.bound_mm(self.target.points)

    def bound_mm(self, points: Array) -> float:
        """Bound the error over points (M, 3) of the target frame at 95 %, mm; one point for one named target."""
        return self.factor95 * bound_mm(self.uncertainty.covariance, points, self.centre_mm)

    @property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """Distinct poses, best first; the first one is the refined pose."""
        poses = (self.fit.T, *self.candidates.poses[1:])
        return tuple(map(Hypothesis, poses, shared_probability(self.confidence, self.candidates.scores)))

    @property
    def residuals(self) -> Residuals:
        """Residuals of every source point under the best pose."""
        if self.seen is None or self.members is None:
            fit = self.fit.full_fit
            points = self.source.points if fit is self.fit else self.source.whole
            on_elements, counts = fit.signed_mm, fit.counts
        else:
            fit, points = self.fit, self.seen.points
            on_elements = kernels.residuals_at(fit.T, points, *self.target.kernel_view, 0.0)[0]
            counts = np.zeros(len(self.members), dtype=bool)
            counts[self.members] = fit.counts
        exact = self.target.mesh_distances(se3.apply(fit.T, points))
        return Residuals(points, exact[0] if exact else on_elements, counts)

    def reaches(self, limit: float) -> bool:
        """Return True when no finding refuses the pose and its confidence reaches `limit`."""
        return self.refusal is None and self.confidence >= limit

    def with_finding(self, finding: Finding, added: Array | None = None) -> Assessment:
        """Add a finding; `added` (6, 6) joins the covariance of one that widens it."""
        wider = self.uncertainty if added is None else self.uncertainty.with_more(added)
        return replace(self, findings=(*self.findings, finding), uncertainty=wider)

    def corrected(self, learned: Precision) -> Assessment:
        """Scale the covariance and the bound by the learned errors."""
        variance_scale = learned.scale(self.features, self.tre_mm) ** 2
        covariance = variance_scale * self.uncertainty.covariance
        factor95 = learned.factor95(self.confidence)
        return replace(self, uncertainty=replace(self.uncertainty, covariance=covariance), factor95=factor95)


def shared_probability(best: float, scores: Array) -> tuple[float, ...]:
    """Share the remainder of the best hypothesis's probability among its rivals, by their likelihoods.

    A rival's likelihood relative to the best is exp(-n / 2 (s / s_best - 1)): that of n independent residuals whose
    variance is the best one's mean square. No rival gets more than its likelihood times the best one's probability.

    Args:
        best: probability of the best, 0 to 1.
        scores: (K,) mean squares s of the residuals, mm^2, best first.
    """
    likelihood = np.exp(-0.5 * INDEPENDENT_POINTS * np.maximum(scores[1:] / scores[0] - 1.0, 0.0))
    share = min(best, (1.0 - best) / max(float(likelihood.sum()), 1e-12))
    return (best, *(share * likelihood))
