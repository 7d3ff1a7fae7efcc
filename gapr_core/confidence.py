"""How probable it is that a pose is right: named figures of the fit, one calibrated logistic model.

The model's coefficients are fitted on train people over all protocols, right and wrong pairs alike, by
`gapr_core.training.calibration`; the file names the data and the fit.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gapr_core.covariance import PoseUncertainty
from gapr_core.errors import WeightsError
from gapr_core.refinement import Fit
from gapr_core.source import PreparedSource
from gapr_core.target import PreparedTarget
from gapr_core.verification import Candidates

Array = NDArray[np.float64]

WEIGHTS = Path(__file__).parent / "weights"
DEFAULT_CALIBRATION = WEIGHTS / "confidence.json"
CALIBRATIONS = {"network": WEIGHTS / "confidence_network.json", "track": WEIGHTS / "confidence_track.json"}


@dataclass(frozen=True)
class Calibration:
    """A logistic model over standardised features and their products.

    Attributes:
        names: the features, in the order of `means`, `scales`.
        means: (F,) and scales (F,) of the training set.
        weights: (1 + F + F (F + 1) / 2,) constant, linear and product terms.
        card: where it comes from.
    """

    names: tuple[str, ...]
    means: Array
    scales: Array
    weights: Array
    card: dict[str, object]

    @staticmethod
    def load(path: str | Path = DEFAULT_CALIBRATION) -> Calibration:
        """Read the model.

        Raises:
            WeightsError: no such file, or one made for other features.
        """
        path = Path(path)
        if not path.is_file():
            raise WeightsError("a confidence model", f"no file {path}", "reinstall the package")
        data = json.loads(path.read_text())
        if tuple(data["names"]) != FEATURES:
            raise WeightsError(f"a model of {FEATURES}", f"one of {data['names']}", "calibrate again")
        means, scales, weights = (np.asarray(data[key], dtype=np.float64) for key in ("means", "scales", "weights"))
        return Calibration(FEATURES, means, scales, weights, data["card"])

    @staticmethod
    def shipped(proposer: str) -> Calibration:
        """The model for an answer whose last hypotheses came from `proposer`.

        The network's few poses, and those that a `Tracker` remembers, say less about rivals than an exhaustive search:
        they have models of their own.
        """
        return Calibration.load(CALIBRATIONS.get(proposer, DEFAULT_CALIBRATION))

    def probability(self, features: dict[str, float]) -> float:
        """Probability, 0 to 1, that the pose is within 4 mm and 5 deg."""
        logit = self.design(np.array([[features[name] for name in self.names]])) @ self.weights
        return float(1.0 / (1.0 + np.exp(-np.clip(logit[0], -30.0, 30.0))))

    def design(self, features: Array) -> Array:
        """(N, 1 + F + F (F + 1) / 2) terms of (N, F) features; far outliers are pulled in to 4 scales."""
        z = np.clip((features - self.means) / self.scales, -4.0, 4.0)
        i, j = np.triu_indices(z.shape[1])
        return np.hstack([np.ones((len(z), 1)), z, z[:, i] * z[:, j]])


def measure(
    fit: Fit, candidates: Candidates, uncertainty: PoseUncertainty, source: PreparedSource, target: PreparedTarget
) -> dict[str, float]:
    """The figures behind the confidence; every one is finite."""
    second = candidates.scores[1] if len(candidates.scores) > 1 else 2.0 * candidates.scores[0]
    inlier = fit.weights > 0.0
    agreement = np.abs(np.einsum("ni,ni->n", source.normals @ fit.T[:3, :3].T, fit.gradients))
    return {
        "log_sigma": float(np.log(fit.sigma_mm)),
        "log_excess": float(np.log(fit.sigma_mm / max(source.noise_mm, 0.1))),
        "smooth_misfit": uncertainty.smooth_mm,
        "inlier_ratio": float(inlier.mean()),
        "residual": float(np.sqrt(candidates.scores[0])),
        "margin": float(np.log(max(second / candidates.scores[0], 1.0) - 1.0 + 1e-3)),
        "support": float(candidates.support[0]),
        "log_shift_sd": float(np.log(uncertainty.largest_shift_mm)),
        "log_turn_sd": float(np.log(uncertainty.largest_turn_deg)),
        "normal_agreement": float(np.median(agreement[inlier])) if inlier.any() else 0.0,
        "log_points": float(np.log(len(source.points))),
        "extent": float(
            np.linalg.norm(source.points - source.points.mean(axis=0), axis=1).max() / target.half_extent_mm
        ),
    }


FEATURES = (
    "log_sigma", "log_excess", "smooth_misfit", "inlier_ratio", "residual", "margin", "support", "log_shift_sd",
    "log_turn_sd", "normal_agreement", "log_points", "extent",
)  # fmt: skip
