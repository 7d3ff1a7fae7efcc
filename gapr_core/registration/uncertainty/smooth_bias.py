"""The pose corrected for a smooth bias: soft tissue, a warped scan, a badly calibrated probe.

Such a bias moves whole regions along their normals, and with least squares the pose. Here it is a nuisance: the field
of `linear_model`, of a size by the residuals. The pose is that of generalised least squares.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gapr_core.config import RegistrarConfig
from gapr_core.geometry import se3
from gapr_core.geometry.twists import error_twist, nees
from gapr_core.registration.fit.refinement import Fit, evaluate_trusted, evaluate_with_patches, trust_of_whole
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.uncertainty.linear_model import NormalEquations, equations_of, fields, root_mean_square

Array = NDArray[np.float64]

SIZES_MM = np.array([0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.25, 1.5, 2.0])  # standard deviations
EVIDENCE = 2.0  # log likelihood ratio from which a bias is believed
SMALLEST_SHARE = 0.15  # least information of a usable field, over the largest
STEPS = 2  # of the pose
FEWEST_POINTS = 200  # least inliers for a bias
LARGEST_MOVE = 22.5  # largest squared Mahalanobis distance of a move (chi square: 99.9 %)


def corrected_fit(
    fit: Fit, covariance: Array, source: PreparedSource, target: PreparedTarget, config: RegistrarConfig
) -> Fit:
    """Correct a fit by some steps of generalised least squares; `fit` itself where its residuals show no bias.

    A move that the covariance (6, 6) of `fit` all but rules out is not made: an answer stays near the assessed pose.
    """
    refinement, before = config.refinement, fit.full_fit
    if np.count_nonzero(before.counts) < FEWEST_POINTS:
        return fit
    trust = None if fit.whole is None else trust_of_whole(fit, source, refinement)

    def of_points(T: Array) -> Fit:
        return evaluate_with_patches(T, source.points, target, refinement, source.neighbours)

    def at(T: Array) -> Fit:
        return of_points(T) if trust is None else evaluate_trusted(T, source.whole, target, refinement, trust)

    spanned, equations, corrected = fields(before), equations_of(before), before
    for number in range(STEPS):
        if number:
            equations = NormalEquations.of(corrected, spanned).with_design_effect(equations.design_effect)
        size_mm = believed_size_mm(equations)
        if size_mm == 0.0:
            break
        T = se3.exp(equations.step(size_mm), corrected.moved.mean(axis=0)) @ corrected.T
        corrected = replace(at(T), bias_mm=size_mm)
    if corrected is before or not nees(error_twist(corrected.T, fit.T, source.points), covariance) < LARGEST_MOVE:
        return fit
    return corrected if trust is None else replace(of_points(corrected.T), bias_mm=corrected.bias_mm, whole=corrected)


def believed_size_mm(equations: NormalEquations) -> float:
    """Compute the standard deviation of the bias: its posterior root mean square; 0 without evidence."""
    log_likelihood = equations.log_likelihood(SIZES_MM, SMALLEST_SHARE)
    return 0.0 if log_likelihood.max() < EVIDENCE else root_mean_square(SIZES_MM, log_likelihood)
