"""The pose when a smooth misfit is reckoned with: soft tissue, a warped scan, a probe that is calibrated badly.

Such a bias moves whole regions along their normals. Plain least squares takes each of their points for a witness of its
own, and lets the regions pull the pose along. Here the bias is a nuisance: a Gaussian process over the surface with
correlation exp(-d^2 / 2 l^2), and the pose is that of generalised least squares, which leans on what varies faster than
the bias can. How large the bias is, and whether there is one, the residuals say themselves by restricted maximum
likelihood, in which the pose is integrated out (Patterson and Thompson 1971; Rasmussen and Williams 2006, section 2.7).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from gapr_core.config import RefinementConfig, SmoothBiasConfig
from gapr_core.covariance import POSE_PRIOR, smooth_correlation
from gapr_core.geometry import sampling, se3
from gapr_core.metrics.uncertainty import error_twist, nees
from gapr_core.refinement import Fit, evaluate_with_patches
from gapr_core.source import PreparedSource
from gapr_core.target import PreparedTarget

Array = NDArray[np.float64]

PIVOT = 1e-6  # on the diagonal of the centres' correlation, so that it can be factored


@dataclass(frozen=True)
class NormalEquations:
    """Weighted inner products of residuals y, motions J (N, 6) and fields F (N, m) of unit variance.

    Attributes:
        JJ, JF, FF, Jy, Fy: J^T W J and so on; W is the inverse variance of the points.
    """

    JJ: Array
    JF: Array
    FF: Array
    Jy: Array
    Fy: Array

    @classmethod
    def of(cls, fit: Fit, fields: Array) -> NormalEquations:
        """Those of a fit; points without weight count for nothing."""
        W = fit.weights[:, None] / fit.sigma_mm**2
        J, y = fit.jacobian, np.nan_to_num(fit.signed_mm)
        WJ, WF = W * J, W * fields
        return cls(J.T @ WJ + POSE_PRIOR, WJ.T @ fields, fields.T @ WF, WJ.T @ y, WF.T @ y)

    def size_mm(self, config: SmoothBiasConfig) -> float:
        """Standard deviation of the bias: its posterior root mean square over `config.sizes_mm`; 0 without evidence.

        Only the fields that the points determine best have a say. The others are rough, and what the surface's model
        leaves at edges would pass for a bias.
        """
        free = np.linalg.solve(self.JJ, np.column_stack([self.JF, self.Jy]))  # what a motion takes up
        information, directions = np.linalg.eigh(self.FF - self.JF.T @ free[:, :-1])
        score = directions.T @ (self.Fy - self.JF.T @ free[:, -1])
        smooth = information > config.smallest_share * information[-1]
        variances = np.square(config.sizes_mm)[:, None]
        gain = 1.0 + variances * information[smooth]
        log_likelihood = 0.5 * (variances * score[smooth] ** 2 / gain - np.log(gain)).sum(axis=1)  # 0 without a bias
        if log_likelihood.max() < config.evidence:
            return 0.0
        posterior = np.exp(log_likelihood - log_likelihood.max())
        return float(np.sqrt((posterior @ variances[:, 0]) / posterior.sum()))

    def step(self, size_mm: float) -> Array:
        """(6,) x y z (mm) rx ry rz (rad): the motion that fits best beside a bias of this size."""
        A = self.FF + np.eye(len(self.FF)) / size_mm**2
        taken = np.linalg.solve(A, np.column_stack([self.JF.T, self.Fy]))
        return np.asarray(-np.linalg.solve(self.JJ - self.JF @ taken[:, :-1], self.Jy - self.JF @ taken[:, -1]))


def compensate(
    fit: Fit,
    covariance: Array,
    source: PreparedSource,
    target: PreparedTarget,
    config: SmoothBiasConfig,
    refinement: RefinementConfig,
) -> Fit:
    """The fit moved to where it belongs if its residuals show a smooth bias; `fit` itself if they do not.

    A move that the covariance of the fit all but rules out is not made: what was judged is not left that far behind.

    Args:
        fit: from `refine_fully`.
        covariance: (6, 6) of `fit`, as `gapr_core.covariance.estimate` gives it.
        source, target: what was refined, and on what.
        config: of the bias.
        refinement: as `fit` was refined with.
    """
    if np.count_nonzero(fit.weights) < config.fewest_points:
        return fit
    fields, freed = _fields(fit, config), fit
    for _ in range(config.iterations):
        equations = NormalEquations.of(freed, fields)
        size_mm = equations.size_mm(config)
        if size_mm == 0.0:
            break
        T = se3.exp(equations.step(size_mm), freed.moved.mean(axis=0)) @ freed.T
        freed = evaluate_with_patches(T, source.points, target, refinement, source.neighbours)
    is_plausible = nees(error_twist(freed.T, fit.T, source.points), covariance) < config.largest_move
    return freed if is_plausible else fit


def _fields(fit: Fit, config: SmoothBiasConfig) -> Array:
    """(N, m) whose products are the correlation of the bias between points, from m of the inliers (Nystrom)."""
    inliers = fit.moved[fit.weights > 0.0]
    centres = inliers[sampling.thin(inliers, min(config.centres, len(inliers)))]
    among = smooth_correlation(centres, centres, config.correlation_mm)
    to_points = smooth_correlation(centres, fit.moved, config.correlation_mm)
    root = np.linalg.cholesky(among + PIVOT * np.eye(len(centres)))
    return np.asarray(solve_triangular(root, to_points, lower=True).T)
