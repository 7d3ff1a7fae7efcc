"""The algorithm on one screen: prepare, propose, verify, refine, assess, check, conclude.

| step | where |
|---|---|
| clean and thin the source | `problem.source` |
| propose poses, keep the best distinct ones, refine the best, compute its two numbers | `_in_rounds` |
| the same for a camera's cloud, most of which may not be bone | `_in_scene` |
| apply the costly checks, correct pose and covariance | `_checked` |
| weigh the sources before it | `streams.evidence`, of a stream only |
| fold numbers and findings into the answer | `checks.conclude` |
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.clouds import finite_points
from gapr_core.config import RegistrarConfig
from gapr_core.errors import ConfigError, InvalidPointCloudError, MethodUnavailableError
from gapr_core.registration.caveats import answering
from gapr_core.registration.checks import image, table
from gapr_core.registration.checks.assess import assess_fit, bias_corrected, with_both_cortices
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.checks.conclude import conclude, unit_question
from gapr_core.registration.checks.deformation import deformation
from gapr_core.registration.confidence.classifier import Classifier
from gapr_core.registration.fit import alternatives
from gapr_core.registration.fit.refinement import refine_fully, rest_on_whole
from gapr_core.registration.fit.verification import Candidates, support, verify
from gapr_core.registration.guidance import guide
from gapr_core.registration.problem import inputs
from gapr_core.registration.problem import source as sources
from gapr_core.registration.problem import target as targets
from gapr_core.registration.problem.sensor import offset_surface
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.proposals import regions
from gapr_core.registration.proposals.search import NormalAlignedSearch, Proposer
from gapr_core.registration.scenes import clutter, look_agreement, scene_fit
from gapr_core.registration.scenes import scene as scenes
from gapr_core.registration.scenes.scene import Look, Scene, Viewpoint
from gapr_core.registration.uncertainty.error_calibration import Precision
from gapr_core.results import Refusal, RegistrationResult, RegistrationStatus
from gapr_core.runtime.clock import Clock
from gapr_core.runtime.parallel import single_threaded_libraries
from gapr_core.surface import Surface

log = logging.getLogger(__name__)

Own = TypeVar("Own", bound="Registrar")
Array = NDArray[np.float64]

Enough = Callable[[Assessment], bool]  # True for an unsure answer that needs no other proposer

NO_POSES = np.empty((0, 4, 4))
NO_POSE = Refusal(RegistrationStatus.LOW_CONFIDENCE, "no pose to begin with was found: expose more bone")
SEED = 0  # of proposers that draw
MOST_HOPELESS = 2  # rounds in a row of a cloud that may be no scene: later ones hardly ever have an accepted pose
WITHIN_MM = 15.0  # root mean square over the source from which refinement reaches the same pose


def never(assessment: Assessment) -> bool:
    """Stop only with a sure answer."""
    return False


class Registrar:
    """Registers partial sources to one or many prepared targets.

    Proposers run in turn, each round with the poses of all so far, until an answer is sure (`RegistrarConfig.sure`).
    With the shipped weights the network is first, then the exhaustive search.

    Args:
        config: settings of the registration.
        proposers: sources of hypotheses; the weight-free search when not given.
        classifier: model of the two numbers; the shipped one when not given, with a warning for a network of other
            weights than those it was fitted to.
        precision: correction of the predicted errors; the shipped one when not given.

    Raises:
        ConfigError: no proposer.
    """

    name = "gapr"

    def __init__(
        self,
        config: RegistrarConfig | None = None,
        proposers: Sequence[Proposer] | None = None,
        classifier: Classifier | None = None,
        precision: Precision | None = None,
    ) -> None:
        self.config = RegistrarConfig() if config is None else as_config(config)
        self.proposers: tuple[Proposer, ...] = (_search(self.config),) if proposers is None else tuple(proposers)
        if not self.proposers:
            raise ConfigError("at least one proposer", "an empty list", "leave `proposers` out for the search")
        if classifier is None and not all(getattr(each, "is_shipped", True) for each in self.proposers):
            log.warning(
                "the shipped confidence was fitted to the shipped weights, and this network has others: do not rely on "
                "it; fit one with python -m gapr_core.calibration and pass classifier=Classifier.load(FILE)"
            )
        self.classifier = classifier or Classifier.load()
        self.precision = precision or Precision.load()

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {', '.join(proposer.name for proposer in self.proposers)}; {self.config}>"

    @classmethod
    def from_pretrained(
        cls, config: RegistrarConfig | None = None, device: str = "cpu", weights: str | Path | None = None
    ) -> Registrar:
        """Load the best registrar that ships: GAPR-Net, then the search; nothing is downloaded.

        Args:
            config: settings of the registration.
            device: device of the network: "cpu", "cuda", or "auto" for the GPU where there is one.
            weights: of your own network; no confidence was fitted to it, and a warning says so.

        Raises:
            WeightsError: `weights` are missing, damaged or of another format.
            MethodUnavailableError: torch is not installed; `Registrar()` works without.
            ConfigError: no such device, or something else than a `RegistrarConfig`.
        """
        config = RegistrarConfig() if config is None else as_config(config)
        return cls(config, (pretrained_network(device, weights), _search(config)))

    def of_bone_alone(self: Own) -> Own:
        """Copy the registrar for sources that are all bone, such as those seen from several places."""
        twin = copy(self)
        twin.config = replace(self.config, clutter=replace(self.config.clutter, infer_viewpoint=False))
        return twin

    @single_threaded_libraries
    def prepare(self, target: str | Path | ArrayLike | Surface, units: str = "mm") -> PreparedTarget:
        """Compute everything static about a target, the proposers' share included; see `problem.target`."""
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
        """Find the pose of a source on the target, or refuse.

        Args:
            source: (N, 3), mm, in its own frame; rows that are not finite are dropped. Also a path or a `Surface`.
            target: from `prepare`.
            initial: (4, 4) T_target_source to try as well, such as the pose of the frame before.
            viewpoint: (3,) mm, source frame: place of the camera; (N, 3) its place for each point, of a camera that
                moved. Without it the cloud is registered as bone, and where that pose is refused, as a camera's cloud
                (`ClutterConfig.infer_viewpoint`).

        Raises:
            InvalidPointCloudError: wrong shape, type or extent of the source; a target that is not prepared. An
                `initial` that is no rigid pose. A `viewpoint` that sees nothing of the cloud, or more than 16 of them.
        """
        start, clock = check_call(target, initial), Clock()
        return self.conclude(self.assess(source, target, start, viewpoint, clock), clock)

    @single_threaded_libraries
    def conclude(self, assessment: Assessment | Refusal, clock: Clock) -> RegistrationResult:
        """Fold an assessment into the answer."""
        if isinstance(assessment, Refusal):
            reason = assessment.reason
            return RegistrationResult(assessment.status, reason=reason, method=self.name, stage_ms=clock.stages)
        guidance = guide(assessment) if self.config.guide else None
        accepted = assessment.reaches(self.config.min_confidence)
        mostly_clutter = None if accepted else scene_fit.mostly_clutter(assessment, self.config)
        result = conclude(assessment, self.config, mostly_clutter)
        alternatives.trial_of.cache_clear()  # it holds the bone
        clock.lap("assess")
        return replace(result, guidance=guidance, method=self.name, stage_ms=clock.stages)

    @single_threaded_libraries
    def assess(
        self,
        source: ArrayLike,
        target: PreparedTarget,
        start: Array = NO_POSES,
        viewpoint: Viewpoint | None = None,
        clock: Clock | None = None,
        enough: Enough = never,
    ) -> Assessment | Refusal:
        """Register up to the thresholds of the user; an answer that is `enough` ends the rounds.

        `start` are poses (K, 4, 4) T_target_source, mm, each rigid, to try as well.
        """
        target, clock = offset_surface(target, self.config.sensor), clock or Clock()
        if viewpoint is not None:
            return self._as_scene(scenes.split(source, viewpoint), target, start, clock, enough)
        prepared = sources.prepare(source, self.config.source, self.config.num_threads)
        clock.lap("prepare")
        if isinstance(prepared, Refusal):
            return asking_the_unit(prepared, finite_points(source), target)
        assessment = self._as_bone(prepared, target, start, clock, enough)
        if assessment is None or not (assessment.reaches(self.config.min_confidence) or enough(assessment)):
            found = self._of_one_view(source, target, start, clock)
            if found is not None:
                return found
        return NO_POSE if assessment is None else self._checked(assessment, clock, enough)

    def _as_bone(
        self, source: PreparedSource, target: PreparedTarget, poses: Array, clock: Clock, enough: Enough
    ) -> Assessment | None:
        """Register a source of which all points may be bone, to both cortices where it follows both."""
        assessment = self._in_rounds(source, target, poses, clock, enough)
        both = None if assessment is None else with_both_cortices(assessment, self.config)
        if assessment is None or both is None:
            return assessment
        return self._in_rounds(source, both, assessment.fit.T[None], clock) or assessment

    def _in_rounds(
        self, source: PreparedSource, target: PreparedTarget, poses: Array, clock: Clock, enough: Enough = never
    ) -> Assessment | None:
        """Run one proposer after the other, each with the poses of all so far, until an answer is good enough."""
        config, assessment, given = self.config, None, len(poses)
        for number, proposer in enumerate(self.proposers, 1):
            proposed = proposer.propose(source, target, np.random.default_rng(SEED))
            clock.lap("propose")
            if not len(proposed):
                continue  # a given pose needs a rival
            poses = np.concatenate([poses, proposed])
            candidates = verify(poses, source, target, config.verification, config.num_threads)
            clock.lap("verify")
            fit = refine_fully(candidates.poses[0], source.points, target, config.refinement, source.neighbours)
            fit = rest_on_whole(fit, source, target, config.refinement)
            clock.lap("refine")
            assessment = assess_fit(fit, candidates, source, target, self.classifier, config)
            assessment = replace(assessment, proposer=proposer.name, rounds=number)
            clock.lap("assess")
            # a proposer reached the best pose, too: else its poses are no rivals to a given one
            others, count = poses[given:], config.verification.markers
            is_known = not given or support(fit.T[None], others, source, count, WITHIN_MM)[0] > 0.0
            if enough(assessment) or (assessment.reaches(config.sure_from) and is_known):
                break
        return assessment

    def _checked(
        self, assessment: Assessment, clock: Clock, enough: Enough, mirrored_scene: image.RegisterScene | None = None
    ) -> Assessment:
        """Apply the costly checks to a pose that may be accepted, then correct pose and covariance."""
        config = self.config
        if assessment.reaches(config.worth_checking):
            believed = assessment.reaches(config.sure_from) or enough(assessment)
            log_ratio = image.log_ratio(assessment, config, believed, self._of_image, mirrored_scene, clock)
            assessment = table.mirror_image(assessment, log_ratio)
            clock.lap("assess")
        if assessment.reaches(config.worth_checking):
            assessment = bias_corrected(assessment, config)
            clock.lap("refine")
        assessment = assessment.corrected(self.precision)
        if assessment.reaches(config.worth_checking):
            found = deformation(assessment.fit)
            assessment = assessment if found is None else assessment.with_finding(*found)
            clock.lap("assess")
        return assessment

    def _of_image(self, flipped: PreparedSource, target: PreparedTarget, clock: Clock) -> Candidates | None:
        """Find poses of the mirror image of a source with the first proposer."""
        poses = self.proposers[0].propose(flipped, target, np.random.default_rng(SEED))
        clock.lap("propose")
        if not len(poses):
            return None
        found = verify(poses, flipped, target, self.config.verification, self.config.num_threads)
        clock.lap("verify")
        return found

    def _as_scene(
        self, seen: list[Look], target: PreparedTarget, start: Array, clock: Clock, enough: Enough
    ) -> Assessment | Refusal:
        """Register the cloud of a camera whose place is known."""
        scene = scenes.prepared(seen, self.config)
        clock.lap("prepare")
        if isinstance(scene, Refusal):
            return asking_the_unit(scene, np.concatenate([look.points for look in seen]), target)
        assessment = self._all_of_scene(scene, target, start, clock, enough)
        if assessment is None:
            return NO_POSE

        def alone(look: Scene) -> Assessment | None:
            found = self._in_scene(look, target, NO_POSES, clock)
            return None if found is None else self._checked(found, clock, never)

        def mirrored() -> Assessment | None:
            looks = [Look(image.flipped(look.points), image.flipped(look.viewpoint)) for look in seen]
            flipped = scenes.prepared(looks, self.config)
            return None if isinstance(flipped, Refusal) else self._in_scene(flipped, target, NO_POSES, clock, 1)

        agreed = look_agreement.unless_apart(assessment, scene, target, alone, self.config)
        clock.lap("assess")
        return self._checked(agreed, clock, enough, mirrored)

    def _all_of_scene(
        self, scene: Scene, target: PreparedTarget, start: Array, clock: Clock, enough: Enough
    ) -> Assessment | None:
        """Register all looks of a scene; `memory.TrackingRegistrar` tries the previous poses first."""
        return self._in_scene(scene, target, start, clock)

    def _in_scene(
        self, seen: Scene, target: PreparedTarget, poses: Array, clock: Clock, most_rounds: int | None = None
    ) -> Assessment | None:
        """Register a view with the regions of round after round, until an answer is sure.

        A cloud that may be no scene has `most_rounds`, and stops after some hopeless ones in a row.
        """
        config, settings, threads = self.config, self.config.clutter, self.config.num_threads
        assessment, hopeless = None, 0
        rounds = regions.rounds(seen.source, replace(settings, rounds=most_rounds or settings.rounds))
        for number, found in enumerate(rounds, 1):
            scene = replace(seen, regions=found)
            pool = clutter.propose(scene, target, poses, settings, threads)
            clock.lap("propose")
            if (pool.region == clutter.GIVEN).all():
                continue  # a given pose needs a rival
            start = poses if assessment is None else None
            candidates = clutter.verify(pool, scene, target, settings, threads, start)
            poses = candidates.poses
            clock.lap("verify")
            assessment = self._assessed_part(candidates, scene, target, clock)
            assessment = replace(assessment, proposer=clutter.NAME, rounds=number)
            hopeless = hopeless + 1 if assessment.confidence < settings.hopeless else 0
            if assessment.reaches(config.sure_from) or (most_rounds is not None and hopeless == MOST_HOPELESS):
                break
        return assessment

    def _assessed_part(self, candidates: Candidates, scene: Scene, target: PreparedTarget, clock: Clock) -> Assessment:
        """Refine the first of the candidates on the part of a scene that it explains, and assess it."""
        part = scene_fit.refine(candidates.poses[0], scene, target, self.config)
        clock.lap("refine")
        assessment = scene_fit.assess_part(part, candidates, scene, target, self.classifier, self.config)
        clock.lap("assess")
        return assessment

    def _of_one_view(self, source: ArrayLike, target: PreparedTarget, poses: Array, clock: Clock) -> Assessment | None:
        """Register a source that is refused as bone as a camera's cloud; None where that is refused, too."""
        scene = clutter.possible_view(source, self.config)
        if scene is None:
            return None
        places, unsure = self._places_of(scene), []
        clock.lap("prepare")
        for viewpoint, most_rounds in places:
            found = self._in_scene(scenes.scene_from(scene, viewpoint, self.config), target, poses, clock, most_rounds)
            if found is None:
                continue
            found = replace(found, inferred_viewpoint=viewpoint)
            if not found.reaches(self.config.min_confidence):
                unsure.append(found)
                continue
            found = self._checked(found, clock, never)
            if found.refusal is None:
                return found
        return self._of_unsure_views(unsure, clock)

    def _places_of(self, source: PreparedSource) -> list[tuple[Array, int]]:
        """Infer the camera's places; `memory.TrackingRegistrar` knows the place of the last source."""
        return clutter.inferred_places(source, self.config)

    def _of_unsure_views(self, unsure: list[Assessment], clock: Clock) -> Assessment | None:
        """Return no answer: a single source is rather refused as bone; in a stream it may be a view."""
        return None


def as_config(config: object) -> RegistrarConfig:
    """Return the settings if they are a `RegistrarConfig`, else raise."""
    if not isinstance(config, RegistrarConfig):
        how = "pass RegistrarConfig(...); weights of your own go into NetworkProposer.from_weights"
        raise ConfigError("a RegistrarConfig", repr(config), how)
    return config


def pretrained_network(device: str = "cpu", weights: str | Path | None = None) -> Proposer:
    """Load GAPR-Net with weights of one's own, or with the shipped ones; raises as `Registrar.from_pretrained`."""
    try:
        from gapr_core.registration.proposals.network import SHIPPED, NetworkProposer
    except ImportError as error:
        how = "run: pip install 'gapr_ros[network]', or do without: Registrar(), or --method gapr_search"
        raise MethodUnavailableError("torch and safetensors for GAPR-Net", str(error), how) from error
    return NetworkProposer.from_weights(weights or SHIPPED, device)


def check_call(target: object, initial: ArrayLike | None) -> Array:
    """Return start poses (K, 4, 4). Raise for a target that is not prepared, or an `initial` that is no rigid pose."""
    if not isinstance(target, PreparedTarget):
        how = "pass what `prepare` returns for it"
        raise InvalidPointCloudError("a prepared target", type(target).__name__, how)
    return NO_POSES if initial is None else inputs.rigid(initial, "initial pose")[None]


def asking_the_unit(refusal: Refusal, source: Array, target: PreparedTarget) -> Refusal:
    """Add the question for the unit to the refusal of a source that is too thin for a pose."""
    asked = unit_question(source, target.points) if refusal.status is RegistrationStatus.DEGENERATE else None
    return refusal if asked is None else replace(refusal, reason=f"{refusal.reason}; {asked.text}")


def _search(config: RegistrarConfig) -> NormalAlignedSearch:
    return NormalAlignedSearch(config.search, config.num_threads)
