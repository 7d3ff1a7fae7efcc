"""The last sources of a stream registered together: what a probe has collected, in a frame in which the bone rests."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.clouds import Surface, finite_points
from gapr_core.config import RefinementConfig
from gapr_core.errors import ConfigError
from gapr_core.refinement import evaluate
from gapr_core.registrar import Registrar
from gapr_core.results import RegistrationResult, RegistrationStatus
from gapr_core.target import PreparedTarget
from gapr_core.tracking import Tracker

Array = NDArray[np.float64]

OFF = 2.5  # the newest source lies off the bone when it is so many times farther from it than all together
MOST_OFF = 3  # so many such sources in a row are not stray any more: the bone has moved


class Accumulator:
    """Registers each source together with those before it.

    Nothing helps more than seeing more of the bone: images of a probe that say nothing alone determine the pose
    together. All sources must be in one frame in which the bone rests, such as that of a reference fixed to it. A
    source that lies off the bone where the others found it is refused and left out; after three of them in a row the
    bone or its reference has moved, and only these three are kept.

    Args:
        method: registers what is collected.
        most: how many sources are kept, the newest among them.

    Raises:
        ConfigError: `most` is less than 1.
    """

    name = "gapr_accumulator"

    def __init__(self, method: Registrar | Tracker, most: int) -> None:
        if most < 1:
            raise ConfigError("at least 1 source to keep", str(most), "1 registers every source by itself")
        self.method = method
        self._sources: deque[Array] = deque(maxlen=most)
        self._off: list[Array] = []

    @property
    def collected(self) -> Array:
        """(N, 3) all points that are kept, mm."""
        return np.concatenate([np.empty((0, 3)), *self._sources])

    def reset(self) -> None:
        """Forget all sources, and the track of a `Tracker`."""
        self._sources.clear()
        self._off.clear()
        if isinstance(self.method, Tracker):
            self.method.reset()

    def collect(self, source: ArrayLike) -> None:
        """Keep a source (N, 3), mm, without registering; the oldest one goes when there are too many.

        Raises:
            InvalidPointCloudError: wrong shape or type.
        """
        self._sources.append(finite_points(source))

    def prepare(self, target: str | Path | ArrayLike | Surface, units: str = "mm") -> PreparedTarget:
        """Everything static about a target; see `Registrar.prepare`."""
        return self.method.prepare(target, units)

    def register(
        self, source: ArrayLike, target: PreparedTarget, initial: ArrayLike | None = None
    ) -> RegistrationResult:
        """The pose of all that is collected, this source (N, 3), mm, included; see `Registrar.register`."""
        self.collect(source)
        points = self.collected
        result = self.method.register(points, target, initial)
        if result.T_target_source is None or not _lies_off(self._sources[-1], points, result.T_target_source, target):
            if result.ok:
                self._off.clear()
            return result
        return self._leave_out(result)

    def _leave_out(self, result: RegistrationResult) -> RegistrationResult:
        self._off.append(self._sources.pop())
        reason = f"the newest source lies off the bone where {len(self._sources)} before it found it; it is left out"
        if len(self._off) == MOST_OFF:
            kept = self._off.copy()
            self.reset()
            self._sources.extend(kept)
            reason = f"{MOST_OFF} sources in a row lie off the bone: it has moved, and the collection starts anew"
        return replace(
            result, status=RegistrationStatus.LOW_CONFIDENCE, T_target_source=None, covariance=None, tre_mm=None,
            confidence=0.0, reason=reason,
        )  # fmt: skip


def _lies_off(newest: Array, points: Array, T: Array, target: PreparedTarget) -> bool:
    """True when the typical point of `newest` (N, 3) is much farther off the surface than that of all (M, 3)."""
    if not len(newest):
        return False
    distances = (evaluate(T, each, target, RefinementConfig()).signed_mm for each in (newest, points))
    of_newest, of_all = (float(np.median(np.nan_to_num(np.abs(d), nan=np.inf))) for d in distances)
    return of_newest > OFF * max(of_all, RefinementConfig().smallest_sigma_mm)
