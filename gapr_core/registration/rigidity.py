"""Is what was measured one rigid piece of bone? How much the residuals speak for a motion, a strain, halves or a layer.

A bone that creeps moves the pose with time. So does a scan that drifts, or slices that lie too far apart: they strain
the source. In a scan of two that do not fit, or of a bone that is bent or broken, one half lies in another pose. Under
tissue that grows thicker the distance from the bone changes. Each has a few unknowns besides the pose. Are they there?
The restricted likelihood of their best size is compared with that of none, and the pose is integrated out (Patterson
and Thompson 1971). A smooth bias of any size and an error that neighbours share are allowed for in both, as they look
similar. Averages over blocks of neighbours are compared: a single point's normal errs with its residual.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from gapr_core.config import RegistrarConfig, RigidityConfig
from gapr_core.geometry import extent, sampling
from gapr_core.geometry.twists import covariance_about, distance_jacobian
from gapr_core.registration.assessment import Assessment
from gapr_core.registration.bias_field import smooth_correlation
from gapr_core.registration.covariance import PoseUncertainty, covariance_added_by, strains
from gapr_core.registration.refinement import Fit

Array = NDArray[np.float64]

BIASES_MM = np.array([0.0, 0.15, 0.3, 0.6, 1.2, 2.4])  # of the smooth bias, to choose from
SHARED_MM = np.array([0.05, 0.2, 0.5, 1.0])  # of what the points of a block share
SIZES_MM = np.array([0.0, 0.3, 0.6, 1.0, 1.7, 3.0, 5.0, 8.0, 12.0])  # of the further unknowns


class Finding(NamedTuple):
    """What the residuals say of further unknowns.

    Attributes:
        log_ratio: log likelihood of their best size over that of none; 0 where none is best.
        size_mm: root mean square of the size of each, given the residuals; before them all `SIZES_MM` are as likely.
    """

    log_ratio: float
    size_mm: float


NOTHING = Finding(0.0, 0.0)


class Motion(NamedTuple):
    """What collected sources say of a bone that moves.

    Attributes:
        finding: of a steady motion or of a step, what they speak most for.
        rests_from: number of the first source since a step; None for a steady motion.
    """

    finding: Finding
    rests_from: int | None = None


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


def of_motion(fit: Fit, order: NDArray[np.int64], config: RigidityConfig) -> Motion:
    """Whether the bone moved while the points were collected: steadily, or once between two groups of sources.

    The size of a steady motion is that from the first source to the last.

    Args:
        fit: the pose that all points have in common.
        order: (N,) when each point was measured, as the number of its source: 0, 1, 2 and on.
        config: of the blocks, and how many groups.
    """
    inlier = fit.weights > 0.0
    if np.count_nonzero(inlier) < config.fewest_points or not order.max() > order.min():
        return Motion(NOTHING)
    time = ((order - order.min()) / (order.max() - order.min()))[inlier]
    steps = step_times(config.groups)
    group = np.searchsorted(steps, time, side="right")
    moved = motions(fit)
    changes = [when[:, None] * moved for when in [time - 0.5, *(np.where(time < at, -0.5, 0.5) for at in steps)]]
    found = findings(blocks(fit, fit.jacobian[inlier], changes, group, config), config)
    any_of_steps = np.log(len(steps))  # each of them is as likely as the others, before the residuals
    ratios = [found[0].log_ratio, *(each.log_ratio - any_of_steps for each in found[1:])]
    best = int(np.argmax(ratios))
    if best == 0:
        return Motion(found[0])
    # a step in the first half of a group is found at the edge before it
    at = 0.5 * np.append(steps, 1.0)[best - 1 : best + 1].sum()
    rests_from = int(np.ceil(order.min() + at * (order.max() - order.min())))
    return Motion(Finding(ratios[best], found[best].size_mm), rests_from)


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


def step_times(groups: int) -> Array:
    """(groups,) shares of the time between groups: equal ones, the last of them halved, as the newest matter most."""
    return np.append(np.arange(1, groups), groups - 0.5) / groups


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


def motions(fit: Fit) -> Array:
    """(n, 6) how the residuals of the inliers change by shifts and by turns about their middle, of 1 mm each.

    A turn of 1 mm is one by 1 mm over their root mean square distance from the middle.
    """
    inlier = fit.weights > 0.0
    moved, normals = fit.moved[inlier], fit.gradients[inlier]
    return distance_jacobian(moved, normals, moved.mean(axis=0)) / np.repeat([1.0, extent.radius_mm(moved)], 3)


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
    covariance = a.uncertainty.covariance
    for each in found.values():
        covariance = covariance + covariance_added_by(a.fit, each.finding.size_mm * each.changes, config.covariance)
        if each.in_halves:
            covariance = covariance + covariance_of_half(a.fit, each.finding.size_mm)
    surest = sorted(found.items(), key=lambda item: -item[1].finding.log_ratio)
    deformed = {name: each.finding.size_mm for name, each in surest}
    return replace(a, uncertainty=replace(a.uncertainty, covariance=covariance), deformed=deformed)


def allowing_for_looks(
    uncertainty: PoseUncertainty, fit: Fit, look: NDArray[np.int64] | None, config: RegistrarConfig
) -> PoseUncertainty:
    """The same with what the looks' errors against each other add, each a motion of its own; `look` as in `of_looks`.

    None: of a single look nothing is added.
    """
    found = None if look is None else of_looks(fit, look, config.rigidity)
    if found is None or not found.is_shown:
        return uncertainty
    added = covariance_added_by(fit, found.finding.size_mm * found.changes, config.covariance)
    return replace(uncertainty, covariance=uncertainty.covariance + added)


def covariance_of_half(fit: Fit, size_mm: float) -> Array:
    """(6, 6) of either half against the pose between both, where they move against each other by `size_mm`."""
    rests = fit.rests_on
    moved = rests.moved[rests.weights > 0.0]
    deviations = 0.5 * size_mm * np.array([1.0] * 3 + [1.0 / extent.radius_mm(moved)] * 3)
    return covariance_about(fit.moved.mean(axis=0) - moved.mean(axis=0), np.diag(deviations**2))


@dataclass(frozen=True, eq=False)
class Blocks:
    """Averages over blocks of neighbouring inliers.

    Attributes:
        residuals: (n,) mm.
        free: (n, j) how they change by what is not in question: a motion of the source, at least.
        more: (n, m, k) how they change by the further unknowns, of 1 mm each: m alternatives of k at most, others 0.
        variances: (n,) what the noise of a point leaves in them, mm^2.
        feet: (n, 3) their places, mm.
    """

    residuals: Array
    free: Array
    more: Array
    variances: Array
    feet: Array


def blocks(fit: Fit, free: Array, more: list[Array], group: NDArray[np.int64], config: RigidityConfig) -> Blocks:
    """Averages of the inliers (n) of a fit, weighted as they count: over cells around points that are spread evenly.

    Args:
        fit: the residuals.
        free: (n, j) derivatives of the inliers' residuals by what is not in question.
        more: m times (n, k), the same by the further unknowns; k may differ.
        group: (n,) number of a group; a block holds points of one.
        config: how many cells.
    """
    inlier = fit.weights > 0.0
    feet, weights = fit.feet[inlier], fit.weights[inlier]
    centres = feet[sampling.thin(feet, min(config.cells, len(feet)))]
    cell = cKDTree(centres).query(feet)[1]
    block = np.unique(group * len(centres) + cell, return_inverse=True)[1].reshape(-1)
    most = max(each.shape[1] for each in more)
    alternatives = [np.pad(each, ((0, 0), (0, most - each.shape[1]))) for each in more]
    columns = np.column_stack([fit.signed_mm[inlier], feet, free, *alternatives])
    total = np.bincount(block, weights)
    means = csr_array((weights, (block, np.arange(len(block))))) @ columns / total[:, None]
    residuals, places, free, changes = np.split(means, np.cumsum([1, 3, free.shape[1]]), axis=1)
    changes = changes.reshape(len(means), len(more), -1)
    return Blocks(residuals[:, 0], free, changes, fit.sigma_mm**2 / total, places)


def findings(found: Blocks, config: RigidityConfig) -> list[Finding]:
    """What the blocks say of each of the m alternatives, whatever the bias and what the points of a block share."""
    noise, correlation = np.diag(found.variances), smooth_correlation(found.feet, found.feet, config.correlation_mm)
    shared = SHARED_MM[:, None, None] ** 2 * np.eye(len(noise))
    V = np.concatenate([noise + bias_mm**2 * correlation + shared for bias_mm in BIASES_MM])
    of_all = _log_likelihoods(found, V)
    return [_of_sizes(of_all[:, i]) for i in range(of_all.shape[1])]


def _of_sizes(log_likelihood: Array) -> Finding:
    """The finding by (errors, K) log likelihoods of each of `SIZES_MM`."""
    best = log_likelihood.max(axis=0)
    posterior = np.exp(log_likelihood - log_likelihood.max()).sum(axis=0)
    size_mm = float(np.sqrt(posterior @ SIZES_MM**2 / posterior.sum()))
    return Finding(float(best.max() - best[0]), size_mm)


def _log_likelihoods(found: Blocks, V: Array) -> Array:
    """(e, m, K) restricted log likelihood of each of `SIZES_MM`, of residuals whose other errors have covariances V.

    With what is not in question projected out, the further unknowns have the information M and the score s: in the
    axes of M, y^T V^-1 y falls by sum h^2 s_i^2 / (1 + h^2 m_i), and log det grows by sum log(1 + h^2 m_i).

    Args:
        found: the n blocks, with m alternatives.
        V: (e, n, n) covariances of the residuals without what is in question, mm^2.
    """
    root = np.linalg.cholesky(V)
    columns = np.column_stack([found.free, found.more.reshape(len(found.more), -1), found.residuals])
    white = np.linalg.solve(root, columns)
    free, rest = np.split(white, [found.free.shape[1]], axis=2)
    Q, singular, _ = np.linalg.svd(free, full_matrices=False)
    shows = singular > 1e-9 * singular[:, :1]  # on a plane, a motion along it does not
    Q = Q * shows[:, None]
    left = rest - Q @ (Q.swapaxes(1, 2) @ rest)
    residuals = left[..., -1]
    more = left[..., :-1].reshape(len(V), *found.more.shape).transpose(0, 2, 3, 1)
    information, axes = np.linalg.eigh(more @ more.swapaxes(2, 3))
    score = (axes.swapaxes(2, 3) @ (more @ residuals[:, None, :, None]))[..., 0]
    variances = SIZES_MM[:, None] ** 2
    gain = 1.0 + variances * np.maximum(information, 0.0)[:, :, None]
    log_det = 2.0 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)  # of V, and of what is projected out of it
    log_det += 2.0 * np.log(np.where(shows, singular, 1.0)).sum(axis=1)
    alone = -0.5 * ((residuals**2).sum(axis=1) + log_det)
    more_alike = 0.5 * (variances * score[:, :, None] ** 2 / gain - np.log(gain)).sum(axis=3)
    return np.asarray(alone[:, None, None] + more_alike)
