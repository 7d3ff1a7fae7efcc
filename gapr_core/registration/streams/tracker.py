"""Tracking of one target in a stream of sources: each pose is searched near the last, and in full if unsure."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.clouds import finite_points
from gapr_core.config import RegistrarConfig
from gapr_core.errors import ConfigError
from gapr_core.geometry import se3
from gapr_core.registration.caveats import answering
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.registrar import Registrar, check_call
from gapr_core.registration.scenes.scene import Viewpoint
from gapr_core.registration.streams.evidence import AGREE_MM, Evidence, fingerprint, is_repeated
from gapr_core.registration.streams.memory import PreviousPoses, TrackingRegistrar
from gapr_core.results import Refusal, RegistrationResult
from gapr_core.runtime.clock import Clock
from gapr_core.runtime.parallel import single_threaded_libraries
from gapr_core.surface import Surface

Array = NDArray[np.float64]

STANDS = 0.8  # after a sure source a tracked answer of this confidence needs no search


class Last(NamedTuple):
    """Last source that no finding refused: its pose (4, 4), mm, its fingerprint, and whether it continued the track."""

    T_target_source: Array
    cloud: Array
    agreed: bool


class Tracker:
    """Registers a stream of sources in one frame, such as the clouds of a tracked probe.

    The last pose and its rivals are refined on the new source first. That answer stands where it is sure
    (`RegistrarConfig.sure`), or, near the last pose of a sure stream, where it reaches `STANDS`. Else all run:
    a jump or a wrong track costs time, not truth. Both numbers also rest on the sources before (`Evidence`). Used by
    one thread at a time.

    Args:
        registrar: does the full registrations; `Registrar.from_pretrained()` when not given.
        recheck: at least one of this number of sources in a row is registered in full, which ends a wrong track.

    Raises:
        ConfigError: `recheck` is no whole number or less than 1, or the registrar is none.
    """

    name = "gapr_tracker"

    def __init__(self, registrar: Registrar | None = None, recheck: int = 10) -> None:
        if not isinstance(recheck, int | np.integer) or recheck < 1:
            raise ConfigError(
                "a whole number for recheck, at least 1", repr(recheck), "1 registers every source in full"
            )
        if not isinstance(registrar, Registrar | None):
            raise ConfigError("a Registrar", repr(registrar), "pass Registrar.from_pretrained(config)")
        self.registrar = registrar or Registrar.from_pretrained()
        self.recheck = recheck
        self._memory = PreviousPoses()
        self._tracking = TrackingRegistrar(self._memory, self.registrar)
        self._evidence = Evidence(self.registrar.classifier.rho_pose, self.registrar.classifier.rho_bone)
        self.reset()

    @classmethod
    def from_pretrained(
        cls,
        config: RegistrarConfig | None = None,
        device: str = "cpu",
        recheck: int = 10,
        weights: str | Path | None = None,
    ) -> Tracker:
        """Track with a `Registrar.from_pretrained`."""
        return cls(Registrar.from_pretrained(config, device, weights), recheck)

    @property
    def config(self) -> RegistrarConfig:
        """Settings of its registrar."""
        return self.registrar.config

    def reset(self) -> None:
        """Forget the track and the evidence: the next source is registered in full."""
        self._forget_track()
        self._bone: PreparedTarget | None = None
        self._alone: Tracker | None = None
        self._evidence.reset()

    def of_bone_alone(self) -> Tracker:
        """Return the tracker of `Registrar.of_bone_alone`, with a stream of its own that `reset` ends."""
        self._alone = self._alone or type(self)(self.registrar.of_bone_alone(), self.recheck)
        return self._alone

    def sharing_points(self) -> Tracker:
        """Make a tracker for sources that share their points, as an `Accumulator`'s do: many count as one."""
        twin = type(self)(self.registrar.of_bone_alone(), self.recheck)
        twin._evidence = Evidence(rho_pose=1.0, rho_bone=1.0)
        return twin

    def _forget_track(self) -> None:
        self._memory.place = None
        self._has_track = False  # there are poses to follow
        self._since_full = 0  # sources since the last full registration
        self._is_sure = self._was_sure = False  # this source is, as answered; the one before was
        self._last: Last | None = None

    def prepare(self, target: str | Path | ArrayLike | Surface, units: str = "mm") -> PreparedTarget:
        """Compute everything static about a target; see `Registrar.prepare`."""
        return self.registrar.prepare(target, units)

    @answering
    @single_threaded_libraries
    def register(
        self,
        source: ArrayLike,
        target: PreparedTarget,
        initial: ArrayLike | None = None,
        viewpoint: Viewpoint | None = None,
    ) -> RegistrationResult:
        """Register the next source in the same frame, as `Registrar.register`.

        Another target than before starts a new track, and so does `initial`.
        """
        start = check_call(target, initial)
        if target is not self._bone:
            self.reset()
            self._bone = target
        if initial is not None:
            self._forget_track()
        self._was_sure, self._is_sure = self._is_sure, False  # and stays so where this source is refused
        clock = Clock()
        assessment = self._assess(source, target, start, viewpoint, clock)
        if isinstance(assessment, Assessment):
            assessment = self._with_evidence(assessment, fingerprint(finite_points(source)))
        result = replace(self.registrar.conclude(assessment, clock), method=self.name)
        if isinstance(assessment, Assessment):
            self._remember(result, assessment.source.points)
        return result

    def _assess(
        self, source: ArrayLike, target: PreparedTarget, start: Array, viewpoint: Viewpoint | None, clock: Clock
    ) -> Assessment | Refusal:
        """Assess where the last pose was, or in full; a re-check tries the last pose and its rivals too."""
        if not self._has_track:
            return self.registrar.assess(source, target, start, viewpoint, clock)
        if self._since_full + 1 < self.recheck:
            return self._tracking.assess(source, target, viewpoint=viewpoint, clock=clock, enough=self._stands)
        return self.registrar.assess(source, target, self._memory.poses, viewpoint, clock)

    def _stands(self, assessment: Assessment) -> bool:
        """Return True for a tracked answer that continues a sure track: other proposers would hardly add to it."""
        stands = assessment.proposer == PreviousPoses.name and assessment.reaches(STANDS)
        return self._was_sure and stands and self._agrees(assessment)

    def _agrees(self, assessment: Assessment) -> bool:
        """Return True when the pose continues the pose of the last source."""
        if self._last is None:
            return False
        moved_mm = se3.rms_apart_mm(assessment.fit.T, self._last.T_target_source, assessment.source.points)
        return moved_mm <= AGREE_MM

    def _is_no_view(self, assessment: Assessment) -> bool:
        """Return True for a refused answer as bone alone, where the last accepted one was of a camera's view."""
        was_view, is_view = self._memory.place is not None, assessment.seen is not None
        return was_view and not is_view and not assessment.reaches(self.config.min_confidence)

    def _with_evidence(self, assessment: Assessment, cloud: Array) -> Assessment:
        """Combine its numbers with those of the frames before; refused or repeated ones add nothing."""
        if assessment.refusal is not None or self._is_no_view(assessment):
            return assessment
        last = self._last
        again = last is not None and is_repeated(cloud, last.cloud)
        agrees = self._agrees(assessment) and (last is None or last.agreed or not again)
        self._last = Last(assessment.fit.T.copy(), cloud, agrees)  # the answer is the user's to change
        return replace(assessment, judgement=self._evidence.observe(assessment.judgement, agrees, again))

    def _remember(self, result: RegistrationResult, source: Array) -> None:
        """Follow an accepted pose; a refusal changes nothing, and another full registration follows a refused one."""
        self._is_sure = result.ok and result.confidence >= self.config.sure_from
        if result.T_target_source is None:
            return
        followed = result.proposer == PreviousPoses.name
        place = result.inferred_viewpoint
        self._memory.place = None if place is None else place.copy()
        self._since_full = self._since_full + 1 if followed else 0
        if followed:
            self._memory.follow(result.T_target_source, source)
        elif len(result.hypotheses) > 1:
            self._has_track = True
            self._memory.support = result.features.get("support", 0.0)
            rivals = [rival.T_target_source for rival in result.hypotheses[1:]]
            self._memory.poses = np.stack([result.T_target_source, *rivals])
        else:
            self._forget_track()  # no rival: the next answer could not be weighed against anything
