"""Wall time of the stages of a call."""

from __future__ import annotations

import time


class Clock:
    """Wall time of each stage, ms, summed over repetitions.

    Attributes:
        stages: ms by the name of the stage.
    """

    def __init__(self) -> None:
        self.stages: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Count the time since the last lap for `stage`."""
        now = time.perf_counter()
        self.stages[stage] = self.stages.get(stage, 0.0) + (now - self._last) * 1000.0
        self._last = now
