"""Assessment of a refined pose: covariance, features, the two numbers, and the checks of geometry."""

from __future__ import annotations

from dataclasses import replace

from gapr_core.config import RegistrarConfig
from gapr_core.registration.checks import table
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.checks.deformation import with_looks
from gapr_core.registration.confidence.classifier import Classifier
from gapr_core.registration.confidence.features import BONE, measure
from gapr_core.registration.fit.refinement import Fit
from gapr_core.registration.fit.verification import Candidates
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.uncertainty import covariance
from gapr_core.registration.uncertainty.smooth_bias import corrected_fit


def assess_fit(
    fit: Fit,
    candidates: Candidates,
    source: PreparedSource,
    target: PreparedTarget,
    classifier: Classifier,
    config: RegistrarConfig,
) -> Assessment:
    """Assess a refined pose of a source of which all points may be bone.

    Args:
        fit: the refined pose and its residuals.
        candidates: the distinct poses, best first.
        source: the registered source.
        target: the bone.
        classifier: model of the two numbers.
        config: settings of the registration.
    """
    uncertainty = covariance.estimate(fit, config.covariance, config.sensor, source.around)
    features = measure(fit, candidates, uncertainty, source, target, config)
    judgement = classifier.judge(BONE, features)
    return checked_geometry(
        Assessment(fit, candidates, uncertainty, features, judgement, config.other_bone_prior, source, target), config
    )


def checked_geometry(assessment: Assessment, config: RegistrarConfig) -> Assessment:
    """Apply the checks of geometry; the costly ones only where the pose may still be accepted."""
    for check in table.GEOMETRY:
        assessment = check(assessment, config)
    for check in table.COSTLY:
        if assessment.reaches(config.worth_checking):
            assessment = check(assessment, config)
    return assessment


def bias_corrected(assessment: Assessment, config: RegistrarConfig) -> Assessment:
    """Move the pose to where a smooth bias does not pull it; the same object without evidence of a bias."""
    fit = corrected_fit(assessment.fit, assessment.uncertainty.covariance, assessment.source, assessment.target, config)
    if fit is assessment.fit:
        return assessment
    misfits_mm = assessment.uncertainty.smooth_mm, assessment.uncertainty.short_mm  # of the assessed fit
    eye = covariance.eye_of(fit.T, assessment.viewpoint, config.sensor)
    uncertainty = covariance.estimate(fit, config.covariance, config.sensor, None, misfits_mm, eye)
    return replace(assessment, fit=fit, uncertainty=with_looks(uncertainty, fit, assessment.look))
