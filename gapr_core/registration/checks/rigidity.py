"""Is what was measured one rigid piece of bone? How much the residuals speak for a strain, halves, a layer or looks.

A scan that drifts, or slices that lie too far apart, strain the source. In a scan of two that do not fit, or of a bone
that is bent or broken, one half lies in another pose. Under tissue that grows thicker the distance from the bone
changes. The looks of a tracked camera err against each other. Each is asked of the residuals (`further_unknowns`), and
what they show goes into the covariance.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gapr_core.config import RegistrarConfig, RigidityConfig
from gapr_core.geometry import extent
from gapr_core.geometry.twists import covariance_about
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.checks.unknowns import NOTHING, Finding, blocks, findings, motions
from gapr_core.registration.fit.refinement import Fit
from gapr_core.registration.uncertainty.covariance import PoseUncertainty, covariance_added_by, strains

Array = NDArray[np.float64]


class Deformation(NamedTuple):
    """How a source may be deformed relative to the bone.

    Attributes:
        finding: what the residuals say of it.
        changes: (n, k) how the residuals of the inliers change by each of its unknowns, by 1 mm.
        limit: log ratio beyond which it is believed.
        in_halves: two halves move against each other, and the pose lies between both.
    """

    finding: Finding
    changes: Array
    limit: float
    in_halves: bool = False

    @property
    def is_shown(self) -> bool:
        """True where the residuals speak for it enough."""
        return self.finding.log_ratio > self.limit


def of_looks(fit: Fit, look: NDArray[np.int64], config: RigidityConfig) -> Deformation:
    """Whether the looks of a camera err against each other, each by a motion of its own, as its tracker does.

    Args:
        fit: the pose that all have in common.
        look: (N,) number of the look that each point is of.
        config: of the blocks.
    """
    inlier = fit.weights > 0.0
    if np.count_nonzero(inlier) < config.fewest_points or look[inlier].min() == look[inlier].max():
        return Deformation(NOTHING, np.empty((np.count_nonzero(inlier), 0)), np.inf)
    numbers, group = np.unique(look[inlier], return_inverse=True)
    moved, group = motions(fit), group.reshape(-1)
    changes = np.column_stack([np.where(group == k, 1.0, 0.0)[:, None] * moved for k in range(len(numbers))])
    (found,) = findings(blocks(fit, fit.jacobian[inlier], [changes], group, config), config)
    return Deformation(found, changes, 0.0)  # it refuses nothing and only widens the covariance: any sign of it counts


def of_deformations(fit: Fit, config: RigidityConfig) -> dict[str, Deformation]:
    """What the residuals say of each deformation, by its name in `limits`; {} of few points.

    `strained`: see `covariance.strains`. `apart`: of the three pairs of `halves` the one that they speak most for.
    `layered`: see `a_layer`. A stand-off is no deformation: it is taken out with the pose. Another size is a strain,
    whatever the sensor: what its scale may excuse may as well be another subject's bone.
    """
    inlier = fit.weights > 0.0
    count = np.count_nonzero(inlier)
    if count < config.fewest_points:
        return {}
    changes = [strains(fit), a_layer(fit), *halves(fit)]
    free, at_once = np.column_stack([fit.jacobian[inlier], np.ones(count)]), np.zeros(count, dtype=np.int64)
    said = findings(blocks(fit, free, changes, at_once, config), config)
    (strained, of_strain), (layered, of_layer), *apart = zip(said, changes, strict=True)
    moved, of_halves = max(apart, key=lambda each: each[0].log_ratio)
    return {
        "strained": Deformation(strained, of_strain, config.strained),
        "apart": Deformation(moved, of_halves, config.apart, in_halves=True),
        "layered": Deformation(layered, of_layer, config.layered),
    }


def halves(fit: Fit) -> list[Array]:
    """(n, 6) for each principal axis of the inliers: the same by a motion of one half against the other."""
    feet = fit.feet[fit.weights > 0.0]
    along = feet @ extent.principal(feet).axes.T
    above, moved = np.where(along > np.median(along, axis=0), 0.5, -0.5), motions(fit)
    return [side[:, None] * moved for side in above.T]


def a_layer(fit: Fit) -> Array:
    """(n, 4) how the residuals of the inliers change by a layer on the bone: its growth along x, y and z, and its mean.

    No residual shows the mean. A layer that grows evenly from nothing has a mean of root 3 times its standard
    deviation.
    """
    feet = fit.feet[fit.weights > 0.0]
    away = (feet - feet.mean(axis=0)) / extent.radius_mm(feet)
    return np.column_stack([away, np.full(len(feet), np.sqrt(3.0))])


def allowing_for_deformation(assessment: Assessment, config: RegistrarConfig) -> Assessment:
    """The same where the residuals show one rigid piece of bone; else with what the deformations add to the covariance.

    Several may be found at once: a bent source is strained, too. The one that they speak most for is the first.
    """
    a = assessment
    found = {name: each for name, each in of_deformations(a.fit.rests_on, config.rigidity).items() if each.is_shown}
    if not found:
        return a
    uncertainty = a.uncertainty
    for each in found.values():
        added = covariance_added_by(a.fit, each.finding.size_mm * each.changes, config.covariance)
        uncertainty = uncertainty.with_more(added)
        if each.in_halves:
            uncertainty = uncertainty.with_more(covariance_of_half(a.fit, each.finding.size_mm))
    surest = sorted(found.items(), key=lambda item: -item[1].finding.log_ratio)
    deformed = {name: each.finding.size_mm for name, each in surest}
    return replace(a, uncertainty=uncertainty, deformed=deformed)


def allowing_for_looks(
    uncertainty: PoseUncertainty, fit: Fit, look: NDArray[np.int64] | None, config: RegistrarConfig
) -> PoseUncertainty:
    """The same with what the looks' errors against each other add, each a motion of its own; `look` as in `of_looks`.

    None: of a single look nothing is added.
    """
    found = None if look is None else of_looks(fit, look, config.rigidity)
    if found is None or not found.is_shown:
        return uncertainty
    return uncertainty.with_more(covariance_added_by(fit, found.finding.size_mm * found.changes, config.covariance))


def covariance_of_half(fit: Fit, size_mm: float) -> Array:
    """(6, 6) of either half against the pose between both, where they move against each other by `size_mm`."""
    rests = fit.rests_on
    moved = rests.moved[rests.weights > 0.0]
    deviations = 0.5 * size_mm * np.array([1.0] * 3 + [1.0 / extent.radius_mm(moved)] * 3)
    return covariance_about(fit.moved.mean(axis=0) - moved.mean(axis=0), np.diag(deviations**2))
