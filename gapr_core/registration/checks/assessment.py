"""The last step: how sure is the best pose? A typed answer on its way to the caller.

Who changes its probability, in this order:

| step | how | where |
|---|---|---|
| calibrated model of the features | sets it | `assess_fit` |
| safety rules | refuse, and leave `rules.ruled_out` at most | `with_refusal`; `rules`, `checks` |
| another copy of the bone | refused where it lies elsewhere | `doubles` |
| a source on both cortices, an inferred camera in a stream | at most so much | `capped` |
| sources before it in a stream | up to its root, or down | `tracking`, `evidence`, `stream_misfit` |
| limits | at most `limits.most` | `limits.applied` |

Thresholds compare it then: `min_confidence`, or `accepted_if_inferred`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import logit

from gapr_core.config import RegistrarConfig, RulesConfig
from gapr_core.geometry import se3
from gapr_core.geometry.twists import predicted_rmse_mm
from gapr_core.registration.checks import rules
from gapr_core.registration.confidence.classifier import Calibration
from gapr_core.registration.confidence.features import measure
from gapr_core.registration.fit import kernels
from gapr_core.registration.fit.refinement import Fit
from gapr_core.registration.fit.verification import Candidates
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.uncertainty import covariance
from gapr_core.registration.uncertainty import target_error as precision
from gapr_core.registration.uncertainty.covariance import PoseUncertainty
from gapr_core.registration.uncertainty.error_calibration import Precision
from gapr_core.results import Hypothesis, LookAnswer, Refusal, RegistrationResult, RegistrationStatus, Residuals

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Assessment:
    """The best pose of a source on a target, and all that is known about it.

    Attributes:
        fit: the refined pose with its residuals.
        candidates: the distinct poses that were compared, best first.
        uncertainty: covariance of the pose.
        features: what the probability was computed from.
        probability: 0 to 1 that the pose is within 4 mm and 5 deg of the truth.
        refusal: what a safety rule says against the pose; None when none does.
        source, target: what was registered to what.
        proposer: name of the last proposer that was asked.
        rounds: how many were asked.
        seen: the whole cloud, where `source` is only the part of it that the pose explains; else None.
        members: (N,) mask of that part in `seen`; None with it.
        viewpoint: (3,) mm, source frame: where `seen` was seen from, of several places their mean; None with it.
        look: (N,) of several looks, which one each point of `source` is of; else None.
        inferred_viewpoint: (3,) mm, source frame: `viewpoint`, where nobody gave it; else None.
        contributions: log odds that each feature adds to the probability's.
        factor95: takes the bound that the covariance gives to what 95 % of the true errors stay below.
        independent_points: independent residuals that the source counts for where `hypotheses` share the probability.
        most: no surer than this, in a stream neither: no such source was calibrated.
        deformed: sizes, mm, of what the points show besides one rigid piece of bone (`rigidity`, `separate_patches`,
            `doubles`), that of the module asked last first, of `rigidity` the surest.
        looks: of several looks, what the pose says of each (`look_agreement`); else ().
    """

    fit: Fit
    candidates: Candidates
    uncertainty: PoseUncertainty
    features: Mapping[str, float]
    probability: float
    refusal: Refusal | None
    source: PreparedSource
    target: PreparedTarget
    proposer: str = ""
    rounds: int = 0
    seen: PreparedSource | None = None
    members: NDArray[np.bool_] | None = None
    viewpoint: Array | None = None
    look: NDArray[np.int64] | None = None
    inferred_viewpoint: Array | None = None
    contributions: Mapping[str, float] = field(default_factory=dict)
    factor95: float = 1.0
    independent_points: float = RulesConfig.independent_points
    most: float = 1.0
    deformed: Mapping[str, float] = field(default_factory=dict)
    looks: tuple[LookAnswer, ...] = ()

    @property
    def centre_mm(self) -> Array:
        """(3,) mean of the source points in the target frame: what the covariance's rotation turns about."""
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
        """95 % bound of the error over points (M, 3) of the target frame, mm; one point for one named target."""
        return self.factor95 * precision.bound_mm(self.uncertainty.covariance, points, self.centre_mm)

    @property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """All distinct poses, best first; the first one is the refined one."""
        poses = (self.fit.T, *self.candidates.poses[1:])
        shares = shared_probability(self.probability, self.candidates.scores, self.independent_points)
        return tuple(map(Hypothesis, poses, shares))

    @property
    def residuals(self) -> Residuals:
        """Of every source point under the best pose."""
        if self.seen is None or self.members is None:
            fit = self.fit.rests_on
            points = self.source.points if fit is self.fit else self.source.whole
            exact = self.target.mesh_distances(se3.apply(fit.T, points))
            return Residuals(points, exact[0] if exact else fit.signed_mm, fit.weights > 0.0)
        exact = self.target.mesh_distances(se3.apply(self.fit.T, self.seen.points))
        on_elements = kernels.residuals_at(self.fit.T, self.seen.points, *self.target.kernel_view, 0.0)[0]
        distance_mm = exact[0] if exact else on_elements
        counts = np.zeros(len(self.members), dtype=bool)
        counts[self.members] = self.fit.weights > 0.0
        return Residuals(self.seen.points, distance_mm, counts)

    def reaches(self, limit: float) -> bool:
        """True when no rule speaks against the pose and its probability reaches `limit`."""
        return self.refusal is None and self.probability >= limit

    def corrected(self, learned: Precision) -> Assessment:
        """The same with the covariance and the bound scaled by what was learned from errors of known size."""
        variance_scale = learned.scale(self.features, self.tre_mm) ** 2
        covariance = variance_scale * self.uncertainty.covariance
        return replace(self, uncertainty=replace(self.uncertainty, covariance=covariance), factor95=learned.factor95)

    def with_refusal(self, refusal: Refusal | None, config: RulesConfig) -> Assessment:
        """The same with what a rule says against it, if it says anything, and the probability that is left then."""
        if refusal is None:
            return self
        return replace(self, refusal=refusal, probability=min(self.probability, config.ruled_out))

    def capped(self, most: float, by: str = "") -> Assessment:
        """The same with a probability of at most `most`; what that takes off its log odds stands under `by`."""
        if not self.probability > most:
            return self
        contributions = dict(self.contributions)
        if by:
            contributions[by] = contributions.get(by, 0.0) + float(logit(most) - logit(self.probability))
        return replace(self, probability=most, contributions=contributions)


def assess_fit(
    fit: Fit,
    candidates: Candidates,
    source: PreparedSource,
    target: PreparedTarget,
    calibration: Calibration,
    config: RegistrarConfig,
) -> Assessment:
    """Covariance, features, probability, and what the safety rules say."""
    uncertainty = covariance.estimate(fit, config.covariance, config.sensor, source.around)
    features = measure(fit, candidates, uncertainty, source, target, config)
    return judge(fit, candidates, uncertainty, features, source, target, calibration, config)


def judge(
    fit: Fit,
    candidates: Candidates,
    uncertainty: PoseUncertainty,
    features: Mapping[str, float],
    source: PreparedSource,
    target: PreparedTarget,
    calibration: Calibration,
    config: RegistrarConfig,
) -> Assessment:
    """The probability of a pose with these features, and what the safety rules say."""
    probability = calibration.probability(features)
    refusal = rules.by_geometry(fit, candidates, uncertainty, probability, source, target, config)
    refusal = refusal or rules.by_size(features, config.rules)
    assessment = Assessment(
        fit,
        candidates,
        uncertainty,
        features,
        probability,
        None,
        source,
        target,
        contributions=calibration.contributions(features),
        independent_points=config.rules.independent_points,
    )
    return assessment.with_refusal(refusal, config.rules)


def shared_probability(best: float, scores: Array, independent_points: float) -> tuple[float, ...]:
    """Probabilities of ranked hypotheses.

    A rival's likelihood relative to the best is exp(-n / 2 (s / s_best - 1)): that of n independent residuals whose
    variance is the best one's mean square. What the best leaves of 1 is shared in these proportions, but no rival gets
    more than its likelihood times the best one's probability.

    Args:
        best: probability of the best, 0 to 1.
        scores: (K,) mean squares of the residuals, mm^2, best first.
        independent_points: n, 0 or more.
    """
    likelihood = np.exp(-0.5 * independent_points * np.maximum(scores[1:] / scores[0] - 1.0, 0.0))
    share = min(best, (1.0 - best) / max(float(likelihood.sum()), 1e-12))
    return (best, *(share * likelihood))


def answer(assessment: Assessment, config: RegistrarConfig, since: str = "") -> RegistrationResult:
    """What the caller gets: a pose where neither a rule nor a threshold refuses, else the reason.

    Args:
        assessment: the answer.
        config: what is asked for.
        since: why more is than the caller set, for the reason.
    """
    a, tre95_mm = assessment, assessment.tre95_mm
    refusal = a.refusal or rules.by_threshold(a.probability, tre95_mm, config, a.contributions, since)
    common = RegistrationResult(
        status=RegistrationStatus.LOW_CONFIDENCE,
        confidence=a.probability,
        inlier_ratio=a.features["inlier_ratio"],
        hypotheses=a.hypotheses,
        proposer=a.proposer,
        rounds=a.rounds,
        features=a.features,
        contributions=a.contributions,
        residuals=a.residuals,
        inferred_viewpoint=a.inferred_viewpoint,
        looks=a.looks,
    )
    if refusal is not None:
        return replace(common, status=refusal.status, reason=refusal.reason)
    return replace(
        common,
        status=RegistrationStatus.OK,
        T_target_source=a.fit.T,
        covariance=a.uncertainty.covariance,
        tre_mm=a.tre_mm,
        tre95_mm=tre95_mm,
        factor95=a.factor95,
        centre_mm=a.centre_mm,
    )
