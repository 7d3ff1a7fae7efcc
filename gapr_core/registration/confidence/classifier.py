"""How sure an answer is: what the fit and its rivals look like, and an additive model of the odds.

The model is fitted on train subjects over all protocols, right and wrong pairs alike, by
`python -m gapr_core.calibration`; the file names the data and the fit. It can be read: every feature adds its share to
the log odds, for or against.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.special import expit

from gapr_core.errors import ConfigError, MethodUnavailableError, WeightsError
from gapr_core.registration.confidence.additive import FIT_AGAIN, Additive, from_dict, read
from gapr_core.registration.confidence.features import FEATURES, FEATURES_OF

WEIGHTS = Path(__file__).parents[2] / "weights"
CALIBRATIONS = {name: WEIGHTS / f"confidence_{name}.json" for name in FEATURES_OF}
LARGEST_LOG_ODDS = 9.0  # a few thousand records say nothing of rarer errors than one in eight thousand


@dataclass(frozen=True, eq=False)
class Calibration:
    """The probability of one proposer's answers as an additive model of the log odds.

    Attributes:
        proposer: whose hypotheses came last; a model is good for this one only.
        model: of the log odds.
        card: where it comes from.
    """

    proposer: str
    model: Additive
    card: dict[str, object]

    @staticmethod
    def load(path: str | Path) -> Calibration:
        """Read the model.

        Raises:
            WeightsError: no such file, one of an older format or of other features, or a damaged one.
        """
        path = Path(path)
        data = read(path, "confidence")
        try:
            model, proposer, card = from_dict(data), str(data["proposer"]), dict(data["card"])
        except (ValueError, KeyError, TypeError) as error:
            raise WeightsError("a whole confidence model", f"{path}: {error!r}", FIT_AGAIN) from error
        if model.features != FEATURES_OF.get(proposer):
            expected = f"a model of {FEATURES_OF.get(proposer)} for {proposer!r}"
            raise WeightsError(expected, f"{path}: one of {model.features}", FIT_AGAIN)
        return Calibration(proposer, model, card)

    @staticmethod
    def shipped(proposer: str) -> Calibration:
        """The model for an answer whose last hypotheses came from `proposer`.

        What a proposer's hypotheses say about rivals is its own: no other one's model stands in.

        Raises:
            MethodUnavailableError: nobody fitted a confidence for this proposer.
        """
        if proposer not in CALIBRATIONS:
            how = "fit one with python -m gapr_core.calibration and pass it as Registrar(..., calibrations=[...])"
            given = f"proposer {proposer!r}, models exist for {', '.join(CALIBRATIONS)}"
            raise MethodUnavailableError("a proposer with a fitted confidence model", given, how)
        return Calibration.load(CALIBRATIONS[proposer])

    def check_is_for(self, proposer: str) -> None:
        """Refuse a model for another proposer that has one of its own, or for answers that have other features.

        Raises:
            ConfigError: it is.
        """
        of_rounds = FEATURES_OF.get(self.proposer, FEATURES) == FEATURES
        if self.proposer != proposer and (proposer in CALIBRATIONS or not of_rounds):
            how = "pass the calibrations in the order of the proposers: a model is good for its own only"
            raise ConfigError(f"a confidence model of {proposer!r}", f"one of {self.proposer!r}", how)

    def probability(self, features: Mapping[str, float]) -> float:
        """Probability, 0 to 1, that the pose is within 4 mm and 5 deg; NaN where a feature is no number."""
        return float(expit(np.clip(self.model.value(features), -LARGEST_LOG_ODDS, LARGEST_LOG_ODDS)))

    def contributions(self, features: Mapping[str, float]) -> dict[str, float]:
        """Log odds that each feature adds to those of the usual answer: above 0 it speaks for the pose.

        Their sum and `model.constant` are the log odds of `probability`, which goes no farther than `LARGEST_LOG_ODDS`.
        """
        return self.model.contributions(features)
