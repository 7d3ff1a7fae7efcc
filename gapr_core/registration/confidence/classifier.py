"""The two numbers of an answer: the probability of the right pose, and the evidence for the right bone.

P(right) = P(pose | this bone) x P(this bone). The first factor is the expit of an additive model of the features. The
second follows from a likelihood ratio of this bone to another subject's, also an additive model, and from a prior that
the ward knows and the data do not. Both models are fitted by `python -m gapr_core.calibration`. Each feature adds its
share to the log odds, so an answer can be read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import expit

from gapr_core.errors import WeightsError
from gapr_core.registration.confidence.additive import FIT_AGAIN, Additive, from_dict, load
from gapr_core.registration.confidence.features import FEATURES_OF

SHIPPED = Path(__file__).parents[2] / "weights" / "confidence.json"
LARGEST_LOG_ODDS = 9.0  # a few thousand records cannot show errors rarer than one in eight thousand
LARGEST_EVIDENCE = 3.0  # log10: the pairs of subjects cannot show look-alikes rarer than one in a thousand


@dataclass(frozen=True)
class Judgement:
    """The two numbers of an answer."""

    pose_log_odds: float  # that the pose is within 4 mm and 5 deg, given that this is the right bone
    bone_evidence: float  # log10 likelihood ratio of this bone to another subject's
    # log odds that each feature adds to those of the pose, compared with the usual answer
    contributions: Mapping[str, float] = field(default_factory=dict)

    @property
    def pose_probability(self) -> float:
        """Probability, 0 to 1, that the pose is right, given that this is the right bone."""
        return float(expit(self.pose_log_odds))


def joint(judgement: Judgement, other_bone_prior: float) -> float:
    """Compute P(pose | this bone) x P(this bone), with a prior probability, 0 to 1, of another subject's bone."""
    return judgement.pose_probability * bone_probability(judgement.bone_evidence, other_bone_prior)


def bone_probability(evidence: float, other_bone_prior: float) -> float:
    """Compute the posterior probability of this bone: 1 / (1 + pi / (1 - pi) 10^-evidence)."""
    if not 0.0 < other_bone_prior < 1.0:
        return 1.0 - other_bone_prior
    return float(expit(np.log(10.0) * evidence - np.log(other_bone_prior / (1.0 - other_bone_prior))))


@dataclass(frozen=True, eq=False)
class Classifier:
    """Models of both numbers, for sources that are bone alone and for a camera's clouds."""

    pose: Mapping[str, Additive]  # model of the pose's log odds, by kind (`features.FEATURES_OF`)
    bone: Mapping[str, Additive]  # model of the natural log likelihood ratio of this bone, by kind
    rho_pose: float = 0.8  # correlation of two frames of a stream, of each number (`streams.evidence`)
    rho_bone: float = 0.8
    card: Mapping[str, object] = field(default_factory=dict)  # data and fit

    @staticmethod
    def load(path: str | Path = SHIPPED) -> Classifier:
        """Read the models.

        Raises:
            WeightsError: no such file, another format, other features, or a damaged file.
        """

        def build(data: dict[str, Any]) -> Classifier:
            pose, bone = ({kind: from_dict(model) for kind, model in data[name].items()} for name in ("pose", "bone"))
            return Classifier(pose, bone, float(data["rho_pose"]), float(data["rho_bone"]), dict(data["card"]))

        found = load(path, "confidence", build)
        for kind, names in FEATURES_OF.items():
            for models in (found.pose, found.bone):
                if kind not in models or not set(models[kind].features) <= set(names):
                    expected = f"models of {kind!r} with features among {names}"
                    raise WeightsError(expected, f"{path}: {models.get(kind)}", FIT_AGAIN)
        return found

    def judge(self, kind: str, features: Mapping[str, float]) -> Judgement:
        """Compute the two numbers of an answer of a kind (`features.FEATURES_OF`) from its features."""
        log_odds = np.clip(self.pose[kind].value(features), -LARGEST_LOG_ODDS, LARGEST_LOG_ODDS)
        evidence = np.clip(self.bone[kind].value(features) / np.log(10.0), -LARGEST_EVIDENCE, LARGEST_EVIDENCE)
        return Judgement(float(log_odds), float(evidence), self.pose[kind].contributions(features))
