"""Fits of changed sources and poses: mirrored, in another size, off the bone, or pushed aside.

Each function changes the source, the surface or the pose, refines on the same few points, and compares the misfit with
that of the source's own pose. The answer is a log ratio of mean squares: below 0 the change fits better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from gapr_core.config import RegistrarConfig, SensorConfig
from gapr_core.geometry import extent, se3
from gapr_core.registration.fit.refinement import Fit, distances_mm, evaluate, refine_many
from gapr_core.registration.problem.sensor import offset_surface
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget

Array = NDArray[np.float64]

CLIPPED = (-1.5, 4.0)  # of a log ratio: larger margins add no information
LEAST_MM = 0.1  # smaller residuals carry no information on side or size
SIZES = (0.945, 1.055)  # far enough from 1 that neither fits better through noise or a sensor's bias
STANDOFFS_MM = (-3.0, -2.0, -1.5, -1.0, 1.0, 1.5, 2.0, 2.5, 3.0, 4.5, 6.0)
PLANES = 6  # through the bone's long axis, evenly turned
OWN_IMAGE_SHARE = 0.02  # median distance of a bone to its own mirror image, at most, over the half extent
SYMMETRIC_MM = 0.4  # median distance of a bone and its image; .08 to .38 in an atlas, .65 or more of scanned ones
POINTS = 400  # of the bone, in this comparison
PUSHED_MOTIONS, PUSH = 3, 1.5  # number of weakest motions, and length of a push in units of `same_pose_mm`
FLIP = np.diag([1.0, 1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Trial:
    """A pose and the few points on which changes of it are tried."""

    T: Array  # (4, 4) T_target_source, mm
    points: Array  # (N, 3) mm, source frame
    target: PreparedTarget
    config: RegistrarConfig

    def refined(
        self, poses: Array, points: Array | None = None, target: PreparedTarget | None = None
    ) -> tuple[Array, Array]:
        """Refine poses (K, 4, 4), of other points or surfaces if given; returns them and (K,) mean squares, mm^2."""
        limits_mm = np.linspace(*self.config.verification.middle_limits_mm)
        some, surface = self.points if points is None else points, target or self.target
        return refine_many(poses, some, surface, limits_mm, self.config.num_threads)

    @cached_property
    def own_mm2(self) -> float:
        """Mean square of the source's own pose, mm^2."""
        return float(self.refined(self.T[None])[1][0])


@lru_cache(maxsize=1)  # features and checks of one fit share it
def trial_of(fit: Fit, source: PreparedSource, target: PreparedTarget, config: RegistrarConfig) -> Trial:
    """Try changes of a fit on the middle points of its source."""
    return Trial(fit.T, source.subset(config.verification.middle_points), target, config)


def log_ratio(changed_mm2: float, own_mm2: float) -> float:
    """Compute the log of one mean square residual over another, clipped."""
    return float(np.clip(np.log((changed_mm2 + LEAST_MM**2) / (own_mm2 + LEAST_MM**2)), *CLIPPED))


def other_size(trial: Trial, sizes: Sequence[float] = SIZES) -> float:
    """Compute the log ratio of the source in the best of other sizes, grown about its centroid.

    Residuals grow with the source, so they count in its own size: a mean square over s^2.
    """
    some = trial.points
    centre = some.mean(axis=0)
    changed = [trial.refined(trial.T[None], centre + s * (some - centre))[1][0] / s**2 for s in sizes]
    return log_ratio(min(changed), trial.own_mm2)


def standoff(trial: Trial, standoffs_mm: Sequence[float] = STANDOFFS_MM) -> tuple[float, float]:
    """Find the stand-off, mm, outwards, with which the source fits best, and its log ratio."""

    def misfit_mm2(mm: float) -> float:
        surface = offset_surface(trial.target, SensorConfig(standoff_mm=mm))
        return float(trial.refined(trial.T[None], target=surface)[1][0])

    changed = {mm: misfit_mm2(mm) for mm in standoffs_mm}
    best_mm = min(changed, key=changed.__getitem__)
    return best_mm, log_ratio(changed[best_mm], trial.own_mm2)


def pushed(trial: Trial, fit: Fit) -> float:
    """Compute the least mean square, mm^2, of the pose pushed along its weakest motions and at rest elsewhere.

    Infinite where every push comes back.
    """
    same_mm = trial.config.verification.same_pose_mm
    pushes, centre = _weakest_motions(fit) * PUSH * same_mm, fit.moved.mean(axis=0)
    poses = np.array([fit.T, *(se3.exp(sign * push, centre) @ fit.T for push in pushes for sign in (1.0, -1.0))])
    rested, scores = trial.refined(poses)
    elsewhere = np.array([se3.rms_apart_mm(T, rested[0], trial.points) for T in rested]) >= same_mm
    return float(scores[elsewhere].min(initial=np.inf))


def _weakest_motions(fit: Fit) -> Array:
    """Compute the (K, 6) twists, of 1 mm over the moved source, that the residuals determine least."""
    J, offsets = fit.jacobian, fit.moved - fit.moved.mean(axis=0)
    scale = np.repeat([1.0, 1.0 / extent.radius_mm(fit.moved)], 3)
    motions = np.linalg.eigh((J * fit.weights[:, None] * scale).T @ (J * scale))[1].T[:PUSHED_MOTIONS] * scale
    sizes_mm = [np.linalg.norm(each[:3] + np.cross(each[3:], offsets)) / np.sqrt(len(offsets)) for each in motions]
    return motions / np.maximum(sizes_mm, 1e-6)[:, None]


def flipped(points: Array) -> Array:
    """Mirror points (N, 3), or one, at z = 0."""
    return points * FLIP.diagonal()[:3]


def mirrored(trial: Trial) -> float:
    """Compute the log ratio of the mirrored source near the pose: below 0 it fits better, about 0 as well.

    A bone that is its own mirror image as a whole (a pelvis, a rib cage) has no other side: that image does not count.
    """
    reflections = np.array(_reflections(trial))
    poses, scores = trial.refined(reflections @ trial.T @ FLIP, flipped(trial.points))
    for number in np.argsort(scores):
        if not _is_own_image(poses[number] @ FLIP @ se3.inverse(trial.T), trial.target):
            return log_ratio(scores[number], trial.own_mm2)
    return CLIPPED[1]


def on_own_image(trial: Trial) -> float:
    """Compute the log ratio of the mirrored source on the bone's own mirror image; 4 without such an image.

    The larger of the ratios of mean squares and of robust variances: a few gross points may fit an image by chance.
    """
    image, _ = _own_image(trial)
    if image is None:
        return CLIPPED[1]
    poses, scores = trial.refined((image @ trial.T @ FLIP)[None], flipped(trial.points))
    refinement = trial.config.refinement
    changed = evaluate(poses[0], flipped(trial.points), trial.target, refinement).sigma_mm
    own = evaluate(trial.T, trial.points, trial.target, refinement).sigma_mm
    return max(log_ratio(scores[0], trial.own_mm2), log_ratio(changed**2, own**2))


def is_symmetric(trial: Trial) -> bool:
    """Return True for a model whose halves are mirror images of each other: a flipped source of it is no mistake."""
    return _own_image(trial)[1]


def _own_image(trial: Trial) -> tuple[Array | None, bool]:
    """Find the (4, 4) motion with a reflection that lays the bone on itself, None without one; once per target.

    Its flag is True where the halves of the bone are mirror images of each other.
    """
    target = trial.target
    key = "own image", target.offset_mm, trial.config.verification  # targets share their cache with other stand-offs
    if key not in target.cache:
        points = flipped(_some_of(target))
        planes = np.array([_reflection(normal, target.centre_mm) for normal in target.main_axes])
        poses, scores = trial.refined(planes @ FLIP, points)
        images = [poses[number] @ FLIP for number in np.argsort(scores)]
        image, off_mm = next((image for image in images if _is_own_image(image, target)), None), np.inf
        if image is not None:
            T = trial.refined((image @ FLIP)[None], points)[0][0]
            off_mm = float(np.median(distances_mm(T, points, target)))
        target.cache[key] = image, bool(off_mm < SYMMETRIC_MM)
    return target.cache[key]  # type: ignore[no-any-return]


def _some_of(target: PreparedTarget) -> Array:
    """Select (N, 3) points of the bone, where a sensor with a stand-off sees them."""
    return target.elements[:: max(1, len(target.points) // POINTS), :3]


def _reflections(trial: Trial) -> list[Array]:
    """Compute (4, 4) reflections, target frame, at planes through the bone's long axis and the source's main planes."""
    (_, middle, shortest), centre = trial.target.main_axes, trial.target.centre_mm
    angles = np.arange(PLANES) * np.pi / PLANES
    of_bone = [np.cos(angle) * shortest + np.sin(angle) * middle for angle in angles]
    moved = se3.apply(trial.T, trial.points)
    own = [(normal, moved.mean(axis=0)) for normal in extent.principal(moved).axes]
    return [_reflection(normal, at) for normal, at in [*((normal, centre) for normal in of_bone), *own]]


def _reflection(normal: Array, through: Array) -> Array:
    """Compute the (4, 4) reflection p -> p - 2 n (n . (p - c))."""
    H = np.eye(4)
    H[:3, :3] -= 2.0 * np.outer(normal, normal)
    H[:3, 3] = 2.0 * normal * (normal @ through)
    return H


def _is_own_image(image: Array, target: PreparedTarget) -> bool:
    """Return True when a motion with a reflection lays the whole bone on itself."""
    some = target.points[:: max(1, len(target.points) // POINTS)]
    limit_mm = OWN_IMAGE_SHARE * target.half_extent_mm  # twice as far is infinitely far: no median of two gets below it
    gaps_mm = target.tree.query(some @ image[:3, :3].T + image[:3, 3], distance_upper_bound=2.0 * limit_mm)[0]
    return bool(np.median(gaps_mm) < limit_mm)
