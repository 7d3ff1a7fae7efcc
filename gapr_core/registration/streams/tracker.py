"""One target, a stream of sources: each pose is searched where the last one was, and in full where that is not sure."""

from __future__ import annotations

from copy import copy
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
from gapr_core.registration.checks import limits
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.confidence.classifier import Calibration
from gapr_core.registration.confidence.features import STREAM
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.registrar import Registrar, check_call
from gapr_core.registration.scenes.scene import Viewpoint
from gapr_core.registration.streams.duplicate_clouds import Fingerprint, fingerprint
from gapr_core.registration.streams.evidence import Evidence
from gapr_core.registration.streams.following import FollowedPose, Follower
from gapr_core.registration.streams.memory import Memory, MemoryFirst
from gapr_core.registration.streams.stream_misfit import NoMisfit, StreamMisfit
from gapr_core.results import Refusal, RegistrationResult
from gapr_core.runtime.clock import Clock
from gapr_core.runtime.parallel import single_threaded_libraries
from gapr_core.surface import Surface

Array = NDArray[np.float64]

# A scene that is hardly believed makes the next ones doubtful: of another subject's bone single scenes may be sure, but
# seldom all (chosen on scenes of train subjects)
DOUBTFUL, DOUBTED_FOR = 0.5, 5  # probability of a scene, alone or in its stream; scenes


class Last(NamedTuple):
    """The last source that no rule refused.

    Attributes:
        T_target_source: (4, 4) its pose, mm.
        cloud: of all its points, source frame.
        agreed: it continued the one before it.
        said: the probability that it had, before the limits.
    """

    T_target_source: Array
    cloud: Fingerprint
    agreed: bool
    said: float


class Tracker:
    """Registers a stream of sources in one frame, such as the clouds of a tracked probe.

    The last pose and its rivals are refined on the new source first. Where that answer is sure (`RegistrarConfig.sure`)
    it stands. In a stream that is sure, so does one near the last pose that reaches `evidence.stands`. Else the
    registrar's proposers are asked as for a single source. So a jump, another frame or a wrong track costs time, not
    truth. The confidence of a source also rests on those before it: sources that agree raise it, those that fit badly
    lower it (`Evidence`), and so does a misfit that they share (`StreamMisfit`); after a camera's cloud that was hardly
    believed the next ones are not sure. Used by one thread at a time.

    Args:
        registrar: does the full registrations; `Registrar.from_pretrained()` when not given.
        recheck: of so many sources in a row at least one is registered in full: a wrong track does not live for long.
        calibration: the confidence model of tracked answers; the shipped one when not given.
        stream: the one of a source in the light of those before it; the shipped one when not given.

    Raises:
        ConfigError: `recheck` is no whole number or less than 1, the registrar is none, or a calibration is for other
            answers.
    """

    name = "gapr_tracker"

    def __init__(
        self,
        registrar: Registrar | None = None,
        recheck: int = 10,
        calibration: Calibration | None = None,
        stream: Calibration | None = None,
    ) -> None:
        if not isinstance(recheck, int | np.integer) or recheck < 1:
            raise ConfigError(
                "a whole number for recheck, at least 1", repr(recheck), "1 registers every source in full"
            )
        if not isinstance(registrar, Registrar | None):
            raise ConfigError("a Registrar", repr(registrar), "pass Registrar.from_pretrained(config)")
        self.registrar = registrar or Registrar.from_pretrained()
        self.recheck = recheck
        self._memory = Memory()
        self._tracking = MemoryFirst(self._memory, calibration or Calibration.shipped(Memory.name), self.registrar)
        self._evidence = Evidence(self.config.evidence)
        self._stream = stream or Calibration.shipped(STREAM)
        self._stream.check_is_for(STREAM)
        self._misfit = StreamMisfit(self.config.evidence.memory, self._stream)
        self.reset()

    @classmethod
    def from_pretrained(
        cls,
        config: RegistrarConfig | None = None,
        device: str = "cpu",
        recheck: int = 10,
        weights: str | Path | None = None,
    ) -> Tracker:
        """A tracker over `Registrar.from_pretrained`, which see."""
        return cls(Registrar.from_pretrained(config, device, weights), recheck)

    @property
    def config(self) -> RegistrarConfig:
        """That of its registrar."""
        return self.registrar.config

    def reset(self) -> None:
        """Forget the track and what the frames said: the next source is registered in full."""
        self._forget_track()
        self._bone: PreparedTarget | None = None
        self._evidence.reset()
        self._misfit.forget()
        self._scenes_since_doubt = DOUBTED_FOR
        self._is_doubted = False  # the scene that is asked about

    def of_bone_alone(self) -> Tracker:
        """As `Registrar.of_bone_alone`: another tracker, which begins a stream of its own."""
        twin = copy(self)
        twin.registrar, twin._memory = self.registrar.of_bone_alone(), Memory()
        twin._tracking = MemoryFirst(twin._memory, self._tracking.calibrations[0], twin.registrar)
        twin._evidence = Evidence(self._evidence.config)
        if not self._shares_points:
            twin._misfit = StreamMisfit(self._evidence.config.memory, self._stream)
        twin.reset()
        return twin

    def sharing_points(self) -> Tracker:
        """Another tracker, for sources that share their points, as those of an `Accumulator` do: many count as one.

        Nor were the points of one of them seen from one place. It begins a stream of its own.
        """
        twin = self.of_bone_alone()
        twin._evidence = Evidence(replace(self._evidence.config, correlation=1.0))
        twin._misfit = NoMisfit()
        return twin

    @property
    def _shares_points(self) -> bool:
        """See `sharing_points`: the first few say less than all, and are no reason to doubt."""
        return isinstance(self._misfit, NoMisfit)

    def _forget_track(self) -> None:
        self._memory.place = None
        self._has_track = False  # there are poses to follow
        self._since_full = 0  # sources since the last full registration
        self._is_sure = self._was_sure = False  # this source is, as answered; the one before was
        self._last: Last | None = None  # the last source that no rule refused
        self._follower: Follower | None = None  # of the last source, where that was sure

    def prepare(self, target: str | Path | ArrayLike | Surface, units: str = "mm") -> PreparedTarget:
        """Everything static about a target; see `Registrar.prepare`."""
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
        """As `Registrar.register`, for the next source in the same frame.

        Another target than before starts a new track, and so does `initial`.
        """
        check_call(target, initial)
        if target is not self._bone:
            self.reset()
            self._bone = target
        if initial is not None:
            self._forget_track()
        self._was_sure, self._is_sure = self._is_sure, False  # and stays so where this source is refused
        self._follower, clock = None, Clock()
        assessment = self._assess(source, target, initial, viewpoint, clock)
        if isinstance(assessment, Assessment):
            assessment = self._with_evidence(assessment, fingerprint(finite_points(source)))
        result = replace(self.registrar.conclude(assessment, clock), method=self.name)
        if isinstance(assessment, Assessment):
            if self._is_doubted and assessment.seen is not None:
                result = limits.no_surer(result, limits.DOUBTED, self.config)
            self._remember(result, assessment.source.points)
            if self._is_sure and self._has_track and assessment.seen is None:
                self._follower = Follower(assessment, source, self.config)
        return result

    @single_threaded_libraries
    def follow(self, source: ArrayLike, target: PreparedTarget) -> FollowedPose | None:
        """Where the bone is now, by the last pose, in a fraction of the time of `register`, and not assessed.

        None where `register` has to be asked, for this source and all after it: the last answer was refused, not sure
        or of a cloud with a viewpoint; its error, which counts for more in a weaker view, is not well bounded; the
        source fits worse, or lies elsewhere; or many were followed in a row (`FollowingConfig`, `evidence.agree_mm`).

        What the sources said of the bone does not change, nor when one is registered in full again. The next
        registration begins where the bone was followed to.

        Args:
            source: (N, 3), mm, in the same frame as those before.
            target: from `prepare`.

        Raises:
            InvalidPointCloudError: wrong shape or type.
        """
        follower, self._follower = self._follower, None
        found = follower.follow(source) if follower is not None and target is self._bone else None
        if follower is not None and found is not None:
            self._follower, self._memory.motion = follower, follower.motion()
            self._last = self._last and self._last._replace(T_target_source=found.T_target_source.copy())
        return found

    def _assess(
        self,
        source: ArrayLike,
        target: PreparedTarget,
        initial: ArrayLike | None,
        viewpoint: Viewpoint | None,
        clock: Clock,
    ) -> Assessment | Refusal:
        """Where the last pose was, or in full; a re-check tries the last pose and its rivals too."""
        if not self._has_track:
            return self.registrar.assess(source, target, initial, viewpoint, clock)
        if self._since_full + 1 < self.recheck:
            return self._tracking.assess(source, target, viewpoint=viewpoint, clock=clock, enough=self._stands)
        return self.registrar.assess_from(source, target, self._memory.now, viewpoint, clock)

    def _stands(self, assessment: Assessment) -> bool:
        """True for a tracked answer that continues a sure track, so that other proposers would hardly add to it."""
        stands = assessment.proposer == Memory.name and assessment.reaches(self.config.evidence.stands)
        return self._was_sure and stands and self._agrees(assessment)

    def _agrees(self, assessment: Assessment) -> bool:
        """True when the pose continues that of the last source."""
        if self._last is None:
            return False
        moved_mm = se3.rms_apart_mm(assessment.fit.T, self._last.T_target_source, assessment.source.points)
        return moved_mm <= self.config.evidence.agree_mm

    def _is_no_view(self, assessment: Assessment) -> bool:
        """True for an answer as bone alone that is refused, where the last one accepted was of a camera's view."""
        was_view, is_view = self._memory.place is not None, assessment.seen is not None
        return was_view and not is_view and not assessment.reaches(self.config.min_confidence)

    def _with_evidence(self, assessment: Assessment, cloud: Fingerprint) -> Assessment:
        """The probability p in the light of the frames before, at most sqrt(p), and at most p after a jump.

        What they say of the bone cannot make a pose right (see `evidence`). A frame that a safety rule refuses says
        nothing, nor does a camera's view that was taken for bone, and one that is sent again nothing new.
        """
        if assessment.refusal is not None or self._is_no_view(assessment):
            return assessment
        if assessment.inferred_viewpoint is not None:
            assessment = assessment.capped(self.config.limits.most)
        a, last = assessment, self._last
        again = last is not None and cloud.is_of_same(last.cloud)
        agrees = self._agrees(a) and (last is None or last.agreed or not again)
        one_by_one = replace(a, probability=self._evidence.add(a.probability, agrees, again))
        most = min(float(np.sqrt(a.probability)) if agrees else a.probability, a.most)
        found = self._misfit.weigh(one_by_one, agrees, cloud).capped(most)
        if last is not None and again:
            found = found.capped(last.said)
        self._last = Last(a.fit.T, cloud, agrees, found.probability)
        if a.seen is not None and not again and not self._shares_points:
            self._is_doubted = self._scenes_since_doubt < DOUBTED_FOR
            is_doubtful = min(a.probability, found.probability) < DOUBTFUL
            self._scenes_since_doubt = 0 if is_doubtful else self._scenes_since_doubt + 1
        return found

    def _remember(self, result: RegistrationResult, source: Array) -> None:
        """Follow an accepted pose; a refusal changes nothing, since the bone may be where it was.

        As it does not count either, a refused full registration is followed by another one.
        """
        self._is_sure = result.ok and result.confidence >= self.config.sure_from
        if result.T_target_source is None:
            return
        followed = result.proposer == Memory.name
        self._memory.place = result.inferred_viewpoint
        self._since_full = self._since_full + 1 if followed else 0
        if followed:
            self._memory.follow(result.T_target_source, source)
        elif len(result.hypotheses) > 1:
            self._has_track = True
            self._memory.support = result.features.get("support", 0.0)
            self._memory.keep([result.T_target_source, *(rival.T_target_source for rival in result.hypotheses[1:])])
        else:
            self._forget_track()  # no rival: the next answer could not be weighed against anything
