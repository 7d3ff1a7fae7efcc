"""How large the error at the target is: the predicted one, corrected by what was measured, and its 95 % bound.

The covariance of a pose predicts the root-mean-square error over any points, the root of the mean of their traces of
J Sigma J^T. How much larger the true error is depends on what the residuals cannot show. An additive model of a few
features scales the covariance; a factor, found by conformal prediction over subjects and sensor families (Vovk et al.
2005; Papadopoulos et al. 2002 for the normalised score), takes its 95 % quantile to a bound that 95 % of the true
errors stay below.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gapr_core.errors import WeightsError
from gapr_core.registration.confidence.additive import FIT_AGAIN, Additive, from_dict, read

SHIPPED = Path(__file__).parents[2] / "weights" / "precision.json"
PRECISION_FEATURES = (
    "log_tre", "log_sigma", "log_excess", "smooth_misfit", "short_misfit", "log_points", "extent", "log_turn_sd",
)  # fmt: skip
SCALE_LIMITS = (0.9, 6.0)  # of a standard deviation: what was learned may enlarge it, and hardly make it smaller


@dataclass(frozen=True, eq=False)
class Precision:
    """What was learned about true errors.

    Attributes:
        model: of the logarithm of the scale that a predicted standard deviation needs.
        factor95: a true error stays below so many predicted 95 % quantiles in 95 % of the accepted answers.
        card: where it comes from.
    """

    model: Additive
    factor95: float
    card: dict[str, object]

    @staticmethod
    def load(path: str | Path = SHIPPED) -> Precision:
        """Read the model.

        Raises:
            WeightsError: no such file, one of another format or of other features, or a damaged one.
        """
        path = Path(path)
        data = read(path, "precision")
        try:
            precision = Precision(from_dict(data), float(data["factor95"]), dict(data["card"]))
        except (ValueError, KeyError, TypeError) as error:
            raise WeightsError("a whole precision model", f"{path}: {error!r}", FIT_AGAIN) from error
        if precision.model.features != PRECISION_FEATURES:
            raise WeightsError(f"a model of {PRECISION_FEATURES}", f"{path}: {precision.model.features}", FIT_AGAIN)
        if not 0.0 < precision.factor95 < np.inf:
            raise WeightsError("a finite factor95 above 0", f"{path}: {precision.factor95}", FIT_AGAIN)
        return precision

    @staticmethod
    def unscaled() -> Precision:
        """Predictions as the covariance gives them: only for the records that a model is fitted to."""
        return Precision(Additive(0.0, ()), 1.0, {})

    def scale(self, features: Mapping[str, float], tre_mm: float) -> float:
        """What a standard deviation of the covariance is to be multiplied by.

        Args:
            features: of the answer (`features.FEATURES` or `features.SCENE_FEATURES`).
            tre_mm: the whole-bone error that the covariance predicts, mm.
        """
        log_scale = self.model.value({**features, "log_tre": float(np.log(max(tre_mm, 1e-6)))})
        return float(np.clip(np.exp(log_scale), *SCALE_LIMITS))
