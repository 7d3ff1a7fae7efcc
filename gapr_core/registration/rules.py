"""Rules beside the confidence: a pose that may as well be another one is not believed, whatever the figures say."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapr_core.config import VerificationConfig
from gapr_core.covariance import PoseUncertainty
from gapr_core.geometry import se3
from gapr_core.metrics.uncertainty import motion_jacobians
from gapr_core.refinement import Fit, refine_many
from gapr_core.results import RegistrationStatus
from gapr_core.source import PreparedSource
from gapr_core.target import PreparedTarget
from gapr_core.verification import Candidates

Array = NDArray[np.float64]

LARGEST_TURN_DEG, LARGEST_SHIFT_MM = 6.0, 5.0  # standard deviations beyond which a direction counts as not observed
EQUAL_SHARE, EQUAL_MM = 0.015, 0.25  # a mean square larger by less than this share, or this length squared, is as good
WEAKEST = 3  # motions along which a pose is pushed: on a plane so many are not observed
PUSH = 1.5  # how far, in distances at which two poses are no longer the same


def is_matched(candidates: Candidates) -> bool:
    """True when a distinct pose explains the source as well as the best one."""
    scores = candidates.scores
    return len(scores) > 1 and bool(scores[1] < _as_good(scores[0]))


def is_loose(uncertainty: PoseUncertainty) -> bool:
    """True when a direction of motion is not observed: a spin about a shaft, a slide along it."""
    return uncertainty.largest_turn_deg > LARGEST_TURN_DEG or uncertainty.largest_shift_mm > LARGEST_SHIFT_MM


def can_be_pushed(
    fit: Fit, source: PreparedSource, target: PreparedTarget, config: VerificationConfig, num_threads: int = 0
) -> bool:
    """True when the pose, pushed along its least certain motions, rests elsewhere and explains the source as well.

    A hypothesis in a flat valley stays where it began, so none of the others shows that the valley is there; and what
    the surface elements of a plane seem to say about a slide is the noise of their normals.
    """
    some = source.subset(config.middle_points)
    pushes = _weakest_motions(fit) * PUSH * config.same_pose_mm
    centre = fit.moved.mean(axis=0)
    poses = np.array([fit.T, *(se3.exp(sign * push, centre) @ fit.T for push in pushes for sign in (1.0, -1.0))])
    rested, scores = refine_many(poses, some, target, np.linspace(*config.final_limits_mm), num_threads)
    apart = np.array([_rms_mm(se3.apply(T, some) - se3.apply(rested[0], some)) for T in rested])
    elsewhere = apart >= config.same_pose_mm
    return bool((scores[elsewhere] < _as_good(scores[0])).any())


def why_not(
    candidates: Candidates, uncertainty: PoseUncertainty, probability: float, pushed: bool
) -> tuple[RegistrationStatus, str]:
    """Status and sentence of a refusal."""
    if is_loose(uncertainty):
        return RegistrationStatus.DEGENERATE, (
            f"the turn about {_named(uncertainty.weakest_turn)} is known to {uncertainty.largest_turn_deg:.1f} deg, "
            f"the shift along {_named(uncertainty.weakest_shift)} to {uncertainty.largest_shift_mm:.1f} mm only"
        )
    if pushed:
        return RegistrationStatus.DEGENERATE, "a pose a few mm aside is as good: what is seen is flat or straight"
    if is_matched(candidates):
        apart = se3.rotation_angle_deg(se3.inverse(candidates.poses[0]) @ candidates.poses[1])
        return RegistrationStatus.AMBIGUOUS, f"another pose, turned by {apart:.0f} deg, explains the source as well"
    reason = f"the best pose found is right with a probability of {probability:.2f} only"
    return RegistrationStatus.LOW_CONFIDENCE, reason


def _as_good(score: float) -> float:
    """Mean square, mm^2, below which another pose explains the source as well as one of this mean square.

    Above 2 mm of noise a small share is chance. Below it is the target's own roughness that decides between such poses:
    terraces of voxels, or what a smooth element leaves of an edge.
    """
    return max((1.0 + EQUAL_SHARE) * score, score + EQUAL_MM**2)


def _weakest_motions(fit: Fit) -> Array:
    """(WEAKEST, 6) twists about the moved source's centroid, of 1 mm over it, that the residuals say least about."""
    J = fit.jacobian
    arm_mm = max(_rms_mm(fit.moved - fit.moved.mean(axis=0)), 1.0)
    scale = np.array([1.0] * 3 + [1.0 / arm_mm] * 3)
    motions = np.linalg.eigh((J * fit.weights[:, None] * scale).T @ (J * scale))[1].T[:WEAKEST] * scale
    moves = motion_jacobians(fit.moved, fit.moved.mean(axis=0)) @ motions.T
    return motions / np.array([[max(_rms_mm(move), 1e-6)] for move in moves.transpose(2, 0, 1)])


def _rms_mm(vectors: Array) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def _named(axis: Array) -> str:
    return "({:.2f}, {:.2f}, {:.2f})".format(*axis)
