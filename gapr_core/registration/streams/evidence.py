"""What the frames of a stream say together: is this bone the one of the target?

A frame's probability p says that the bone is the right one and that the pose is right. Its doubt is split evenly:
q = r = sqrt(p), q for the bone, r for the pose. The bone is the same in all frames, so their log odds of q add up. But
frames see the same surface with the same errors: n equally correlated frames count as n / (1 + (n - 1) rho)
(the variance of a mean of correlated variables). The answer for a frame is the stream's q times its own r. So frames
that agree raise the confidence, never beyond sqrt(p), and a wrong bone that fits well in one frame only is refused
there too. After a jump nothing that spoke for the bone counts any more, and what spoke against it still does.
"""

from __future__ import annotations

import numpy as np
from scipy.special import expit, logit

from gapr_core.config import EvidenceConfig

MOST_LOGIT = 8.0  # of one frame: no frame alone is more than certain


class Evidence:
    """Log odds of a stream.

    Args:
        config: correlation of the frames and how long they are remembered.
    """

    def __init__(self, config: EvidenceConfig | None = None) -> None:
        self.config = config or EvidenceConfig()
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self._sum, self._weight, self._agreeing = 0.0, 0.0, 0
        self._before = self._sum, self._weight, self._agreeing

    @property
    def effective_frames(self) -> float:
        """How many independent frames those that agree, up to the last one, count for."""
        n = max(self._agreeing, 1)
        return n / (1.0 + (n - 1) * self.config.correlation)

    def add(self, probability: float, agrees: bool, again: bool = False) -> float:
        """The probability of a frame in the light of those before it.

        Args:
            probability: 0 to 1, of this frame alone; one that is no number comes back and is not counted.
            agrees: its pose continues the last one; after a jump the answer is at most `probability`.
            again: it is the last frame once more, which is counted once: as it is now.
        """
        if not np.isfinite(probability):
            return probability
        if again:
            self._sum, self._weight, self._agreeing = self._before
        self._before = self._sum, self._weight, self._agreeing
        if not agrees and self._sum > 0.0:
            self._sum = self._weight = 0.0
        part = float(np.sqrt(probability))
        forget = 1.0 - 1.0 / self.config.memory
        self._sum = forget * self._sum + float(np.clip(logit(part), -MOST_LOGIT, MOST_LOGIT))
        self._weight = forget * self._weight + 1.0
        self._agreeing = self._agreeing + 1 if agrees else 1
        combined = float(expit(self.effective_frames * self._sum / self._weight)) * part
        return combined if agrees else min(combined, probability)
