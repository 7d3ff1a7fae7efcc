"""What the misfit that the frames of a stream share says of the next one: does it speak for the bone, or against it?"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import logit

from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.confidence.classifier import LARGEST_LOG_ODDS, Calibration
from gapr_core.registration.confidence.features import STREAM_FEATURES
from gapr_core.registration.streams.duplicate_clouds import Fingerprint
from gapr_core.registration.streams.shared_misfit import SharedMisfit


class StreamMisfit:
    """Weighs each frame with what it shares with those before it.

    Args:
        memory: of `SharedMisfit`.
        model: the confidence model of a frame in the light of those before it.
    """

    def __init__(self, memory: float, model: Calibration) -> None:
        self._frames, self._model = SharedMisfit(memory), model
        self.forget()

    def forget(self) -> None:
        """Forget all frames."""
        self._frames.forget()
        self._shared_mm: tuple[float, float] | None = None  # as `SharedMisfit.add` said last
        self._speaks_for = False  # that speaks for the bone
        self._seen: Fingerprint | None = None  # of the last source that was added

    def weigh(self, assessment: Assessment, agrees: bool, cloud: Fingerprint) -> Assessment:
        """The probability in the light of what the residuals of the frames have in common.

        A source that is sent again has the same noise, and adds nothing.

        Args:
            assessment: of the next frame.
            agrees: it continues the one before it. After a jump it may be another bone: what spoke for the last one is
                forgotten, what spoke against it is not.
            cloud: of all points of the frame.
        """
        if not np.isfinite(assessment.probability):
            return assessment
        if not agrees and self._speaks_for:
            self.forget()
        if self._seen is None or not cloud.is_of_same(self._seen):
            self._seen = cloud
            self._shared_mm = self._frames.add(assessment.fit)
        if self._shared_mm is None:
            self._speaks_for = False
            return assessment
        log_odds = float(np.clip(logit(assessment.probability), -LARGEST_LOG_ODDS, LARGEST_LOG_ODDS))
        features = dict(zip(STREAM_FEATURES, (log_odds, *self._shared_mm), strict=True))
        adds = {name: self._model.contributions(features)[name] for name in STREAM_FEATURES[1:]}
        self._speaks_for = sum(adds.values()) > 0.0
        return replace(
            assessment,
            probability=self._model.probability(features),
            features={**assessment.features, **features},
            contributions={**assessment.contributions, **adds},
        )


class NoMisfit(StreamMisfit):
    """For sources that share their points: the same points have the same noise, and say nothing together."""

    def __init__(self) -> None:
        """Nothing is kept."""

    def forget(self) -> None:
        """There is nothing to forget."""

    def weigh(self, assessment: Assessment, agrees: bool, cloud: Fingerprint) -> Assessment:
        """The same."""
        return assessment
