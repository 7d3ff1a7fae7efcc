"""Hollow bones: a model with an inner and an outer cortex, and sources that follow both.

No probe sees the inner cortex, so a source is registered to the outer one alone. A source that was cut out of such a
model follows both; the residuals show it.
"""

from __future__ import annotations

import numpy as np

from gapr_core.config import RegistrarConfig
from gapr_core.registration.assessment import Assessment
from gapr_core.registration.refinement import evaluate


def follows_both(assessment: Assessment, config: RegistrarConfig) -> bool:
    """True when the inner cortex explains much of what the outer one leaves open."""
    both = assessment.target.both_cortices
    if both is None:
        return False
    fit = evaluate(assessment.fit.T, assessment.source.points, both, config.refinement)
    return bool(fit.sigma_mm < config.cortices.share * np.exp(assessment.features["log_sigma"]))
