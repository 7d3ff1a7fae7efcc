"""A smooth bias as a Gaussian process over the source, and how large the residuals say it is.

The field has correlation exp(-d^2 / 2 l^2) and is spanned by a few dozen of the inliers (Nystrom). Its size follows
from the residuals by restricted maximum likelihood, in which the pose is integrated out (Patterson and Thompson 1971;
Rasmussen and Williams 2006, section 2.7).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_triangular
from scipy.spatial.distance import cdist

from gapr_core.geometry import sampling
from gapr_core.registration.refinement import Fit

Array = NDArray[np.float64]

POSE_PRIOR = np.diag([1e-6] * 3 + [1e-3] * 3)  # information of an unobserved motion, in units of 1 / noise variance
PIVOT = 1e-6  # on the diagonal of the centres' correlation, so that it can be factored


@lru_cache(maxsize=4)  # covariance, size and bias of one fit ask in turn
def fields(fit: Fit, correlation_mm: float, centres: int) -> Array:
    """(N, m) whose products are the correlation of the bias between points, from m of the inliers (Nystrom).

    Read-only: the same fit gets the same array.
    """
    spanned = _spanned(fit.moved, fit.weights > 0.0, correlation_mm, centres)
    spanned.flags.writeable = False
    return spanned


def _spanned(points: Array, inlier: NDArray[np.bool_], correlation_mm: float, centres: int) -> Array:
    inliers = points[inlier]
    if not len(inliers):
        return np.zeros((len(points), 1))
    chosen = inliers[sampling.thin(inliers, min(centres, len(inliers)))]
    among = smooth_correlation(chosen, chosen, correlation_mm)
    to_points = smooth_correlation(chosen, points, correlation_mm)
    root = np.linalg.cholesky(among + PIVOT * np.eye(len(chosen)))
    return np.asarray(solve_triangular(root, to_points, lower=True).T)


def smooth_correlation(a: Array, b: Array, length_mm: float) -> Array:
    """(N, M) exp(-d^2 / 2 l^2) between points (N, 3) and (M, 3): how alike a smooth bias is in both."""
    return np.asarray(np.exp(-0.5 * cdist(a, b, "sqeuclidean") / length_mm**2))


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
    def of(cls, fit: Fit, fields: Array, more: Array | None = None, sizes: ArrayLike = ()) -> NormalEquations:
        """Those of a fit; points without weight count for nothing.

        Args:
            fit: its residuals and motions.
            fields: (N, m) of the bias.
            more: (N, k) derivatives of the residuals by further unknowns, after the six of the motion.
            sizes: (k,) standard deviations of these before the residuals are seen.
        """
        W = fit.weights[:, None] / fit.sigma_mm**2
        J, y, prior = fit.jacobian, np.nan_to_num(fit.signed_mm), np.diag(POSE_PRIOR)
        if more is not None:
            J, prior = np.column_stack([J, more]), np.append(prior, 1.0 / np.square(sizes))
        WJ, WF = W * J, W * fields
        return cls(J.T @ WJ + np.diag(prior), WJ.T @ fields, fields.T @ WF, WJ.T @ y, WF.T @ y)

    def log_likelihood(self, sizes_mm: Array, smallest_share: float) -> Array:
        """(K,) restricted log likelihood of standard deviations (K,) of the bias; 0 without a bias.

        Only the fields that the points determine best count: those with `smallest_share` of the information of the best
        one. The others are rough, and what the surface's model leaves at edges would pass for a bias.
        """
        free = np.linalg.solve(self.JJ, np.column_stack([self.JF, self.Jy]))  # what a motion takes up
        information, directions = np.linalg.eigh(self.FF - self.JF.T @ free[:, :-1])
        score = directions.T @ (self.Fy - self.JF.T @ free[:, -1])
        smooth = information > smallest_share * max(information[-1], 0.0)
        variances = np.square(sizes_mm)[:, None]
        gain = 1.0 + variances * information[smooth]
        return np.asarray(0.5 * (variances * score[smooth] ** 2 / gain - np.log(gain)).sum(axis=1))

    def step(self, size_mm: float) -> Array:
        """(6 + k,) x y z (mm) rx ry rz (rad), then the further unknowns: the best fit with a bias of this size."""
        taken = self._taken(size_mm)
        return np.asarray(-np.linalg.solve(self.JJ - self.JF @ taken[:, :-1], self.Jy - self.JF @ taken[:, -1]))

    def step_covariance(self, size_mm: float) -> Array:
        """(6 + k, 6 + k) covariance of `step` under the noise and a bias of this size."""
        return np.asarray(np.linalg.inv(self.JJ - self.JF @ self._taken(size_mm)[:, :-1]))

    def _taken(self, size_mm: float) -> Array:
        """(m, 7 + k) what the bias takes up of the motions and of the residuals."""
        A = self.FF + np.eye(len(self.FF)) / size_mm**2
        return np.asarray(np.linalg.solve(A, np.column_stack([self.JF.T, self.Fy])))


def root_mean_square(sizes_mm: Array, log_posterior: Array) -> float:
    """sqrt(E[size^2]) over sizes (K,) with log posterior (K,), which need not be normalised."""
    posterior = np.exp(log_posterior - log_posterior.max())
    return float(np.sqrt(posterior @ np.square(sizes_mm) / posterior.sum()))
