"""Deformations of the source widen the covariance; each is a test of the residuals (`unknowns`).

A scan that drifts strains the source. Of a broken bone one half lies in another pose. Under tissue that grows thicker
the distance from the bone changes. The looks of a tracked camera err against each other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gapr_core.geometry import extent
from gapr_core.geometry.twists import covariance_about
from gapr_core.registration.checks.unknowns import FEWEST_POINTS, Shown, blocks, motions, shown
from gapr_core.registration.fit.refinement import Fit
from gapr_core.registration.uncertainty.covariance import PoseUncertainty, covariance_added_by, strains
from gapr_core.results import Effect, Finding, RegistrationStatus

Array = NDArray[np.float64]

# least log likelihood ratios of a detection, and its text
STRAINED, APART, LAYERED = 3.0, 6.0, 4.0
TEXTS = {
    "strained": "the source is longer, wider or slanted against the bone",
    "apart": "two halves of the source lie in two poses",
    "layered": "the distance from the bone changes along the source, as under tissue",
}
ADVICE = "check that nothing moved during the measurement, and bare the bone"


class Deformation(NamedTuple):
    """A way in which a source may be deformed relative to the bone.

    Attributes:
        shown: evidence of the residuals.
        changes: (n, k) derivatives of the inliers' residuals by its unknowns, of 1 mm each.
        limit: least log ratio of a detection.
    """

    shown: Shown
    changes: Array
    limit: float


def deformation(fit: Fit) -> tuple[Finding, Array] | None:
    """Find deformations of a source, and the covariance (6, 6) that all of them add; the finding names the surest."""
    detected = {name: each for name, each in of_deformations(fit.full_fit).items() if each.shown.log_ratio > each.limit}
    if not detected:
        return None
    added = np.zeros((6, 6))
    for name, each in detected.items():
        added += covariance_added_by(fit, each.shown.size_mm * each.changes)
        if name == "apart":
            added += covariance_of_half(fit, each.shown.size_mm)
    name, surest = max(detected.items(), key=lambda item: item[1].shown.log_ratio)
    finding = Finding(
        name, Effect.WIDEN, surest.shown.log_ratio, surest.limit, RegistrationStatus.OK, TEXTS[name], ADVICE
    )
    return finding, added


def of_deformations(fit: Fit) -> dict[str, Deformation]:
    """Measure each deformation; {} of few points.

    `strained`: see `covariance.strains`. `apart`: the most likely pair of `halves`. `layered`: see `a_layer`. A
    stand-off is no deformation: it is projected out with the pose.
    """
    count = np.count_nonzero(fit.counts)
    if count < FEWEST_POINTS:
        return {}
    changes = [strains(fit), a_layer(fit), *halves(fit)]
    free, at_once = np.column_stack([fit.jacobian[fit.counts], np.ones(count)]), np.zeros(count, dtype=np.int64)
    tested = shown(blocks(fit, free, changes, at_once))
    (strained, of_strain), (layered, of_layer), *apart = zip(tested, changes, strict=True)
    moved, of_halves = max(apart, key=lambda each: each[0].log_ratio)
    return {
        "strained": Deformation(strained, of_strain, STRAINED),
        "apart": Deformation(moved, of_halves, APART),
        "layered": Deformation(layered, of_layer, LAYERED),
    }


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
    """Add the errors of looks (N,), if there are several, to the uncertainty of their common pose."""
    looks = None if look is None else of_looks(fit, look)
    if looks is None or not looks.shown.log_ratio > looks.limit:
        return uncertainty
    return uncertainty.with_more(covariance_added_by(fit, looks.shown.size_mm * looks.changes))


def of_looks(fit: Fit, look: NDArray[np.int64]) -> Deformation | None:
    """Measure errors of looks (N,) against each other; None of few points or of one look.

    Any sign of them counts, as it only widens the covariance.
    """
    of_inliers = look[fit.counts]
    if len(of_inliers) < FEWEST_POINTS or of_inliers.min() == of_inliers.max():
        return None
    numbers, group = np.unique(of_inliers, return_inverse=True)
    moved, group = motions(fit), group.reshape(-1)
    changes = np.column_stack([np.where(group == k, 1.0, 0.0)[:, None] * moved for k in range(len(numbers))])
    (evidence,) = shown(blocks(fit, fit.jacobian[fit.counts], [changes], group))
    return Deformation(evidence, changes, 0.0)


def covariance_of_half(fit: Fit, size_mm: float) -> Array:
    """Compute the (6, 6) covariance of the pose of either half, where they move apart by `size_mm`."""
    full = fit.full_fit
    moved = full.moved[full.counts]
    deviations = 0.5 * size_mm * np.array([1.0] * 3 + [1.0 / extent.radius_mm(moved)] * 3)
    return covariance_about(fit.moved.mean(axis=0) - moved.mean(axis=0), np.diag(deviations**2))
