"""One target, a stream of sources: each pose is looked for where the last one was, and where that is not sure, anew."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.clouds import Surface, finite_points
from gapr_core.confidence import Calibration
from gapr_core.config import RegistrarConfig
from gapr_core.errors import ConfigError
from gapr_core.geometry import se3
from gapr_core.proposals.base import Proposals
from gapr_core.registrar import Registrar
from gapr_core.results import RegistrationResult
from gapr_core.source import PreparedSource
from gapr_core.target import PreparedTarget

Array = NDArray[np.float64]


class Memory:
    """A proposer of what is remembered: the last pose, and the rivals that the last full registration gave it.

    The rivals matter as much as the pose. Without them nothing would compete with it, and a pose that is merely the
    only one looked at would count as sure.
    """

    name = "track"

    def __init__(self) -> None:
        self.poses: Array = np.empty((0, 4, 4))

    def prepare(self, target: PreparedTarget) -> None:
        """Nothing of a target is needed."""

    def propose(self, source: PreparedSource, target: PreparedTarget, rng: np.random.Generator) -> Proposals:
        """The pose first, then its rivals."""
        return Proposals(self.poses, np.linspace(1.0, 0.0, len(self.poses)))

    def keep(self, pose: Array, rivals: tuple[Array, ...]) -> None:
        """Remember the answer of a full registration: (4, 4) T_target_source, mm, and its distinct alternatives."""
        self.poses = np.stack([pose, *rivals])

    def follow(self, pose: Array, source: Array) -> None:
        """The source (N, 3), mm, has moved from the remembered pose T_k nearest to `pose`: all others move with it.

        R_k becomes R_k inv(T_k) T_now, and the nearest pose comes first.
        """
        gaps = [np.linalg.norm(se3.apply(each, source) - se3.apply(pose, source)) for each in self.poses]
        nearest = int(np.argmin(gaps))
        moved = self.poses @ (se3.inverse(self.poses[nearest]) @ pose)
        self.poses = np.concatenate([moved[nearest : nearest + 1], np.delete(moved, nearest, axis=0)])


class Tracker:
    """Registers a stream of sources in one frame, such as the clouds of a tracked probe.

    The last pose and its rivals are refined on the new source first. Where that answer is sure (`RegistrarConfig.sure`)
    it stands; else the registrar's proposers are asked as for a single source. So a jump, another frame or a wrong
    track costs time, not truth. Used by one thread at a time.

    Args:
        registrar: does the full registrations; `Registrar.from_pretrained()` when not given.
        recheck: at least every so many sources is registered in full, so that a wrong track cannot live for long.
        calibration: the confidence model of tracked answers; the shipped one when not given.

    Raises:
        ConfigError: `recheck` is less than 1.
    """

    name = "gapr_tracker"

    def __init__(
        self, registrar: Registrar | None = None, recheck: int = 10, calibration: Calibration | None = None
    ) -> None:
        if recheck < 1:
            raise ConfigError("recheck of at least 1", str(recheck), "1 registers every source in full")
        self.registrar = registrar or Registrar.from_pretrained()
        self.recheck = recheck
        self._memory = Memory()
        proposers = (self._memory, *self.registrar.proposers)
        calibrations = (calibration or Calibration.shipped(Memory.name), *self.registrar.calibrations)
        self._tracking = Registrar(self.registrar.config, proposers, calibrations)
        self.reset()

    @classmethod
    def from_pretrained(cls, config: RegistrarConfig | None = None, device: str = "cpu", recheck: int = 10) -> Tracker:
        """A tracker over `Registrar.from_pretrained`, which see."""
        return cls(Registrar.from_pretrained(config, device), recheck)

    def reset(self) -> None:
        """Forget the track: the next source is registered in full."""
        self._target: PreparedTarget | None = None
        self._tracked = 0  # sources since the last full registration

    def prepare(self, target: str | Path | ArrayLike | Surface, units: str = "mm") -> PreparedTarget:
        """Everything static about a target; see `Registrar.prepare`."""
        return self.registrar.prepare(target, units)

    def register(
        self, source: ArrayLike, target: PreparedTarget, initial: ArrayLike | None = None
    ) -> RegistrationResult:
        """The pose of the next source, or a refusal; another target than before starts a new track.

        Args:
            source: (N, 3), mm, in the same frame as the sources before.
            target: from `prepare`.
            initial: (4, 4) T_target_source to try besides all others; starts a new track.

        Raises:
            InvalidPointCloudError: as `Registrar.register`.
        """
        if initial is not None or target is not self._target:
            self.reset()
        if self._target is None:
            result = self.registrar.register(source, target, initial)
        elif self._tracked + 1 < self.recheck:
            result = self._tracking.register(source, target)
        else:
            result = self.registrar.register(source, target, self._memory.poses[0])
        self._remember(result, finite_points(source), target)
        return result

    def _remember(self, result: RegistrationResult, source: Array, target: PreparedTarget) -> None:
        """A refusal changes no pose: the bone may be where it was."""
        if "proposer" not in result.details:  # nothing was registered
            return
        if result.T_target_source is None:  # after a full registration the next source gets one as well
            return
        followed = result.details["proposer"] == Memory.name
        self._tracked = self._tracked + 1 if followed else 0
        if followed:
            self._memory.follow(result.T_target_source, source)
        elif result.alternatives:
            self._target = target
            self._memory.keep(result.T_target_source, result.alternatives)
        else:
            self.reset()  # no rival: the next answer could not be weighed against anything
