"""Assessment of a refined pose: covariance, features, the two numbers, and the checks of geometry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from gapr_core.config import RegistrarConfig
from gapr_core.registration.checks import table
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.checks.deformation import with_looks
from gapr_core.registration.confidence.classifier import Classifier
from gapr_core.registration.confidence.features import BONE, SCENE, measure
from gapr_core.registration.fit.refinement import Fit, evaluate
from gapr_core.registration.fit.verification import Candidates
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.uncertainty import covariance
from gapr_core.registration.uncertainty.smooth_bias import corrected_fit

BOTH_SHARE, BOTH_NOISE = 0.82, 1.5  # residual scale to both cortices, over that to the outer one and over the noise


def assess_fit(
    fit: Fit,
    candidates: Candidates,
    source: PreparedSource,
    target: PreparedTarget,
    classifier: Classifier,
    config: RegistrarConfig,
    of_view: Mapping[str, float] | None = None,
    **view: Any,
) -> Assessment:
    """Assess a refined pose.

    Args:
        fit, candidates: the refined pose and the distinct poses, best first.
        source, target: the registered source and the bone.
        classifier: model of the two numbers.
        config: settings of the registration.
        of_view: features of a camera's view (`scene_fit.features_of_view`); None of a source that is bone alone.
        view: with it, fields `seen`, `members`, `viewpoint` and `look` of the assessment.
    """
    eye = covariance.eye_of(fit.T, view.get("viewpoint"), config.sensor)
    uncertainty = covariance.estimate(fit, config.covariance, config.sensor, source.around, eye=eye)
    uncertainty = with_looks(uncertainty, fit, view.get("look"))
    features = measure(fit, candidates, uncertainty, source, target, config, of_view)
    judgement = classifier.judge(BONE if of_view is None else SCENE, features)
    known = fit, candidates, uncertainty, features, judgement, config.other_bone_prior, source, target
    return checked_geometry(Assessment(*known, **view), config)


def checked_geometry(a: Assessment, config: RegistrarConfig) -> Assessment:
    """Apply the checks of geometry; the costly one only where the pose may still be accepted."""
    a = table.equal_rival(table.unobserved_motion(a))
    return table.flat_valley(a, config) if a.reaches(config.worth_checking) else a


def with_both_cortices(assessment: Assessment, config: RegistrarConfig) -> PreparedTarget | None:
    """Return a hollow bone whose inner cortex explains the residuals, down to the noise of the source; else None.

    No probe sees the inner cortex, but a source cut out of such a model follows both. Two nearby sheets shrink the
    residuals of any bad fit; only a source that lies on both leaves nothing but its noise.
    """
    both = assessment.target.both_cortices
    if both is None:
        return None
    sigma_mm = evaluate(assessment.fit.T, assessment.source.points, both, config.refinement).sigma_mm
    noise_mm = max(float(np.median(assessment.source.flatness_mm)), config.refinement.smallest_sigma_mm)
    return both if sigma_mm < BOTH_SHARE * assessment.fit.sigma_mm and sigma_mm < BOTH_NOISE * noise_mm else None


def bias_corrected(assessment: Assessment, config: RegistrarConfig) -> Assessment:
    """Move the pose to where a smooth bias does not pull it; the same object without evidence of a bias."""
    fit = corrected_fit(assessment.fit, assessment.uncertainty.covariance, assessment.source, assessment.target, config)
    if fit is assessment.fit:
        return assessment
    misfits_mm = assessment.uncertainty.smooth_mm, assessment.uncertainty.short_mm  # of the assessed fit
    eye = covariance.eye_of(fit.T, assessment.viewpoint, config.sensor)
    uncertainty = covariance.estimate(fit, config.covariance, config.sensor, None, misfits_mm, eye)
    return replace(assessment, fit=fit, uncertainty=with_looks(uncertainty, fit, assessment.look))
