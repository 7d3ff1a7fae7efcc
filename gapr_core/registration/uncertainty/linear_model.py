"""A smooth bias as a Gaussian process over the source, and its size by the residuals.

The field has correlation exp(-d^2 / 2 l^2) and is spanned by a few dozen of the inliers (Nystrom), at their foot
points. Its size follows from the residuals by restricted maximum likelihood, with the pose integrated out (Patterson
and Thompson 1971; Rasmussen and Williams 2006, section 2.7). Errors that only near points share enlarge the noise of
sums by a design effect (Kish 1965).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_triangular
from scipy.spatial.distance import cdist

from gapr_core.geometry import sampling
from gapr_core.registration.fit.refinement import Fit

Array = NDArray[np.float64]

CORRELATION_MM, CENTRES = 20.0, 60  # l of the bias's correlation exp(-d^2 / 2 l^2), and points that span the bias
DESIGN_EFFECTS = np.geomspace(0.25, 20.0, 16)  # to choose from
EFFECT_SPREAD = 0.7  # log standard deviation of the design effect about 1 before the scores are seen
BIASES_MM = np.array([0.0, 0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.25, 1.5, 2.0, 3.0])
DETERMINED = 1e-5  # least information of a field over the largest; below, its score is rounding
UNKNOWNS = 6  # of a pose: as few points carry no information on their errors
POSE_PRIOR = np.diag([1e-6] * 3 + [1e-3] * 3)  # information of an unobserved motion, in units of 1 / noise variance
PIVOT = 1e-6  # on the diagonal of the centres' correlation, so that it can be factored


@lru_cache(maxsize=4)  # covariance, size and bias of one fit share it
def fields(fit: Fit, correlation_mm: float = CORRELATION_MM, centres: int = CENTRES) -> Array:
    """Compute (N, m) fields whose products are the bias's correlation between foot points; m inliers span them."""
    points, inliers = fit.feet, fit.feet[fit.counts]
    spanned = np.zeros((len(points), 1))
    if len(inliers):
        chosen = inliers[sampling.thin(inliers, min(centres, len(inliers)))]
        among = smooth_correlation(chosen, chosen, correlation_mm)
        to_points = smooth_correlation(points, chosen, correlation_mm)
        root = np.linalg.cholesky(among + PIVOT * np.eye(len(chosen)))
        spanned = to_points @ solve_triangular(root, np.eye(len(chosen)), lower=True).T
    spanned.flags.writeable = False
    return spanned


def smooth_correlation(a: Array, b: Array, length_mm: float) -> Array:
    """Compute the (N, M) correlation exp(-d^2 / 2 l^2) of a smooth bias between points (N, 3) and (M, 3)."""
    exponent = cdist(a, b, "sqeuclidean")
    exponent *= -0.5 / length_mm**2
    return np.asarray(np.exp(exponent, out=exponent))


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Weighted inner products of residuals y, motions J (N, 6) and fields F (N, m) of unit variance."""

    JJ: Array  # (6 + k, 6 + k) J^T W J; W is the inverse variance of the points, k the number of further unknowns
    JF: Array  # (6 + k, m)
    FF: Array  # (m, m)
    Jy: Array  # (6 + k,)
    Fy: Array  # (m,)
    design_effect: float = 1.0  # divisor of W, since near points err alike (see `with_design_effect`)

    @classmethod
    def of(cls, fit: Fit, fields: Array) -> NormalEquations:
        """Build the equations of a fit and fields (N, m) of the bias; points without weight do not count."""
        m, inlier = fields.shape[1], np.flatnonzero(fit.weights)
        root = np.sqrt(fit.weights[inlier])[:, None] / fit.sigma_mm
        R = np.empty((len(inlier), m + 7))
        np.multiply(fields[inlier], root, out=R[:, :m])
        np.multiply(fit.jacobian[inlier], root, out=R[:, m:-1])
        np.multiply(fit.signed_mm[inlier, None], root, out=R[:, -1:])
        P = R.T @ R  # the rows carry the root of W: a symmetric product takes half the time
        return cls(P[m:-1, m:-1] + POSE_PRIOR, P[m:-1, :m], P[:m, :m], P[m:-1, -1], P[:m, -1])

    def with_design_effect(self, effect: float) -> NormalEquations:
        """Multiply the variance of sums of points by `effect`, for errors that near points share (Kish 1965)."""
        JJ, JF, FF, Jy, Fy = (each / effect for each in (self.JJ, self.JF, self.FF, self.Jy, self.Fy))
        return NormalEquations(JJ, JF, FF, Jy, Fy, self.design_effect * effect)

    def expected_design_effect(self) -> float:
        """Compute the geometric mean of the design effect under the scores, with a smooth bias of any size.

        A score s of a field with information i has variance k i + b^2 i^2 under a design effect k and a bias b.
        """
        information, score = self._fields_alone
        determined = information > DETERMINED * max(information[-1], 0.0)
        i, s = information[determined], score[determined]
        k, b = DESIGN_EFFECTS[:, None, None], BIASES_MM[:, None]
        variances = k * i + b**2 * i**2
        log_likelihood = -0.5 * (s**2 / variances + np.log(variances)).sum(axis=-1)
        log_k = np.log(DESIGN_EFFECTS)
        log_posterior = log_likelihood - 0.5 * (log_k[:, None] / EFFECT_SPREAD) ** 2
        posterior = np.exp(log_posterior - log_posterior.max()).sum(axis=1)
        return float(np.exp(posterior @ log_k / posterior.sum()))

    def extended(self, fit: Fit, fields: Array, more: Array, sizes: ArrayLike) -> NormalEquations:
        """Add further unknowns after the six of the motion.

        Args:
            fit: its residuals and motions, as in `of`.
            fields: (N, m) of the bias, as in `of`.
            more: (N, k) derivatives of the residuals by the further unknowns.
            sizes: (k,) standard deviations of these before the residuals are seen.
        """
        weighted = fit.weights[:, None] / (self.design_effect * fit.sigma_mm**2) * more
        across, y = fit.jacobian.T @ weighted, np.nan_to_num(fit.signed_mm)
        JJ = np.block([[self.JJ, across], [across.T, more.T @ weighted + np.diag(1.0 / np.square(sizes))]])
        JF, Jy = np.vstack([self.JF, weighted.T @ fields]), np.append(self.Jy, weighted.T @ y)
        return NormalEquations(JJ, JF, self.FF, Jy, self.Fy, self.design_effect)

    def log_likelihood(self, sizes_mm: Array, smallest_share: float) -> Array:
        """Compute the (K,) restricted log likelihood of standard deviations (K,) of the bias; 0 without a bias.

        Only fields with `smallest_share` of the information of the best one count: in rough ones, misfits of the
        surface's model at edges would pass for a bias.
        """
        information, score = self._fields_alone
        smooth = information > smallest_share * max(information[-1], 0.0)
        variances = np.square(sizes_mm)[:, None]
        gain = 1.0 + variances * information[smooth]
        return np.asarray(0.5 * (variances * score[smooth] ** 2 / gain - np.log(gain)).sum(axis=1))

    @cached_property
    def _fields_alone(self) -> tuple[Array, Array]:
        """(m,) information of independent fields, ascending, and their scores, with the motion projected out."""
        free = np.linalg.solve(self.JJ, np.column_stack([self.JF, self.Jy]))
        information, directions = np.linalg.eigh(self.FF - self.JF.T @ free[:, :-1])
        return information, directions.T @ (self.Fy - self.JF.T @ free[:, -1])

    def step(self, size_mm: float) -> Array:
        """Compute the best fit (6 + k,) with a bias of this size: x y z (mm) rx ry rz (rad), further unknowns."""
        taken = self._taken(size_mm)
        return np.asarray(-np.linalg.solve(self.JJ - self.JF @ taken[:, :-1], self.Jy - self.JF @ taken[:, -1]))

    def step_covariance(self, size_mm: float) -> Array:
        """Compute the (6 + k, 6 + k) covariance of `step` under the noise and a bias of this size."""
        return np.asarray(np.linalg.inv(self.JJ - self.JF @ self._taken(size_mm)[:, :-1]))

    def _taken(self, size_mm: float) -> Array:
        """Compute the (m, 7 + k) share of the bias in the motions and in the residuals."""
        A = self.FF + np.eye(len(self.FF)) / size_mm**2
        return np.asarray(np.linalg.solve(A, np.column_stack([self.JF.T, self.Fy])))


@lru_cache(maxsize=4)  # as `fields`
def equations_of(fit: Fit) -> NormalEquations:
    """Build `NormalEquations.of` a fit and its own `fields`, with the design effect of their scores."""
    equations = NormalEquations.of(fit, fields(fit))
    if np.count_nonzero(fit.weights) <= UNKNOWNS:  # a motion fits them exactly; the rest is rounding
        return equations
    return equations.with_design_effect(equations.expected_design_effect())


def root_mean_square(sizes_mm: Array, log_posterior: Array) -> float:
    """Compute sqrt(E[size^2]) over sizes (K,) with log posterior (K,), which need not be normalised."""
    posterior = np.exp(log_posterior - log_posterior.max())
    return float(np.sqrt(posterior @ np.square(sizes_mm) / posterior.sum()))
