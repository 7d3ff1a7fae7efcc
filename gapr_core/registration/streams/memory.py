"""The last pose of a stream and its rivals, asked for the next source before all else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.geometry import se3
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.fit.verification import Candidates
from gapr_core.registration.problem.sensor import offset_surface
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.proposals.base import Proposals
from gapr_core.registration.registrar import Enough, Registrar, never
from gapr_core.registration.scenes import rounds as scene_rounds
from gapr_core.registration.scenes import scene as scenes
from gapr_core.registration.scenes.scene import Scene, Viewpoint
from gapr_core.results import Refusal
from gapr_core.runtime.clock import Clock

Array = NDArray[np.float64]


class PreviousPoses:
    """Proposes the last pose, and the rivals that the last full registration gave it.

    The rivals matter as much as the pose. Without them nothing would compete with it, and a pose that is merely the
    only one looked at would count as sure.

    Attributes:
        poses: (K, 4, 4) T_target_source of the last source that was assessed, mm, best first.
        support: share of the hypotheses that came to the pose in the last full registration.
        place: (3,) mm, frame of the last source: where its camera was inferred to be; None where nobody had to ask.
    """

    name = "track"

    def __init__(self) -> None:
        self.poses: Array = np.empty((0, 4, 4))
        self.support = 0.0
        self.place: Array | None = None

    def prepare(self, target: PreparedTarget) -> None:
        """Nothing of a target is needed."""

    def propose(self, source: PreparedSource, target: PreparedTarget, rng: np.random.Generator) -> Proposals:
        """The pose first, then its rivals."""
        return Proposals(self.poses, np.linspace(1.0, 0.0, len(self.poses)))

    def keep(self, poses: Sequence[Array]) -> None:
        """Remember the hypotheses of a full registration, best first: (4, 4) T_target_source, mm, each."""
        self.poses = np.stack(poses)

    def follow(self, pose: Array, source: Array) -> None:
        """The source (N, 3), mm, has moved from the remembered pose nearest to `pose`, T_before to T_now.

        All others move with it, R to R inv(T_before) T_now; the nearest one comes first.
        """
        before = self.poses
        nearest = int(np.argmin([se3.rms_apart_mm(each, pose, source) for each in before]))
        moved = before @ (se3.inverse(before[nearest]) @ pose)
        self.keep([moved[nearest], *np.delete(moved, nearest, axis=0)])


class TrackingRegistrar(Registrar):
    """Asks the previous poses first, then the proposers of another registrar.

    Args:
        memory: what is remembered of the last source.
        full: registers what the memory knows nothing of: the mirror image of a source.
    """

    def __init__(self, memory: PreviousPoses, full: Registrar) -> None:
        super().__init__(full.config, (memory, *full.proposers), full.classifier, full.precision)
        self._full, self._memory = full, memory

    def assess_from(
        self,
        source: ArrayLike,
        target: PreparedTarget,
        start: Array,
        viewpoint: Viewpoint | None,
        clock: Clock,
        enough: Enough = never,
    ) -> Assessment | Refusal:
        """Where the camera of the last source had to be inferred, this one is compared as its next view at once."""
        if viewpoint is None and self._memory.place is not None:
            surface = offset_surface(target, self.config.sensor)
            found = self._of_next_view(source, surface, start, clock, enough)
            if found is not None:
                return found
        return super().assess_from(source, target, start, viewpoint, clock, enough)

    def _of_next_view(
        self, source: ArrayLike, target: PreparedTarget, start: Array, clock: Clock, enough: Enough
    ) -> Assessment | None:
        """A source of which nobody said where it was seen from; None where what is remembered is not sure there."""
        scene = scene_rounds.of_unknown(source, self.config)
        places = [] if scene is None else self._places_of(scene)
        clock.lap("prepare")
        if scene is None or not places:
            return None
        place, _ = places[0]
        found = self._remembered(scenes.scene_from(scene, place, self.config), target, start, clock, enough)
        if found is None or not found.reaches(self.config.min_confidence):
            return None
        found = self._checked(replace(found, inferred_viewpoint=place), clock, enough)
        return found if found.refusal is None else None

    def _places_of(self, source: PreparedSource) -> list[tuple[Array, int]]:
        """The one nearest to where the last source was seen from comes first, if that had to be inferred."""
        places, last = super()._places_of(source), self._memory.place
        if last is None:
            return places
        return sorted(places, key=lambda place: float(np.linalg.norm(place[0] - last)))

    def _of_unsure_views(self, unsure: list[Assessment], clock: Clock) -> Assessment | None:
        """The surest, in a stream of such views: as bone it is nonsense, which would speak against the bone."""
        if self._memory.place is None or not unsure:
            return None
        surest = max(unsure, key=lambda view: view.confidence)
        return self._checked(surest, clock, never)

    def _all_of_scene(
        self, scene: Scene, target: PreparedTarget, start: Array, clock: Clock, enough: Enough
    ) -> Assessment | None:
        """What is remembered first; of several looks, which may contradict each other, no region is left out."""
        poses = np.concatenate([start, self._memory.poses])
        if len(scene.images) > 1:
            return self._in_scene(scene, target, poses, clock)
        found = self._remembered(scene, target, start, clock, enough)
        return self._in_scene(scene, target, poses, clock) if found is None else found

    def _remembered(
        self, scene: Scene, target: PreparedTarget, start: Array, clock: Clock, enough: Enough
    ) -> Assessment | None:
        """The best of what is remembered; None where it is not sure, and regions have to be asked."""
        poses, how = np.concatenate([start, self._memory.poses]), (self.classifier, self.config, clock)
        found = scene_rounds.of_remembered(scene, target, poses, self._memory.support, *how)
        if found is None:
            return None
        found = replace(found, proposer=PreviousPoses.name, rounds=1)
        return found if self._needs_no_other_proposer(found) or enough(found) else None

    def _of_image(self, flipped: PreparedSource, target: PreparedTarget, clock: Clock) -> Candidates | None:
        return self._full._of_image(flipped, target, clock)

    def _of_one_view(self, source: ArrayLike, target: PreparedTarget, poses: Array, clock: Clock) -> Assessment | None:
        return super()._of_one_view(source, target, np.concatenate([poses, self._memory.poses[:1]]), clock)
