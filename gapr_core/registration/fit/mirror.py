"""Left for right: does the mirrored source fit the bone as well?

The bone of the other side of the body is the mirror image of this one. Where a patch is nearly its own mirror image no
residual tells the two apart; where it is not, the mirrored source fits badly. A bone that is its own mirror image as a
whole (a pelvis, a rib cage) has no other side: those images are not counted in `margin`. Yet it is never quite its own
image, and `image_margin` tells a scan that was flipped from one that was not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gapr_core.config import RegistrarConfig, VerificationConfig
from gapr_core.geometry import extent, se3
from gapr_core.registration.fit.refinement import distances_mm, evaluate, refine_many
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget

Array = NDArray[np.float64]

LIMITS = (-1.5, 4.0)  # of the margin: what is clearer decides nothing more
PLANES = 6  # through the bone's long axis, evenly turned
OWN_IMAGE_SHARE = 0.02  # of the half extent: a bone whose image lies so near, as a median, is its own mirror image
SYMMETRIC_MM = 0.4  # median distance of a bone and its image; .08 to .38 in an atlas, .65 or more of scanned ones
POINTS = 400  # of the bone, for that
LEAST_MM = 0.1
FLIP = np.diag([1.0, 1.0, -1.0, 1.0])


def flipped(points: Array) -> Array:
    """Points (N, 3), or one, under `FLIP`."""
    return points * FLIP.diagonal()[:3]


def margin(
    T: Array, source: PreparedSource, target: PreparedTarget, config: VerificationConfig, num_threads: int = 0
) -> float:
    """Log of the mean square residual that the mirrored source reaches over that of the source itself.

    Args:
        T: (4, 4) T_target_source of the pose, mm.
        source: what was registered.
        target: the bone.
        config: how hypotheses are refined.
        num_threads: 0 for all cores.

    Returns:
        Below 0 where the mirrored source fits better, about 0 where nothing tells left from right, at most 4.
    """
    reflections = np.array(_reflections(T, source.subset(config.middle_points), target))
    poses, scores, own = _refined_images(reflections, T, source, target, config, num_threads)
    for number in np.argsort(scores):
        if not _is_own_image(poses[number] @ FLIP @ se3.inverse(T), target):
            return log_ratio(scores[number], own)
    return LIMITS[1]


def image_margin(T: Array, source: PreparedSource, target: PreparedTarget, config: RegistrarConfig) -> float:
    """Does the flipped source fit better, on the image of a bone that is nearly its own mirror image?

    Args:
        T: (4, 4) T_target_source of the pose, mm.
        source: what was registered.
        target: the bone; its image is found once, and kept with it.
        config: how hypotheses are refined.

    Returns:
        As `Misfit.log_ratio`; 4 for any other bone.
    """
    image = _kept_image(target, config)
    if image is None:
        return LIMITS[1]
    poses, scores, own_mm2 = _refined_images(image[None], T, source, target, config.verification, config.num_threads)
    some = source.subset(config.verification.middle_points)
    sigmas_mm = [
        evaluate(pose, points, target, config.refinement).sigma_mm
        for pose, points in ((poses[0], flipped(some)), (T, some))
    ]
    return Misfit(float(scores[0]), sigmas_mm[0]).log_ratio(Misfit(own_mm2, sigmas_mm[1]))


def is_symmetric(target: PreparedTarget, config: RegistrarConfig) -> bool:
    """True for a model whose halves are mirror images of each other: a flipped source of it is no mistake."""
    image, key = _kept_image(target, config), ("symmetric", target.offset_mm, config.verification)
    if image is None:
        return False
    if key not in target.cache:
        points, limits_mm = flipped(_some_of(target)), np.linspace(*config.verification.middle_limits_mm)
        T = refine_many((image @ FLIP)[None], points, target, limits_mm, config.num_threads)[0][0]
        target.cache[key] = bool(np.median(distances_mm(T, points, target)) < SYMMETRIC_MM)
    return bool(target.cache[key])


@dataclass(frozen=True)
class Misfit:
    """How badly a source fits a bone: once with all its points, once without the gross ones.

    Attributes:
        mean_square_mm2: of the truncated distances of all points.
        sigma_mm: robust standard deviation of the residuals, from their median.
    """

    mean_square_mm2: float
    sigma_mm: float

    def log_ratio(self, own: Misfit) -> float:
        """Log of the mean square, and of the variance, over those of the source's own pose: the larger of the two.

        Below 0 where both say that this one fits better. Of a cloud with gross points most of the mean square is
        theirs, and chance lets a few more of them lie near one bone than near its image; the median does not see how
        many points lie off.
        """
        return max(log_ratio(self.mean_square_mm2, own.mean_square_mm2), log_ratio(self.sigma_mm**2, own.sigma_mm**2))


def _refined_images(
    reflections: Array,
    T: Array,
    source: PreparedSource,
    target: PreparedTarget,
    config: VerificationConfig,
    num_threads: int,
) -> tuple[Array, Array, float]:
    """The flipped source, refined from where reflections (K, 4, 4) of the target frame put the source's image.

    Returns:
        (K, 4, 4) poses and (K,) their mean squares, mm^2, and that of the source itself, refined from T (4, 4).
    """
    some, limits_mm = source.subset(config.middle_points), np.linspace(*config.middle_limits_mm)
    own = refine_many(T[None], some, target, limits_mm, num_threads)[1][0]
    poses, scores = refine_many(reflections @ T @ FLIP, flipped(some), target, limits_mm, num_threads)
    return poses, scores, float(own)


def log_ratio(changed_mm2: float, own_mm2: float) -> float:
    """Log of one mean square residual over another; below .1 mm neither says anything of left and right, or of size."""
    return float(np.clip(np.log((changed_mm2 + LEAST_MM**2) / (own_mm2 + LEAST_MM**2)), *LIMITS))


def _kept_image(target: PreparedTarget, config: RegistrarConfig) -> Array | None:
    """`_own_image`, found once for a target."""
    key = "own image", target.offset_mm, config.verification  # targets share their cache with other stand-offs
    if key not in target.cache:
        target.cache[key] = _own_image(target, config.verification, config.num_threads)
    return target.cache[key]  # type: ignore[no-any-return]


def _some_of(target: PreparedTarget) -> Array:
    """(N, 3) points of the bone, as a sensor with a stand-off sees them."""
    return target.elements[:: max(1, len(target.points) // POINTS), :3]


def _own_image(target: PreparedTarget, config: VerificationConfig, num_threads: int) -> Array | None:
    """(4, 4) motion with a reflection that lays the bone on itself, target frame; None where there is none."""
    some, limits_mm = flipped(_some_of(target)), np.linspace(*config.middle_limits_mm)
    planes = np.array([_reflection(normal, target.centre_mm) for normal in target.main_axes])
    poses, scores = refine_many(planes @ FLIP, some, target, limits_mm, num_threads)
    images = [poses[number] @ FLIP for number in np.argsort(scores)]
    return next((image for image in images if _is_own_image(image, target)), None)


def _reflections(T: Array, points: Array, target: PreparedTarget) -> list[Array]:
    """(4, 4) reflections, target frame: at planes through the bone's long axis and at the source's own main planes."""
    (_, middle, shortest), centre = target.main_axes, target.centre_mm
    angles = np.arange(PLANES) * np.pi / PLANES
    of_bone = [np.cos(angle) * shortest + np.sin(angle) * middle for angle in angles]
    moved = se3.apply(T, points)
    own = [(normal, moved.mean(axis=0)) for normal in extent.principal(moved).axes]
    return [_reflection(normal, at) for normal, at in [*((normal, centre) for normal in of_bone), *own]]


def _reflection(normal: Array, through: Array) -> Array:
    """(4, 4) p -> p - 2 n (n . (p - c))."""
    H = np.eye(4)
    H[:3, :3] -= 2.0 * np.outer(normal, normal)
    H[:3, 3] = 2.0 * normal * (normal @ through)
    return H


def _is_own_image(image: Array, target: PreparedTarget) -> bool:
    """True when a motion with a reflection lays the whole bone on itself."""
    some = target.points[:: max(1, len(target.points) // POINTS)]
    limit_mm = OWN_IMAGE_SHARE * target.half_extent_mm  # twice as far is infinitely far: no median of two gets below it
    gaps_mm = target.tree.query(some @ image[:3, :3].T + image[:3, 3], distance_upper_bound=2.0 * limit_mm)[0]
    return bool(np.median(gaps_mm) < limit_mm)
