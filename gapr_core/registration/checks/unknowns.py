"""Tests of the residuals for further unknowns besides a pose: a motion, a strain, a layer, looks that err.

The restricted likelihood of their best size is compared with that of none, with the pose integrated out (Patterson and
Thompson 1971). Both allow for a smooth bias of any size and an error that neighbours share, as they look similar.
Averages over blocks of neighbours are compared: a single point's normal errs with its residual.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from gapr_core.geometry import extent, sampling
from gapr_core.geometry.twists import distance_jacobian
from gapr_core.registration.fit.refinement import Fit
from gapr_core.registration.uncertainty.linear_model import CORRELATION_MM, smooth_correlation

Array = NDArray[np.float64]

FEWEST_POINTS = 200  # least inliers for a test
CELLS = 40  # number of cells of the averages
BIASES_MM = np.array([0.0, 0.15, 0.3, 0.6, 1.2, 2.4])  # candidate sizes of the smooth bias
SHARED_MM = np.array([0.05, 0.2, 0.5, 1.0])  # candidate sizes of the shared error of a block
SIZES_MM = np.array([0.0, 0.3, 0.6, 1.0, 1.7, 3.0, 5.0, 8.0, 12.0])  # candidate sizes of the further unknowns


class Shown(NamedTuple):
    """Evidence of the residuals for further unknowns."""

    log_ratio: float  # log likelihood of their best size over that of none; 0 where none is best
    size_mm: float  # posterior root mean square of the size of each; all `SIZES_MM` are equally likely before


NOTHING = Shown(0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Blocks:
    """Averages over blocks of neighbouring inliers."""

    residuals: Array  # (n,) mm
    free: Array  # (n, j) derivatives by the nuisance unknowns: a motion of the source, at least
    more: Array  # (n, m, k) derivatives by the further unknowns, of 1 mm each: m alternatives of k at most, others 0
    variances: Array  # (n,) variances by the noise of the points, mm^2
    feet: Array  # (n, 3) mean foot points, mm


def blocks(fit: Fit, free: Array, more: list[Array], group: NDArray[np.int64]) -> Blocks:
    """Average the inliers (n) of a fit over cells around evenly spread points, by their weights.

    Args:
        fit: the residuals.
        free: (n, j) their derivatives by the nuisance unknowns.
        more: m times (n, k), the same by the further unknowns; k may differ.
        group: (n,) number of a group; a block holds points of one.
    """
    inlier = fit.counts
    feet, weights = fit.feet[inlier], fit.weights[inlier]
    centres = feet[sampling.thin(feet, min(CELLS, len(feet)))]
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


def motions(fit: Fit) -> Array:
    """Compute (n, 6) changes of the inliers' residuals by shifts and turns about their middle, of 1 mm rms each."""
    inlier = fit.counts
    moved, normals = fit.moved[inlier], fit.gradients[inlier]
    return distance_jacobian(moved, normals, moved.mean(axis=0)) / np.repeat([1.0, extent.radius_mm(moved)], 3)


def shown(found: Blocks) -> list[Shown]:
    """Test each of the m alternatives, whatever the bias and the shared error of a block."""
    noise, correlation = np.diag(found.variances), smooth_correlation(found.feet, found.feet, CORRELATION_MM)
    shared = SHARED_MM[:, None, None] ** 2 * np.eye(len(noise))
    V = np.concatenate([noise + bias_mm**2 * correlation + shared for bias_mm in BIASES_MM])
    evidence = []
    for log_likelihood in _log_likelihoods(found, V).swapaxes(0, 1):
        best = log_likelihood.max(axis=0)
        posterior = np.exp(log_likelihood - log_likelihood.max()).sum(axis=0)
        size_mm = float(np.sqrt(posterior @ SIZES_MM**2 / posterior.sum()))
        evidence.append(Shown(float(best.max() - best[0]), size_mm))
    return evidence


def _log_likelihoods(found: Blocks, V: Array) -> Array:
    """Compute (e, m, K) restricted log likelihoods of each of `SIZES_MM`, with other errors of covariances V.

    With the nuisance unknowns projected out, the further unknowns have the information M and the score s. In the axes
    of M, y^T V^-1 y falls by sum h^2 s_i^2 / (1 + h^2 m_i), and log det grows by sum log(1 + h^2 m_i).

    Args:
        found: the n blocks, with m alternatives.
        V: (e, n, n) covariances of the residuals without the further unknowns, mm^2.
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
    log_det = 2.0 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)  # of V, and of its projected part
    log_det += 2.0 * np.log(np.where(shows, singular, 1.0)).sum(axis=1)
    alone = -0.5 * ((residuals**2).sum(axis=1) + log_det)
    more_alike = 0.5 * (variances * score[:, :, None] ** 2 / gain - np.log(gain)).sum(axis=3)
    return np.asarray(alone[:, None, None] + more_alike)
