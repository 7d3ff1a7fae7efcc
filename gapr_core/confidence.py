"""How probable it is that a pose is right: named figures of the fit, weighed by a few small networks.

They are trained on train people over all protocols, right and wrong pairs alike, by `gapr_core.training.calibration`;
the file names the data and the fit. They run in NumPy: a `Registrar` of the search alone needs no torch.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

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
LARGEST_SCALES = 4.0  # from the mean of a feature: what lies farther out counts as that far


@dataclass(frozen=True, eq=False)
class Calibration:
    """The mean logit of several small multilayer perceptrons over standardised features.

    Attributes:
        names: the features, in the order of `means`, `scales`.
        means: (F,) and scales (F,) of the training set.
        layers: weights (members, inputs, outputs) and biases (members, outputs) of each layer, SiLU between them.
        card: where it comes from.
    """

    names: tuple[str, ...]
    means: Array
    scales: Array
    layers: tuple[tuple[Array, Array], ...]
    card: dict[str, object]

    @staticmethod
    def load(path: str | Path = DEFAULT_CALIBRATION) -> Calibration:
        """Read the model.

        Raises:
            WeightsError: no such file, one made for other features, or a damaged one.
        """
        path = Path(path)
        if not path.is_file():
            raise WeightsError("a confidence model", f"no file {path}", "reinstall the package")
        try:
            data = json.loads(path.read_text())
            names, card = tuple(data["names"]), data["card"]
            means, scales = np.array(data["means"]), np.array(data["scales"])
            layers = tuple((np.array(weights), np.array(biases)) for weights, biases in data["layers"])
            model = Calibration(names, means, scales, layers, card)
            if layers[-1][0].shape[2:] != (1,) or model.logits(np.zeros((1, len(names)))).shape != (1,):
                raise ValueError("its layers do not lead to one figure")
        except (ValueError, KeyError, TypeError, IndexError) as error:
            raise WeightsError("a whole confidence model", f"{path}: {error!r}", "calibrate again") from error
        if names != FEATURES:
            raise WeightsError(f"a model of {FEATURES}", f"one of {names}", "calibrate again")
        return model

    @staticmethod
    def undecided() -> Calibration:
        """A model that gives every pose a probability of 0.5: for what comes before the training."""
        count = len(FEATURES)
        layer = np.zeros((1, count, 1)), np.zeros((1, 1))
        return Calibration(FEATURES, np.zeros(count), np.ones(count), (layer,), {})

    @staticmethod
    def shipped(proposer: str) -> Calibration:
        """The model for an answer whose last hypotheses came from `proposer`.

        The network's few poses, and those that a `Tracker` remembers, say less about rivals than an exhaustive search:
        they have models of their own.
        """
        return Calibration.load(CALIBRATIONS.get(proposer, DEFAULT_CALIBRATION))

    def probability(self, features: dict[str, float]) -> float:
        """Probability, 0 to 1, that the pose is within 4 mm and 5 deg."""
        logit = float(self.logits(np.array([[features[name] for name in self.names]]))[0])
        return float(expit(np.clip(logit, -30.0, 30.0)))

    def logits(self, features: Array) -> Array:
        """(N,) log odds of (N, F) features; far outliers are pulled in to 4 scales."""
        x = self.standardised(features)[None]
        for number, (weights, biases) in enumerate(self.layers):
            x = x @ weights + biases[:, None]
            if number < len(self.layers) - 1:
                x = x * expit(x)  # SiLU
        return np.asarray(x[..., 0].mean(axis=0))

    def standardised(self, features: Array) -> Array:
        """(N, F) features in scales from their means, at most 4."""
        return np.clip((features - self.means) / self.scales, -LARGEST_SCALES, LARGEST_SCALES)


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
        "short_misfit": uncertainty.short_mm,
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
    "log_sigma", "log_excess", "smooth_misfit", "short_misfit", "inlier_ratio", "residual", "margin", "support",
    "log_shift_sd", "log_turn_sd", "normal_agreement", "log_points", "extent",
)  # fmt: skip
