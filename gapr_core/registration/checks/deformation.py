"""Deformations of the source, and a motion of the bone; each is a test of the residuals (`unknowns`).

A scan that drifts strains the source. Of a broken bone one half lies in another pose. Under tissue that grows thicker
the distance from the bone changes. The looks of a tracked camera err against each other. A bone that creeps, or is
knocked, while its sources are collected moves the pose with time.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapr_core.geometry import extent
from gapr_core.geometry.twists import covariance_about
from gapr_core.registration.checks.unknowns import FEWEST_POINTS, NOTHING, Shown, blocks, motions, shown
from gapr_core.registration.fit.refinement import Fit
from gapr_core.registration.uncertainty.covariance import PoseUncertainty, covariance_added_by, strains
from gapr_core.results import Effect, Finding, RegistrationStatus

Array = NDArray[np.float64]

LIMITS = {"strained": 3.0, "apart": 6.0, "layered": 4.0}  # least log likelihood ratios of a detection
TEXTS = {
    "strained": "the source is longer, wider or slanted against the bone",
    "apart": "two halves of the source lie in two poses",
    "layered": "the distance from the bone changes along the source, as under tissue",
}
ADVICE = "check that nothing moved during the measurement, and bare the bone"
# times between six groups of sources, averaged apart, as shares: the last group is halved, as the newest matter most
STEPS = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 5.5]) / 6.0


def deformation(fit: Fit) -> tuple[Finding, Array] | None:
    """Find deformations of a source, and the covariance (6, 6) that all of them add; the finding names the surest."""
    detected = {name: each for name, each in of_deformations(fit.full_fit).items() if each[0].log_ratio > LIMITS[name]}
    if not detected:
        return None
    added = np.zeros((6, 6))
    for name, (evidence, changes) in detected.items():
        added += covariance_added_by(fit, evidence.size_mm * changes)
        if name == "apart":
            added += covariance_of_half(fit, evidence.size_mm)
    name, (surest, _) = max(detected.items(), key=lambda item: item[1][0].log_ratio)
    ratio, limit = surest.log_ratio, LIMITS[name]
    return Finding(name, Effect.WIDEN, ratio, limit, RegistrationStatus.OK, TEXTS[name], ADVICE), added


def of_deformations(fit: Fit) -> dict[str, tuple[Shown, Array]]:
    """Measure each deformation; {} of few points.

    Each has its evidence, and (n, k) derivatives of the inliers' residuals by its unknowns, of 1 mm each.

    `strained`: see `covariance.strains`. `apart`: the most likely pair of `halves`. `layered`: see `a_layer`. A
    stand-off is no deformation: it is projected out with the pose.
    """
    count = np.count_nonzero(fit.counts)
    if count < FEWEST_POINTS:
        return {}
    changes = [strains(fit), a_layer(fit), *halves(fit)]
    free, at_once = np.column_stack([fit.jacobian[fit.counts], np.ones(count)]), np.zeros(count, dtype=np.int64)
    strained, layered, *apart = zip(shown(blocks(fit, free, changes, at_once)), changes, strict=True)
    return {"strained": strained, "apart": max(apart, key=lambda each: each[0].log_ratio), "layered": layered}


def halves(fit: Fit) -> list[Array]:
    """Compute derivatives by a motion of one half against the other, (n, 6) for each principal axis of the inliers."""
    feet = fit.feet[fit.counts]
    along = feet @ extent.principal(feet).axes.T
    above, moved = np.where(along > np.median(along, axis=0), 0.5, -0.5), motions(fit)
    return [side[:, None] * moved for side in above.T]


def a_layer(fit: Fit) -> Array:
    """Compute (n, 4) derivatives by a layer on the bone: its growth along x, y and z, and its mean.

    A layer that grows evenly from nothing has a mean of root 3 times its standard deviation.
    """
    feet = fit.feet[fit.counts]
    away = (feet - feet.mean(axis=0)) / extent.radius_mm(feet)
    return np.column_stack([away, np.full(len(feet), np.sqrt(3.0))])


def with_looks(uncertainty: PoseUncertainty, fit: Fit, look: NDArray[np.int64] | None) -> PoseUncertainty:
    """Add the errors of looks (N,) against each other, if there are several, to the uncertainty of their common pose.

    Any sign of them counts, as it only widens the covariance.
    """
    of_inliers = None if look is None else look[fit.counts]
    if of_inliers is None or len(of_inliers) < FEWEST_POINTS or of_inliers.min() == of_inliers.max():
        return uncertainty
    numbers, group = np.unique(of_inliers, return_inverse=True)
    moved, group = motions(fit), group.reshape(-1)
    changes = np.column_stack([np.where(group == k, 1.0, 0.0)[:, None] * moved for k in range(len(numbers))])
    (evidence,) = shown(blocks(fit, fit.jacobian[fit.counts], [changes], group))
    if not evidence.log_ratio > 0.0:
        return uncertainty
    return uncertainty.with_more(covariance_added_by(fit, evidence.size_mm * changes))


def covariance_of_half(fit: Fit, size_mm: float) -> Array:
    """Compute the (6, 6) covariance of the pose of either half, where they move apart by `size_mm`."""
    full = fit.full_fit
    moved = full.moved[full.counts]
    deviations = 0.5 * size_mm * np.array([1.0] * 3 + [1.0 / extent.radius_mm(moved)] * 3)
    return covariance_about(fit.moved.mean(axis=0) - moved.mean(axis=0), np.diag(deviations**2))


def of_motion(fit: Fit, order: NDArray[np.int64]) -> tuple[Shown, int | None]:
    """Test whether the bone moved while its sources were collected: steadily, or once between two groups.

    Args:
        fit: common pose of all points.
        order: (N,) number of each point's source in time: 0, 1, 2 and on.

    Returns:
        The evidence of a steady motion or of a step, whichever is larger, and the number of the first source since a
        step; None for a steady motion.
    """
    inlier = fit.counts
    if np.count_nonzero(inlier) < FEWEST_POINTS or not order.max() > order.min():
        return NOTHING, None
    time = ((order - order.min()) / (order.max() - order.min()))[inlier]
    group = np.searchsorted(STEPS, time, side="right")
    moved = motions(fit)
    changes = [when[:, None] * moved for when in [time - 0.5, *(np.where(time < at, -0.5, 0.5) for at in STEPS)]]
    evidence = shown(blocks(fit, fit.jacobian[inlier], changes, group))
    any_of_steps = np.log(len(STEPS))  # all are equally likely before the residuals
    ratios = [evidence[0].log_ratio, *(each.log_ratio - any_of_steps for each in evidence[1:])]
    best = int(np.argmax(ratios))
    if best == 0:
        return evidence[0], None
    # a step in the first half of a group is found at the edge before it
    at = 0.5 * np.append(STEPS, 1.0)[best - 1 : best + 1].sum()
    rests_from = int(np.ceil(order.min() + at * (order.max() - order.min())))
    return Shown(ratios[best], evidence[best].size_mm), rests_from
