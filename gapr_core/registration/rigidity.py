"""Is what was measured one rigid piece? How much the residuals speak for a steady motion, or for a strain.

A bone that creeps while its points are collected, slices that lie too far apart and a scan that drifts leave a pattern:
the pose itself changes with time, or the source is strained. Six further unknowns describe either. Are they there? The
restricted likelihood of the best size of them, over that of none, in which the pose is integrated out (Patterson and
Thompson 1971). A smooth bias of any size and an error that neighbours share are allowed for in both, as they look
similar. What is compared are averages over blocks of neighbours: a single point's normal errs with its residual.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.spatial import cKDTree

from gapr_core.config import RegistrarConfig, RigidityConfig
from gapr_core.geometry import sampling
from gapr_core.registration.assessment import Assessment
from gapr_core.registration.bias_field import ROUNDED, smooth_correlation
from gapr_core.registration.covariance import covariance_of_strain, strains
from gapr_core.registration.refinement import Fit

Array = NDArray[np.float64]

BIASES_MM = np.array([0.0, 0.15, 0.3, 0.6, 1.2, 2.4])  # of the smooth bias, to choose from
SHARED_MM = np.array([0.05, 0.2, 0.5, 1.0])  # of what the points of a block share
SIZES_MM = np.array([0.0, 0.3, 0.6, 1.0, 1.7, 3.0, 5.0, 8.0, 12.0])  # of the further unknowns


class Evidence(NamedTuple):
    """What the residuals say of further unknowns.

    Attributes:
        log_ratio: log likelihood of their best size over that of none; 0 where none is best.
        size_mm: of each of the six, root mean square under the residuals, all `SIZES_MM` alike before.
    """

    log_ratio: float
    size_mm: float


NOTHING = Evidence(0.0, 0.0)


def of_creep(fit: Fit, order: NDArray[np.int64], config: RigidityConfig) -> Evidence:
    """Evidence that the bone moved steadily while the points were collected; of the motion from the first to the last.

    Args:
        fit: the pose that all points have in common.
        order: (N,) when each point was measured, as the number of its source: 0, 1, 2 and on.
        config: of the blocks.
    """
    inlier = fit.weights > 0.0
    if np.count_nonzero(inlier) < config.fewest_points or not order.max() > order.min():
        return NOTHING
    time = ((order - order.min()) / (order.max() - order.min()))[inlier]
    group = np.minimum(time * config.groups, config.groups - 1).astype(np.int64)
    motions, away = fit.jacobian[inlier].copy(), fit.moved[inlier] - fit.moved[inlier].mean(axis=0)
    motions[:, 3:] /= max(float(np.sqrt((away**2).sum(axis=1).mean())), 1.0)
    return evidence(blocks(fit, fit.jacobian[inlier], (time[:, None] - 0.5) * motions, group, config), config)


def of_strain(fit: Fit, config: RigidityConfig) -> Evidence:
    """Evidence that the source is longer, wider or slanted against the bone (see `covariance.strains`).

    A stand-off is no strain: it is taken out with the pose. Another size is one, whatever the sensor: what its scale
    may excuse may as well be another subject's bone.
    """
    inlier = fit.weights > 0.0
    count = np.count_nonzero(inlier)
    if count < config.fewest_points:
        return NOTHING
    free, at_once = np.column_stack([fit.jacobian[inlier], np.ones(count)]), np.zeros(count, dtype=np.int64)
    return evidence(blocks(fit, free, strains(fit), at_once, config), config)


def allowing_for_strain(assessment: Assessment, config: RegistrarConfig) -> Assessment:
    """The same where the residuals show no strain; else with what it adds to the covariance, and its size."""
    a = assessment
    found = of_strain(a.fit.rests_on, config.rigidity)
    if found.log_ratio <= config.rigidity.strained:
        return a
    covariance = a.uncertainty.covariance + covariance_of_strain(a.fit, found.size_mm, config.covariance)
    return replace(a, uncertainty=replace(a.uncertainty, covariance=covariance), strain_mm=found.size_mm)


@dataclass(frozen=True, eq=False)
class Blocks:
    """Averages over blocks of neighbouring inliers.

    Attributes:
        residuals: (n,) mm.
        free: (n, j) how they change by what is not in question: a motion of the source, at least.
        more: (n, k) how they change by the further unknowns, of 1 mm each.
        variances: (n,) what the noise of a point leaves in them, mm^2.
        feet: (n, 3) their places, mm.
    """

    residuals: Array
    free: Array
    more: Array
    variances: Array
    feet: Array


def blocks(fit: Fit, free: Array, more: Array, group: NDArray[np.int64], config: RigidityConfig) -> Blocks:
    """Averages of the inliers (n) of a fit, weighted as they count: over cells around points that are spread evenly.

    Args:
        fit: the residuals.
        free: (n, j) derivatives of the inliers' residuals by what is not in question.
        more: (n, k) the same by the further unknowns.
        group: (n,) number of a group; a block holds points of one.
        config: how many cells.
    """
    inlier = fit.weights > 0.0
    feet, weights = fit.feet[inlier], fit.weights[inlier]
    centres = feet[sampling.thin(feet.round(ROUNDED), min(config.cells, len(feet)))]
    cell = cKDTree(centres).query(feet)[1]
    block = np.unique(group * len(centres) + cell, return_inverse=True)[1].reshape(-1)
    columns = np.column_stack([fit.signed_mm[inlier], feet, free, more])
    total = np.bincount(block, weights)
    means = np.stack([np.bincount(block, weights * column) for column in columns.T], axis=1) / total[:, None]
    residuals, places, free, more = np.split(means, np.cumsum([1, 3, free.shape[1]]), axis=1)
    return Blocks(residuals[:, 0], free, more, fit.sigma_mm**2 / total, places)


def evidence(found: Blocks, config: RigidityConfig) -> Evidence:
    """What the blocks say of the further unknowns, whatever the bias and what the points of a block share."""
    correlation = smooth_correlation(found.feet, found.feet, config.correlation_mm)
    covariances = (
        np.diag(found.variances + shared**2) + bias**2 * correlation for bias in BIASES_MM for shared in SHARED_MM
    )
    log_likelihood = np.array([_log_likelihoods(found, V) for V in covariances])
    best = log_likelihood.max(axis=0)
    posterior = np.exp(log_likelihood - log_likelihood.max()).sum(axis=0)
    size_mm = float(np.sqrt(posterior @ SIZES_MM**2 / posterior.sum()))
    return Evidence(float(best.max() - best[0]), size_mm)


def _log_likelihoods(found: Blocks, V: Array) -> Array:
    """(K,) restricted log likelihood of each of `SIZES_MM`, of residuals whose other errors have the covariance V.

    With what is not in question projected out, the further unknowns have the information M and the score s: in the
    axes of M, y^T V^-1 y falls by sum h^2 s_i^2 / (1 + h^2 m_i), and log det grows by sum log(1 + h^2 m_i).
    """
    root = np.linalg.cholesky(V)
    columns = np.column_stack([found.free, found.more, found.residuals])
    white = solve_triangular(root, columns, lower=True, check_finite=False)
    count = found.free.shape[1]
    Q, singular, _ = np.linalg.svd(white[:, :count], full_matrices=False)
    shows = singular > 1e-9 * singular[0]  # on a plane, a motion along it does not
    Q, singular = Q[:, shows], singular[shows]
    left = white[:, count:] - Q @ (Q.T @ white[:, count:])
    more, residuals = left[:, :-1], left[:, -1]
    information, axes = np.linalg.eigh(more.T @ more)
    score = axes.T @ (more.T @ residuals)
    variances = SIZES_MM[:, None] ** 2
    gain = 1.0 + variances * np.maximum(information, 0.0)
    alone = -0.5 * residuals @ residuals - np.log(np.diag(root)).sum() - np.log(singular).sum()
    return np.asarray(alone + 0.5 * (variances * score**2 / gain - np.log(gain)).sum(axis=1))
