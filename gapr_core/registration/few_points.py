"""Few points do not say whose bone it is: what limits the probability of a pose that rests on them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import logit

from gapr_core.config import RegistrarConfig
from gapr_core.registration.assessment import Assessment
from gapr_core.registration.bias_field import UNKNOWNS
from gapr_core.results import Refusal, RegistrationStatus

NAME = "few_points"  # of the limit, among the contributions to the log odds
NEARLY_ALL = 0.9  # share of the points


def limited(assessment: Assessment, config: RegistrarConfig) -> Assessment:
    """The same, no surer than a source of few points can be (`RulesConfig.few_points`).

    Bones of different subjects are alike to half a millimetre over a knee end. A dense source shows the difference as a
    misfit that near points share. Between sparse points it looks like noise, unless the noise is known
    (`SensorConfig.noise_mm`) and the residuals are no larger.
    """
    a, most = assessment, config.rules.few_points_confidence
    if len(a.source.points) >= config.rules.few_points or not a.probability > most or is_noise(a, config):
        return a
    lowered = {**a.contributions, NAME: float(logit(most) - logit(a.probability))}
    found = replace(a, probability=most, contributions=lowered)
    if a.refusal is not None or most >= config.min_confidence:
        return found
    reason = (
        f"{len(a.source.points)} points may as well be of another subject's bone, so the pose is right with a "
        f"probability of {most:g} at most, {config.min_confidence:g} is asked for: measure at least "
        f"{config.rules.few_points} points, or state how precise they are (noise_mm of the sensor)"
    )
    return replace(found, refusal=Refusal(RegistrationStatus.LOW_CONFIDENCE, reason))


def is_noise(assessment: Assessment, config: RegistrarConfig) -> bool:
    """True where the noise is stated, nearly all points count for the pose, and their residuals are no larger."""
    counts = assessment.fit.weights > 0.0
    left = counts.sum() - UNKNOWNS
    if config.sensor.noise_mm is None or left <= 0 or counts.mean() < NEARLY_ALL:
        return False
    residual_mm = np.sqrt((assessment.fit.signed_mm[counts] ** 2).sum() / left)
    return bool(residual_mm <= config.rules.noise_share * config.sensor.noise_mm)
