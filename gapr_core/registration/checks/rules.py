"""The safety rules: what refuses a pose, whatever its probability. Each rule refuses alone.

Six rules do not weigh the probability: a motion that is not observed, a pose that can be pushed aside, a rival that is
as good, a source of another size by small changes and by larger ones, a source whose mirror image fits better. Pushing,
growing and mirroring cost time: they are done only where the pose may still be accepted. A seventh, a source that fits
better off the bone, is in `standoff`; an eighth, a second copy of the bone among the points that do not fit, in
`doubles`. Two rules are the user's thresholds: `min_confidence` and `max_tre_mm`.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from gapr_core.clouds import EXTENT_LIMITS_MM, MM_PER_UNIT, PLAUSIBLE
from gapr_core.config import RegistrarConfig, RulesConfig
from gapr_core.geometry import extent, se3
from gapr_core.registration.checks import feature_labels as words
from gapr_core.registration.fit.other_size import HALFWAY
from gapr_core.registration.fit.refinement import Fit, refine_many
from gapr_core.registration.fit.verification import Candidates
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.uncertainty.covariance import PoseUncertainty
from gapr_core.results import Refusal, RegistrationStatus, confidence_text
from gapr_core.surface import Surface

Array = NDArray[np.float64]

OTHER_UNITS = {unit: mm for unit, mm in MM_PER_UNIT.items() if unit in ("m", "cm")}  # that are taken for mm by mistake
HALF_TURN_DEG = 180.0


def by_geometry(
    fit: Fit,
    candidates: Candidates,
    uncertainty: PoseUncertainty,
    probability: float,
    source: PreparedSource,
    target: PreparedTarget,
    config: RegistrarConfig,
) -> Refusal | None:
    """Why the pose may as well be another one; None when no rule says so.

    The costly rule, which pushes the pose, is asked for only where the pose may be accepted otherwise.
    """
    if has_unobserved_motion(uncertainty, config.rules):
        return Refusal(RegistrationStatus.DEGENERATE, _what_is_not_observed(uncertainty))
    if has_equal_rival(candidates, config.rules):
        return Refusal(RegistrationStatus.AMBIGUOUS, _which_rival(candidates, source))
    is_worth_it = probability >= config.worth_checking
    if is_worth_it and can_be_pushed(fit, source, target, config):
        return Refusal(
            RegistrationStatus.DEGENERATE,
            "a pose a few mm away fits as well: the observed surface is flat or straight",
        )
    return None


def asking_the_unit(refusal: Refusal, source: Array, target: Array) -> Refusal:
    """The refusal; where the cloud would have the bone's size in another unit, it also asks for the unit.

    A short scan of a long bone is as small as a whole one in cm that is taken for mm: no rule can tell them apart.

    Args:
        refusal: any; only DEGENERATE gets the question.
        source, target: (N, 3) and (M, 3), mm, as they are read now.
    """
    if refusal.status is not RegistrationStatus.DEGENERATE:
        return refusal
    low, high = PLAUSIBLE
    extent_mm, target_extent_mm = Surface(source).extent_mm, Surface(target).extent_mm
    shares = {unit: extent_mm * mm / target_extent_mm for unit, mm in OTHER_UNITS.items()}
    unit = next((unit for unit, share in shares.items() if low <= share <= high), None)
    if unit is None:
        return refusal
    sizes = f"the cloud is {extent_mm:.3g} mm across, the bone {target_extent_mm:.3g} mm"
    return Refusal(refusal.status, f"{refusal.reason}; {sizes}: is the cloud in {unit}?")


def by_size(features: Mapping[str, float], rules: RulesConfig) -> Refusal | None:
    """Why the source is not of this bone but of a larger or smaller one; None when its size agrees.

    Args:
        features: of the answer (`features.OTHER_BONE`): how far the size is off, in standard deviations.
        rules: from how many on.
    """
    if not features["scale_z"] > rules.largest_scale_z:
        return None
    reason = f"the source fits best in another size ({features['scale_z']:.1f} standard deviations off)"
    return Refusal(RegistrationStatus.LOW_CONFIDENCE, f"{reason}: is it of this bone, and is its scale right?")


def by_growth(log_ratio: float, rules: RulesConfig) -> Refusal | None:
    """Why the source is larger or smaller than this bone's; None where it fits no better grown or shrunk.

    Args:
        log_ratio: log of the mean square residual of the source in the better of two other sizes over that in its own.
        rules: how much better another size may fit.
    """
    if not log_ratio < -rules.other_size_better:
        return None
    reason = f"the source fits the bone better grown or shrunk by {100.0 * (HALFWAY[1] - 1.0):.3g} %"
    return Refusal(RegistrationStatus.LOW_CONFIDENCE, f"{reason}: is it of this bone, and is its scale right?")


def by_mirror(log_ratio: float, rules: RulesConfig) -> Refusal | None:
    """Why the source is of the other side of the body, or flipped; None where its mirror image fits no better.

    Args:
        log_ratio: log of the mean square residual of the mirrored source over that of the source (`mirror`).
        rules: how much better a mirrored source may fit.
    """
    if not log_ratio < -rules.mirrored_better:
        return None
    reason = "the mirror image of the source fits the bone better"
    question = "is it of the other side of the body, or was a scan flipped from left to right?"
    return Refusal(RegistrationStatus.LOW_CONFIDENCE, f"{reason}: {question}")


def by_threshold(
    probability: float,
    tre95_mm: float,
    config: RegistrarConfig,
    contributions: Mapping[str, float] | None = None,
    since: str = "",
) -> Refusal | None:
    """Why the pose does not meet what the user asks for; None when it does. A probability of NaN does not.

    Args:
        probability: 0 to 1.
        tre95_mm: bound of the error over the bone.
        config: what is asked for.
        contributions: log odds that each feature adds, of which the reason names the worst.
        since: why so much is asked for, where it is not what the user set.
    """
    if not probability >= config.min_confidence:
        worst, asked = words.against(contributions or {}), f"{config.min_confidence:g} is asked for{since}"
        reason = f"the best pose is right with a probability of only {confidence_text(probability)}, {asked}"
        return Refusal(RegistrationStatus.LOW_CONFIDENCE, f"{reason}; against it: {worst}" if worst else reason)
    if config.max_tre_mm > 0.0 and not tre95_mm <= config.max_tre_mm:
        reason = f"the error over the bone is below {tre95_mm:.1f} mm (95 %), allowed are {config.max_tre_mm:g} mm"
        return Refusal(RegistrationStatus.IMPRECISE, reason)
    return None


def has_equal_rival(candidates: Candidates, rules: RulesConfig) -> bool:
    """True when a distinct pose explains the source as well as the best one.

    The limits are those of mean squares in mm^2; the scores of a camera's cloud, which are none, are held to them too.
    """
    scores = candidates.scores
    return len(scores) > 1 and bool(scores[1] < _as_good(scores[0], rules))


def has_unobserved_motion(uncertainty: PoseUncertainty, rules: RulesConfig) -> bool:
    """True when a direction of motion is not observed: a spin about a shaft, a slide along it."""
    turn_deg, shift_mm = uncertainty.largest_turn_deg, uncertainty.largest_shift_mm
    return turn_deg > rules.largest_turn_deg or shift_mm > rules.largest_shift_mm


def can_be_pushed(
    fit: Fit,
    source: PreparedSource,
    target: PreparedTarget,
    config: RegistrarConfig,
) -> bool:
    """True when the pose, pushed along its least certain motions, rests elsewhere and explains the source as well.

    A hypothesis in a flat valley stays where it began, so none of the others shows that the valley is there; and what
    the surface elements of a plane seem to say about a slide is the noise of their normals.
    """
    rules, verification = config.rules, config.verification
    some = source.subset(verification.middle_points)
    pushes = _weakest_motions(fit, rules.pushed_motions) * rules.push * verification.same_pose_mm
    centre = fit.moved.mean(axis=0)
    poses = np.array([fit.T, *(se3.exp(sign * push, centre) @ fit.T for push in pushes for sign in (1.0, -1.0))])
    limits_mm = np.linspace(*verification.final_limits_mm)
    rested, scores = refine_many(poses, some, target, limits_mm, config.num_threads)
    apart = np.array([se3.rms_apart_mm(T, rested[0], some) for T in rested])
    elsewhere = apart >= verification.same_pose_mm
    return bool((scores[elsewhere] < _as_good(scores[0], rules)).any())


def _as_good(score: float, rules: RulesConfig) -> float:
    """Mean square, mm^2, below which another pose explains the source as well as one of this mean square.

    Above 2 mm of noise a small share is chance. Below it is the target's own roughness that decides between such poses:
    terraces of voxels, or what a smooth element leaves of an edge.
    """
    return max((1.0 + rules.equal_share) * score, score + rules.equal_mm**2)


def _weakest_motions(fit: Fit, count: int) -> Array:
    """(count, 6) twists about the moved source's centroid, of 1 mm over it, that the residuals say least about."""
    J, offsets = fit.jacobian, fit.moved - fit.moved.mean(axis=0)
    scale = np.repeat([1.0, 1.0 / extent.radius_mm(fit.moved)], 3)
    motions = np.linalg.eigh((J * fit.weights[:, None] * scale).T @ (J * scale))[1].T[:count] * scale
    sizes_mm = [np.linalg.norm(each[:3] + np.cross(each[3:], offsets)) / np.sqrt(len(offsets)) for each in motions]
    return motions / np.maximum(sizes_mm, 1e-6)[:, None]


def _what_is_not_observed(uncertainty: PoseUncertainty) -> str:
    turn = _known(uncertainty.largest_turn_deg, HALF_TURN_DEG, "deg")
    shift = _known(uncertainty.largest_shift_mm, EXTENT_LIMITS_MM[1], "mm")
    return (
        f"the rotation about {_named(uncertainty.weakest_turn)} is {turn}, "
        f"the shift along {_named(uncertainty.weakest_shift)} is {shift}"
    )


def _known(deviation: float, most: float, unit: str) -> str:
    """A standard deviation in words; one beyond any that there can be says nothing but that."""
    return f"known to {deviation:.1f} {unit} only" if deviation <= most else "not known"


def _which_rival(candidates: Candidates, source: PreparedSource) -> str:
    shift_mm, turn_deg = se3.pose_error(candidates.poses[1], candidates.poses[0], source.points)
    return f"another pose, {shift_mm:.0f} mm and {turn_deg:.0f} deg away, explains the source as well"


def _named(axis: Array) -> str:
    return "({:.2f}, {:.2f}, {:.2f})".format(*axis)
