"""The last pose of a stream and its rivals: the first proposals for the next source."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.geometry import se3
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.fit.verification import Candidates
from gapr_core.registration.problem.sensor import offset_surface
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.registrar import NO_POSES, Enough, Registrar, never
from gapr_core.registration.scenes import clutter
from gapr_core.registration.scenes import scene as scenes
from gapr_core.registration.scenes.scene import Scene, Viewpoint
from gapr_core.results import Refusal
from gapr_core.runtime.clock import Clock
from gapr_core.runtime.parallel import single_threaded_libraries

Array = NDArray[np.float64]


class PreviousPoses:
    """Proposes the last pose and its rivals of the last full registration; alone it would count as sure."""

    name = "track"

    def __init__(self) -> None:
        self.poses: Array = np.empty((0, 4, 4))  # T_target_source of the last assessed source, mm, best first
        self.support = 0.0  # share of the hypotheses that came to the pose in the last full registration
        self.place: Array | None = None  # (3,) mm, frame of the last source: inferred place of its camera

    def prepare(self, target: PreparedTarget) -> None:
        """Prepare nothing."""

    def propose(self, source: PreparedSource, target: PreparedTarget, rng: np.random.Generator) -> Array:
        """Propose the pose first, then its rivals."""
        return self.poses

    def follow(self, pose: Array, source: Array) -> None:
        """Move all poses with the source (N, 3), mm: the nearest one to `pose` becomes it, and comes first."""
        before = self.poses
        nearest = int(np.argmin([se3.rms_apart_mm(each, pose, source) for each in before]))
        moved = before @ (se3.inverse(before[nearest]) @ pose)
        self.poses = np.stack([moved[nearest], *np.delete(moved, nearest, axis=0)])


class TrackingRegistrar(Registrar):
    """Uses the previous poses first, then the proposers of a full registrar, which registers mirror images, too."""

    def __init__(self, memory: PreviousPoses, full: Registrar) -> None:
        super().__init__(full.config, (memory, *full.proposers), full.classifier, full.precision)
        self._full, self._memory = full, memory

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
        """Assess a source; after a source with an inferred camera, as the next view of that camera first."""
        clock = clock or Clock()
        if viewpoint is None and self._memory.place is not None:
            surface = offset_surface(target, self.config.sensor)
            assessment = self._of_next_view(source, surface, clock, enough)
            if assessment is not None:
                return assessment
        return super().assess(source, target, start, viewpoint, clock, enough)

    def _of_next_view(
        self, source: ArrayLike, target: PreparedTarget, clock: Clock, enough: Enough
    ) -> Assessment | None:
        """Assess a source without a viewpoint as the camera's next view; None where the previous poses are not sure."""
        scene = clutter.possible_view(source, self.config)
        places = [] if scene is None else self._places_of(scene)
        clock.lap("prepare")
        if scene is None or not places:
            return None
        place, _ = places[0]
        assessment = self._remembered(scenes.scene_from(scene, place, self.config), target, clock, enough)
        if assessment is None or not assessment.reaches(self.config.min_confidence):
            return None
        assessment = self._checked(replace(assessment, inferred_viewpoint=place), clock, enough)
        return assessment if assessment.refusal is None else None

    def _places_of(self, source: PreparedSource) -> list[tuple[Array, int]]:
        """Infer places as the full registrar; the one nearest to the last inferred place comes first."""
        places, last = super()._places_of(source), self._memory.place
        if last is None:
            return places
        return sorted(places, key=lambda place: float(np.linalg.norm(place[0] - last)))

    def _of_unsure_views(self, unsure: list[Assessment], clock: Clock) -> Assessment | None:
        """Return the surest view in a stream of such views; as bone alone it would speak against the bone."""
        if self._memory.place is None or not unsure:
            return None
        surest = max(unsure, key=lambda view: view.confidence)
        return self._checked(surest, clock, never)

    def _all_of_scene(
        self, scene: Scene, target: PreparedTarget, start: Array, clock: Clock, enough: Enough
    ) -> Assessment | None:
        """Try the previous poses first; of several looks, which may contradict each other, all regions propose, too.

        The previous poses are the start: a stream has no other (`start` is empty).
        """
        found = None if len(scene.images) > 1 else self._remembered(scene, target, clock, enough)
        return found or self._in_scene(scene, target, self._memory.poses, clock)

    def _remembered(self, scene: Scene, target: PreparedTarget, clock: Clock, enough: Enough) -> Assessment | None:
        """Assess the best of the previous poses; None where it is not sure, or alone: then regions must propose.

        Of a few remembered hypotheses its own would be a large share: its support is that of the last regions.
        """
        poses, config = self._memory.poses, self.config
        found = clutter.verify(clutter.given(poses), scene, target, config.clutter, config.num_threads, poses)
        clock.lap("verify")
        if len(found.poses) < 2:
            return None
        found = replace(found, support=np.minimum(found.support, self._memory.support))
        assessment = self._assessed_part(found, scene, target, clock)
        assessment = replace(assessment, proposer=PreviousPoses.name, rounds=1)
        return assessment if assessment.reaches(self.config.sure_from) or enough(assessment) else None

    def _of_image(self, flipped: PreparedSource, target: PreparedTarget, clock: Clock) -> Candidates | None:
        return self._full._of_image(flipped, target, clock)

    def _of_one_view(self, source: ArrayLike, target: PreparedTarget, poses: Array, clock: Clock) -> Assessment | None:
        return super()._of_one_view(source, target, np.concatenate([poses, self._memory.poses[:1]]), clock)
