"""The algorithm on one screen: prepare, propose, verify, refine, assess.

The order in which an answer comes about, with the function of each step:

1. `sources.prepare` cleans the source.
2. `_in_rounds`: each proposer in turn proposes, `verify` keeps some poses, `refine_fully` makes the best exact,
   `assess_fit` says how sure it is, until that is enough. `_on_both_cortices` once more where a bone is hollow.
3. `_of_one_view`: what is not sure as bone alone may be what a camera saw. With a viewpoint `_in_scene` comes at once.
4. `_checked_and_corrected`: sizes, the mirror image, then a stand-off may refuse; `bias_corrected` moves the pose;
   the precision model, `allowing_for_deformation` and `allowing_for_a_patch` widen its covariance,
   `allowing_for_a_copy` may refuse it too.
5. In a stream `Tracker` weighs it with the sources before.
6. `conclude`: `limits` keep it from being sure, thresholds refuse, and the reason gets its words.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from copy import copy, deepcopy
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.clouds import finite_points
from gapr_core.config import RegistrarConfig
from gapr_core.errors import ConfigError, InvalidPointCloudError, MethodUnavailableError
from gapr_core.registration.caveats import answering
from gapr_core.registration.checks import cortices, limits, rules
from gapr_core.registration.checks import costly as checks
from gapr_core.registration.checks import second_copy as doubles
from gapr_core.registration.checks.assessment import Assessment, answer, assess_fit
from gapr_core.registration.checks.rigidity import allowing_for_deformation
from gapr_core.registration.checks.separate_patches import allowing_for_a_patch
from gapr_core.registration.checks.standoff import asking_the_standoff, unless_off_the_bone
from gapr_core.registration.confidence.classifier import Calibration
from gapr_core.registration.fit import mirror
from gapr_core.registration.fit.refinement import refine_fully, rest_on_whole
from gapr_core.registration.fit.verification import support, verify
from gapr_core.registration.guidance import guide
from gapr_core.registration.problem import inputs
from gapr_core.registration.problem import source as sources
from gapr_core.registration.problem import target as targets
from gapr_core.registration.problem.sensor import offset_surface
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.proposals.base import Proposer
from gapr_core.registration.proposals.search import NormalAlignedSearch
from gapr_core.registration.scenes import clutter, look_agreement
from gapr_core.registration.scenes import rounds as scene_rounds
from gapr_core.registration.scenes import scene as scenes
from gapr_core.registration.scenes import scene_fit as explained
from gapr_core.registration.scenes.scene import Look, Scene, Viewpoint
from gapr_core.registration.uncertainty.error_calibration import Precision
from gapr_core.registration.uncertainty.smooth_bias import bias_corrected
from gapr_core.results import Refusal, RegistrationResult, RegistrationStatus
from gapr_core.runtime.clock import Clock
from gapr_core.runtime.parallel import single_threaded_libraries
from gapr_core.surface import Surface

log = logging.getLogger(__name__)

Own = TypeVar("Own", bound="Registrar")
Array = NDArray[np.float64]

Enough = Callable[[Assessment], bool]  # whether an answer that is not sure by itself needs no other proposer

NO_POSES = np.empty((0, 4, 4))
NO_POSE = Refusal(RegistrationStatus.LOW_CONFIDENCE, "no pose to begin with was found: expose more bone")
MIRRORED_ROUNDS = 1  # of regions of a mirrored scene: on its own side it is found at once
WITHIN_MM = 15.0  # root mean square over the source: refinement comes from there to the same pose


def never(assessment: Assessment) -> bool:
    """Only what is sure by itself is enough."""
    return False


def no_image() -> None:
    """Of a source that is no scene, or one look of several."""


class Registrar:
    """Lays partial sources on one or many prepared targets.

    Proposers are asked in turn, each round with the poses of all so far, until an answer is sure, or good enough to be
    accepted and no more (`RegistrarConfig.searched_below`): with the shipped weights the network first, and the
    exhaustive search only if the network's answer is less, or may be sure and is not.

    Args:
        config: every setting.
        proposers: where hypotheses come from; the weight-free search when not given.
        calibrations: the confidence model of each round; the shipped ones when not given, with a warning for a network
            of other weights than those they were fitted to.
        scene_calibration: the confidence model of a source with a viewpoint; the shipped one when not given.
        precision: what corrects the predicted errors; the shipped one when not given.

    Raises:
        ConfigError: no proposer; another number of calibrations than proposers; a calibration fitted for another
            proposer, or a `scene_calibration` that is not for scenes.
        MethodUnavailableError: no confidence model ships for a proposer, and none was given.
    """

    name = "gapr"

    def __init__(
        self,
        config: RegistrarConfig | None = None,
        proposers: Sequence[Proposer] | None = None,
        calibrations: Sequence[Calibration] | None = None,
        scene_calibration: Calibration | None = None,
        precision: Precision | None = None,
    ) -> None:
        self.config = RegistrarConfig() if config is None else as_config(config)
        self.proposers: tuple[Proposer, ...] = (_search(self.config),) if proposers is None else tuple(proposers)
        if not self.proposers:
            raise ConfigError("at least one proposer", "an empty list", "leave `proposers` out for the search")
        if calibrations is None:
            calibrations = [_shipped_calibration(proposer) for proposer in self.proposers]
        self.calibrations = tuple(calibrations)
        self._scene_calibration = scene_calibration
        if len(self.calibrations) != len(self.proposers):
            given = f"{len(self.calibrations)} for {len(self.proposers)} proposers"
            raise ConfigError("one confidence model for each proposer", given, "pass as many calibrations as proposers")
        for proposer, calibration in zip(self.proposers, self.calibrations, strict=True):
            calibration.check_is_for(proposer.name)
        if scene_calibration is not None:
            scene_calibration.check_is_for(clutter.NAME)
        self.precision = precision or Precision.load()

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {', '.join(proposer.name for proposer in self.proposers)}; {self.config}>"

    @classmethod
    def from_pretrained(
        cls, config: RegistrarConfig | None = None, device: str = "cpu", weights: str | Path | None = None
    ) -> Registrar:
        """The best registrar that ships: GAPR-Net, then the search; nothing is downloaded.

        Args:
            config: every setting.
            device: where the network runs: "cpu", "cuda", or "auto" for the GPU where there is one.
            weights: of your own network; no confidence was fitted to it, and a warning says so.

        Raises:
            WeightsError: `weights` are missing, damaged or of another format.
            MethodUnavailableError: torch is not installed; `Registrar()` works without.
            ConfigError: no such device, or something else than a `RegistrarConfig`.
        """
        config = RegistrarConfig() if config is None else as_config(config)
        return cls(config, (pretrained_network(device, weights), _search(config)))

    @cached_property
    def scene_calibration(self) -> Calibration:
        """The confidence model of a source with a viewpoint, read when the first one comes."""
        return self._scene_calibration or Calibration.shipped(clutter.NAME)

    def of_bone_alone(self: Own) -> Own:
        """The same, but all of a source without a viewpoint is bone: for what was seen from several places."""
        twin = copy(self)
        twin.config = replace(self.config, clutter=replace(self.config.clutter, infer_viewpoint=False))
        return twin

    @single_threaded_libraries
    def prepare(self, target: str | Path | ArrayLike | Surface, units: str = "mm") -> PreparedTarget:
        """Everything static about a target, the proposers' share included; see `problem.target`."""
        prepared = targets.prepare(target, units, self.config.target, self.config.num_threads)
        for proposer in self.proposers:
            proposer.prepare(prepared)  # `both_cortices` gets its share when a source first follows both
        return prepared

    @answering
    def register(
        self,
        source: ArrayLike,
        target: PreparedTarget,
        initial: ArrayLike | None = None,
        viewpoint: Viewpoint | None = None,
    ) -> RegistrationResult:
        """The pose of a source on the target, or a refusal.

        Args:
            source: (N, 3), mm, in its own frame; rows that are not finite are dropped. Also a path or a `Surface`.
            target: from `prepare`.
            initial: (4, 4) T_target_source to try as well, such as the pose of the frame before.
            viewpoint: (3,) mm, source frame: where the camera was, if there was one; (N, 3) where it was for each
                point, of a camera that moved in a frame in which the bone rests. Without it the cloud is registered as
                bone; where the probability or the geometry of that pose is against it, as what a camera saw
                (`ClutterConfig.infer_viewpoint`).

        Raises:
            InvalidPointCloudError: wrong shape or type, or an extent that cannot be a piece of a bone in mm; a target
                that is not prepared; an `initial` that is no rigid pose; a `viewpoint` that is neither, or that sees
                nothing of the cloud; more than 16 places.
        """
        clock = Clock()
        return self.conclude(self.assess(source, target, initial, viewpoint, clock), clock)

    @single_threaded_libraries
    def conclude(self, assessment: Assessment | Refusal, clock: Clock) -> RegistrationResult:
        """The answer to an assessment: limits, names for clutter, thresholds, the question of a stand-off, guidance.

        What decides comes in this order. Of an inferred viewpoint more is asked (`accepted_if_inferred`). All of the
        answer is the caller's own: what is remembered of a stream, or of a target, shares no array with it.
        """
        if isinstance(assessment, Refusal):
            reason = assessment.reason
            return RegistrationResult(assessment.status, reason=reason, method=self.name, stage_ms=clock.stages)
        guidance = guide(assessment, self.config.guidance) if self.config.guide else None
        named = explained.named_clutter(limits.applied(assessment, self.config), self.config)
        inferred = assessment.inferred_viewpoint is not None
        asked = replace(self.config, min_confidence=self.config.accepted_if_inferred) if inferred else self.config
        is_more = asked.min_confidence > self.config.min_confidence
        since = ", as nobody said where the camera was" if is_more else ""
        result = asking_the_standoff(answer(named, asked, since), named, self.config)
        clock.lap("assess")
        return deepcopy(replace(result, guidance=guidance, method=self.name, stage_ms=clock.stages))

    @single_threaded_libraries
    def assess(
        self,
        source: ArrayLike,
        target: PreparedTarget,
        initial: ArrayLike | None = None,
        viewpoint: Viewpoint | None = None,
        clock: Clock | None = None,
        enough: Enough = never,
    ) -> Assessment | Refusal:
        """What `register` knows before `min_confidence` and `max_tre_mm` decide: for streams, calibration and research.

        An answer that is `enough` ends the rounds, and a mirror image of its source is registered in full only where it
        has at most `rules.mirrored_points`.
        """
        check_call(target, initial)
        start = NO_POSES if initial is None else inputs.rigid(initial, "initial pose")[None]
        return self.assess_from(source, target, start, viewpoint, clock or Clock(), enough)

    def assess_from(
        self,
        source: ArrayLike,
        target: PreparedTarget,
        start: Array,
        viewpoint: Viewpoint | None,
        clock: Clock,
        enough: Enough = never,
    ) -> Assessment | Refusal:
        """`assess` with any number of poses to try as well: (K, 4, 4) T_target_source, mm, each rigid."""
        target = offset_surface(target, self.config.sensor)
        if viewpoint is not None:
            return self._as_scene(scenes.split(source, viewpoint), target, start, clock, enough)
        prepared = sources.prepare(source, self.config.source, self.config.num_threads)
        clock.lap("prepare")
        if isinstance(prepared, Refusal):
            return rules.asking_the_unit(prepared, finite_points(source), target.points)
        assessment = self._as_bone(prepared, target, start, clock, enough)
        if assessment is None or not (assessment.reaches(self.config.min_confidence) or enough(assessment)):
            found = self._of_one_view(source, target, start, clock)
            if found is not None:
                return found
        if assessment is None:
            return NO_POSE
        checked = self._checked_and_corrected(assessment, clock, enough)
        if checked.refusal is None:
            return checked
        return replace(checked, refusal=rules.asking_the_unit(checked.refusal, prepared.points, target.points))

    def _as_scene(
        self, seen: list[Look], target: PreparedTarget, start: Array, clock: Clock, enough: Enough
    ) -> Assessment | Refusal:
        """What a camera saw; the part that is bone has no size of its own, which the whole could be compared by."""
        scene = scenes.prepared(seen, self.config)
        clock.lap("prepare")
        if isinstance(scene, Refusal):
            return rules.asking_the_unit(scene, np.concatenate([look.points for look in seen]), target.points)
        assessment = self._all_of_scene(scene, target, start, clock, enough)
        if assessment is None:
            return NO_POSE

        def alone(look: Scene) -> Assessment | None:
            found = self._in_scene(look, target, NO_POSES, clock)
            return None if found is None else self._checked_and_corrected(found, clock, never)

        def mirrored() -> Assessment | None:
            image = scenes.prepared(
                [Look(mirror.flipped(look.points), mirror.flipped(look.viewpoint)) for look in seen], self.config
            )
            return (
                None if isinstance(image, Refusal) else self._in_scene(image, target, NO_POSES, clock, MIRRORED_ROUNDS)
            )

        agreed = look_agreement.unless_apart(assessment, scene, target, alone, self.config)
        clock.lap("assess")
        return self._checked_and_corrected(agreed, clock, enough, mirrored)

    def _all_of_scene(
        self, scene: Scene, target: PreparedTarget, start: Array, clock: Clock, enough: Enough
    ) -> Assessment | None:
        """All looks of a scene; `memory.MemoryFirst` asks what it remembers first."""
        return self._in_scene(scene, target, start, clock)

    def _checked_and_corrected(
        self, assessment: Assessment, clock: Clock, enough: Enough, mirrored: checks.RegisterScene = no_image
    ) -> Assessment:
        """The answer after the costly steps that only one that may yet be accepted takes, and its predicted errors."""
        config = self.config
        if assessment.reaches(config.worth_checking):
            assessment = checks.unless_grown(assessment, config)
        if assessment.reaches(config.worth_checking):
            believed = assessment.reaches(config.rules.mirrored_below) or enough(assessment)
            image = partial(self._of_image, clock=clock)
            assessment = checks.unless_mirrored(assessment, config, believed, image, mirrored)
        if assessment.reaches(config.worth_checking):
            assessment = unless_off_the_bone(assessment, config)
        clock.lap("assess")
        if assessment.reaches(config.worth_checking):
            assessment = bias_corrected(assessment, config)
            clock.lap("refine")
        corrected = assessment.corrected(self.precision)
        if not corrected.reaches(config.worth_checking):
            return corrected

        def register(source: PreparedSource, poses: Array) -> Assessment | None:
            return self._in_rounds(source, assessment.target, poses, clock)

        found = allowing_for_a_patch(allowing_for_deformation(corrected, config), config)
        found = doubles.allowing_for_a_copy(found, config, register)
        clock.lap("assess")
        return found

    def _as_bone(
        self, source: PreparedSource, target: PreparedTarget, poses: Array, clock: Clock, enough: Enough
    ) -> Assessment | None:
        """A source of which all points may be bone: on the outer cortex, and on both where the residuals ask for it."""
        assessment = self._in_rounds(source, target, poses, clock, enough)
        if assessment is None or not cortices.follows_both(assessment, self.config):
            return assessment
        return self._on_both_cortices(assessment, clock)

    def _on_both_cortices(self, assessment: Assessment, clock: Clock) -> Assessment:
        """The source registered to the inner cortex as well; no more than so sure, as no such source was calibrated."""
        a, most = assessment, self.config.cortices.largest_confidence
        both = a.target.both_cortices
        again = None if both is None else self._in_rounds(a.source, both, a.fit.T[None], clock)
        return replace((again or a).capped(most), most=most)

    def _of_one_view(self, source: ArrayLike, target: PreparedTarget, poses: Array, clock: Clock) -> Assessment | None:
        """A source that is refused as bone, taken for what a camera saw; None where that is not sure either.

        It is asked all that one of bone alone is asked, since nobody said that it is a scene.
        """
        config, scene = self.config, scene_rounds.of_unknown(source, self.config)
        if scene is None:
            return None
        places, unsure = self._places_of(scene), []
        clock.lap("prepare")
        for viewpoint, rounds in places:
            found = self._in_scene(scenes.scene_from(scene, viewpoint, config), target, poses, clock, rounds)
            if found is None:
                continue
            found = replace(found, inferred_viewpoint=viewpoint)
            if not found.reaches(config.accepted_if_inferred):
                unsure.append(found)
                continue
            found = self._checked_and_corrected(found, clock, never)
            if found.refusal is None:
                return found
        return self._of_unsure_views(unsure, clock)

    def _places_of(self, source: PreparedSource) -> list[tuple[Array, int]]:
        """See `clutter.inferred_places`; `memory.MemoryFirst` knows where the last source was seen from."""
        return clutter.inferred_places(source, self.config)

    def _of_unsure_views(self, unsure: list[Assessment], clock: Clock) -> Assessment | None:
        """None: a source by itself is rather refused as bone; `memory.MemoryFirst` knows whether it is one."""
        return None

    def _in_scene(
        self, seen: Scene, target: PreparedTarget, poses: Array, clock: Clock, rounds: int | None = None
    ) -> Assessment | None:
        """See `scene_rounds.register`."""
        return scene_rounds.register(seen, target, poses, self.scene_calibration, self.config, clock, rounds)

    def _of_image(self, flipped: PreparedSource, target: PreparedTarget, clock: Clock) -> Assessment | None:
        """The mirror image of a source, registered in full; `memory.MemoryFirst` leaves what it remembers out."""
        return self._in_rounds(flipped, target, NO_POSES, clock)

    def _in_rounds(
        self, source: PreparedSource, target: PreparedTarget, poses: Array, clock: Clock, enough: Enough = never
    ) -> Assessment | None:
        """Ask one proposer after the other, each with the poses of all so far, until an answer is good enough."""
        config, assessment, given = self.config, None, len(poses)
        for number, (proposer, calibration) in enumerate(zip(self.proposers, self.calibrations, strict=True), 1):
            rng = np.random.default_rng(config.seed)
            proposed = proposer.propose(source, target, rng).poses
            clock.lap("propose")
            if not len(proposed):
                continue  # a pose that was given is not weighed against nothing
            poses = np.concatenate([poses, proposed])
            candidates = verify(poses, source, target, config.verification, config.num_threads)
            clock.lap("verify")
            fit = refine_fully(candidates.poses[0], source.points, target, config.refinement, source.neighbours)
            fit = rest_on_whole(fit, source, target, config.refinement)
            clock.lap("refine")
            assessment = assess_fit(fit, candidates, source, target, calibration, config)
            assessment = replace(assessment, proposer=proposer.name, rounds=number)
            clock.lap("assess")
            if enough(assessment) or (
                self._needs_no_other_proposer(assessment) and (not given or self._is_near(assessment, poses[given:]))
            ):
                break
        return assessment

    def _is_near(self, assessment: Assessment, proposed: Array) -> bool:
        """Whether a proposer would have come to the best pose without one that was given.

        Where none would, its poses are no rivals to the given one: what it missed may be the right one, too.
        """
        count, T = self.config.verification.markers, assessment.fit.T[None]
        return bool(support(T, proposed, assessment.source, count, WITHIN_MM)[0] > 0.0)

    def _needs_no_other_proposer(self, assessment: Assessment) -> bool:
        """True where no further proposer need be asked: the pose is sure, or good enough and too doubtful to be sure.

        What may be sure is searched for once more: where both agree, fewer bones of other subjects are. A memory
        (`memory.MemoryFirst`) has to be sure.
        """
        config = self.config
        is_good = assessment.reaches(max(config.searched_below, config.min_confidence))
        return assessment.reaches(config.sure_from) or (is_good and assessment.probability <= config.limits.most)


def as_config(config: object) -> RegistrarConfig:
    """The settings, if they are some."""
    if not isinstance(config, RegistrarConfig):
        how = "pass RegistrarConfig(...); weights of your own go into NetworkProposer.from_weights"
        raise ConfigError("a RegistrarConfig", repr(config), how)
    return config


def pretrained_network(device: str = "cpu", weights: str | Path | None = None) -> Proposer:
    """GAPR-Net with weights of one's own, the shipped ones when none are given.

    Raises:
        MethodUnavailableError: torch or safetensors is not installed.
        ConfigError: no such device.
    """
    try:
        from gapr_core.registration.proposals.network import SHIPPED, NetworkProposer
    except ImportError as error:
        how = "run: pip install 'gapr_ros[network]', or do without: Registrar(), or --method gapr_search"
        raise MethodUnavailableError("torch and safetensors for GAPR-Net", str(error), how) from error
    return NetworkProposer.from_weights(weights or SHIPPED, device)


def _shipped_calibration(proposer: Proposer) -> Calibration:
    if not getattr(proposer, "is_shipped", True):
        log.warning(
            "the shipped confidence was fitted to the shipped weights, and this network has others: do not rely on it. "
            "To fit one, put them in place of gapr_core/weights/gapr_net.safetensors, and run "
            "python -m gapr_core.calibration"
        )
    return Calibration.shipped(proposer.name)


def check_call(target: object, initial: ArrayLike | None) -> None:
    """Refuse a target that is not prepared, and an `initial` that is no rigid pose, before anything is forgotten.

    Raises:
        InvalidPointCloudError: as `Registrar.register`.
    """
    if not isinstance(target, PreparedTarget):
        how = "pass what `prepare` returns for it"
        raise InvalidPointCloudError("a prepared target", type(target).__name__, how)
    if initial is not None:
        inputs.rigid(initial, "initial pose")


def _search(config: RegistrarConfig) -> NormalAlignedSearch:
    return NormalAlignedSearch(config.search, config.num_threads)
