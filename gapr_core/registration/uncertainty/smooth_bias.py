"""The pose corrected for a smooth bias: soft tissue, a warped scan, a badly calibrated probe.

Such a bias moves whole regions along their normals. Plain least squares treats their points as independent witnesses
and lets the regions pull the pose along. Here the bias is a nuisance: a Gaussian process over the surface with
correlation exp(-d^2 / 2 l^2), and the pose is that of generalised least squares, which leans on what varies faster than
the bias can. How large the bias is, and whether there is one, the residuals say themselves by restricted maximum
likelihood, in which the pose is integrated out (Patterson and Thompson 1971; Rasmussen and Williams 2006, section 2.7).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gapr_core.config import RegistrarConfig, SmoothBiasConfig
from gapr_core.geometry import se3
from gapr_core.geometry.twists import error_twist, nees
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.checks.rigidity import allowing_for_looks
from gapr_core.registration.fit.refinement import Fit, evaluate_trusted, evaluate_with_patches, trust_of_whole
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.uncertainty.covariance import estimate, eye_of
from gapr_core.registration.uncertainty.linear_model import NormalEquations, equations_of, fields, root_mean_square

Array = NDArray[np.float64]


def bias_corrected(assessment: Assessment, config: RegistrarConfig) -> Assessment:
    """The assessment with its pose, and what follows from it, moved to where a smooth bias does not pull it.

    Without evidence of a bias the same object comes back.
    """
    a = assessment
    fit = corrected_fit(a.fit, a.uncertainty.covariance, a.source, a.target, config)
    if fit is a.fit:
        return a
    misfits_mm = a.uncertainty.smooth_mm, a.uncertainty.short_mm  # those that were assessed
    eye = eye_of(fit.T, a.viewpoint, config.sensor)
    uncertainty = estimate(fit, config.covariance, config.sensor, None, misfits_mm, eye)
    return replace(a, fit=fit, uncertainty=allowing_for_looks(uncertainty, fit, a.look, config))


def corrected_fit(
    fit: Fit, covariance: Array, source: PreparedSource, target: PreparedTarget, config: RegistrarConfig
) -> Fit:
    """The fit after some steps of generalised least squares; `fit` itself where its residuals show no bias.

    All points that it rests on take part: the more, the better they tell noise from bias. A move that the covariance
    all but rules out is not made: an answer must stay near what was assessed.

    Args:
        fit: from `refinement.refine_fully`, or from `rest_on_whole` after it.
        covariance: (6, 6) of `fit`, as `gapr_core.registration.uncertainty.covariance.estimate` gives it.
        source, target: what was refined, and on what.
        config: of the bias, and of the refinement as `fit` was refined.
    """
    bias, refinement, before = config.smooth_bias, config.refinement, fit.rests_on
    if np.count_nonzero(before.weights) < bias.fewest_points:
        return fit
    trust = None if fit.whole is None else trust_of_whole(fit, source, refinement)

    def of_points(T: Array) -> Fit:
        return evaluate_with_patches(T, source.points, target, refinement, source.neighbours)

    def at(T: Array) -> Fit:
        return of_points(T) if trust is None else evaluate_trusted(T, source.whole, target, refinement, trust)

    spanned, corrected = fields(before, bias.correlation_mm, bias.centres), before
    equations = equations_of(before, bias.correlation_mm, bias.centres)
    for number in range(bias.iterations):
        if number:
            equations = NormalEquations.of(corrected, spanned).with_design_effect(equations.design_effect)
        size_mm = believed_size_mm(equations, bias)
        if size_mm == 0.0:
            break
        T = se3.exp(equations.step(size_mm), corrected.moved.mean(axis=0)) @ corrected.T
        corrected = replace(at(T), bias_mm=size_mm)
    if corrected is before or not nees(error_twist(corrected.T, fit.T, source.points), covariance) < bias.largest_move:
        return fit
    return corrected if trust is None else replace(of_points(corrected.T), bias_mm=corrected.bias_mm, whole=corrected)


def believed_size_mm(equations: NormalEquations, config: SmoothBiasConfig) -> float:
    """Standard deviation of the bias: its posterior root mean square over `config.sizes_mm`; 0 without evidence."""
    sizes_mm = np.array(config.sizes_mm)
    log_likelihood = equations.log_likelihood(sizes_mm, config.smallest_share)
    return 0.0 if log_likelihood.max() < config.evidence else root_mean_square(sizes_mm, log_likelihood)
