"""Calibration of the error at the target: the predicted error, corrected by measured ones, and its 95 % bound.

The covariance of a pose predicts the root-mean-square error over any points: the root of the mean trace of J Sigma J^T.
The ratio of the true error to it depends on errors that the residuals cannot show. An additive model of a few features
scales the covariance. A factor takes its 95 % quantile to a bound of 95 % of the true errors. It is found by conformal
prediction over subjects and sensor families (Vovk et al. 2005; Papadopoulos et al. 2002 for the normalised score).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gapr_core.errors import WeightsError
from gapr_core.registration.confidence.additive import FIT_AGAIN, Additive, from_dict, load

SHIPPED = Path(__file__).parents[2] / "weights" / "precision.json"
PRECISION_FEATURES = (
    "log_tre", "log_sigma", "log_excess", "smooth_misfit", "short_misfit", "log_points", "extent", "log_turn_sd",
)  # fmt: skip
SCALE_LIMITS = (0.9, 6.0)  # of a standard deviation: the model may enlarge it, and hardly shrink it


@dataclass(frozen=True, eq=False)
class Precision:
    """A correction of predicted errors, learned from true ones."""

    model: Additive  # of the log of the scale of a predicted standard deviation
    confidences: tuple[float, ...]  # (K,) ascending confidences of the factors
    factors: tuple[float, ...]  # (K,) bound of 95 % of the true errors, over the predicted 95 % quantile
    card: dict[str, object]  # data and fit

    @staticmethod
    def load(path: str | Path = SHIPPED) -> Precision:
        """Read the model.

        Raises:
            WeightsError: no such file, another format, other features, or a damaged file.
        """

        def build(data: dict[str, Any]) -> Precision:
            at, factors = (tuple(map(float, data[name])) for name in ("confidences", "factors"))
            return Precision(from_dict(data), at, factors, dict(data["card"]))

        precision = load(path, "precision", build)
        at, factors = precision.confidences, precision.factors
        if precision.model.features != PRECISION_FEATURES:
            raise WeightsError(f"a model of {PRECISION_FEATURES}", f"{path}: {precision.model.features}", FIT_AGAIN)
        is_usable = len(at) == len(factors) > 0 and list(at) == sorted(at) and all(0.0 < f < np.inf for f in factors)
        if not is_usable:
            raise WeightsError("finite factors above 0 at ascending confidences", f"{path}: {at}, {factors}", FIT_AGAIN)
        return precision

    @staticmethod
    def unscaled() -> Precision:
        """Leave predictions as they are: for the records that a model is fitted to."""
        return Precision(Additive(0.0, ()), (0.5,), (1.0,), {})

    def scale(self, features: Mapping[str, float], tre_mm: float) -> float:
        """Compute the scale of a standard deviation from the features and the predicted whole-bone error, mm."""
        log_scale = self.model.value({**features, "log_tre": float(np.log(max(tre_mm, 1e-6)))})
        return float(np.clip(np.exp(log_scale), *SCALE_LIMITS))

    def factor95(self, confidence: float) -> float:
        """Interpolate the factor of the bound at a confidence: surer answers have a tighter one."""
        return float(np.interp(confidence, self.confidences, self.factors))
