"""Hollow bones: a model with an inner and an outer cortex, and sources that follow both.

No probe sees the inner cortex, so a source is registered to the outer one alone. A source cut out of such a model
follows both; the residuals show it.
"""

from __future__ import annotations

from gapr_core.config import RegistrarConfig
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.fit.refinement import evaluate

SHARE, NOISE = 0.82, 1.5  # residual scale to both cortices over that to the outer one, and over the source's noise


def follows_both(assessment: Assessment, config: RegistrarConfig) -> bool:
    """Return True when the inner cortex explains the remaining residuals, down to the noise of the source.

    Two nearby sheets shrink the residuals of any bad fit, such as that of another subject's bone. Only a source that
    lies on both leaves nothing but its noise.
    """
    both = assessment.target.both_cortices
    if both is None:
        return False
    fit = evaluate(assessment.fit.T, assessment.source.points, both, config.refinement)
    noise_mm = max(assessment.source.noise_mm, config.refinement.smallest_sigma_mm)
    explains = fit.sigma_mm < SHARE * assessment.fit.sigma_mm
    return explains and fit.sigma_mm < NOISE * noise_mm
