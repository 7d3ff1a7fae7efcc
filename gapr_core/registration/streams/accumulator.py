"""The last sources of a stream registered together: what a probe has collected, in a frame in which the bone rests."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.clouds import finite_points
from gapr_core.errors import ConfigError
from gapr_core.geometry import sampling, se3
from gapr_core.geometry.twists import covariance_about, predicted_rmse_mm
from gapr_core.registration.caveats import answering
from gapr_core.registration.checks import limits, rules
from gapr_core.registration.checks.rigidity import covariance_of_half
from gapr_core.registration.fit.refinement import distances_mm, refine_fully
from gapr_core.registration.problem.sensor import offset_surface
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.registrar import Registrar, check_call
from gapr_core.registration.streams import motion_test as creep
from gapr_core.registration.streams.duplicate_clouds import fingerprint
from gapr_core.registration.streams.outlier_clouds import FarInARow
from gapr_core.registration.streams.tracker import Tracker
from gapr_core.registration.uncertainty import target_error as precision
from gapr_core.results import RegistrationResult, RegistrationStatus
from gapr_core.runtime.parallel import single_threaded_libraries
from gapr_core.surface import Surface

Array = NDArray[np.float64]

POSED = (RegistrationStatus.OK, RegistrationStatus.AMBIGUOUS)  # the second one fits the sources as well as another
FEWEST_IN_TIME = 6  # sources that show a motion, as it is refused
FEWEST_THAT_MAY, MAY_MOVE = 3, 1.0 / 6.0  # sources in which, and share of `rigidity.creeps` from which on it may be one


class Accumulator:
    """Registers each source together with those before it.

    Nothing helps more than seeing more of the bone: images of a probe that say nothing alone determine the pose
    together. All sources must be in one frame in which the bone rests, such as that of a reference fixed to it. Under
    an accepted pose each new source is looked at by itself, one of few points together with such ones just before it;
    what lies off the bone, or lay off it under the accepted pose before, is left out, and refused if it is the newest.
    After three of them in a row the bone or its reference has moved, and only these three are kept. Where all show that
    the bone moves (see `creep`), the answer is refused, and those since a step or the last third are kept.

    Args:
        method: registers what is collected; of a `Tracker`, which stays as it is, one whose sources count as one
            (`Tracker.sharing_points`).
        most: how many sources are kept, the newest among them.

    Raises:
        ConfigError: `most` is no whole number, or less than 1; a method that cannot register.
    """

    name = "gapr_accumulator"

    def __init__(self, method: Registrar | Tracker, most: int) -> None:
        if not isinstance(most, int | np.integer) or most < 1:
            raise ConfigError("a whole number of sources to keep, at least 1", repr(most), "1 registers each by itself")
        if not (hasattr(method, "register") and hasattr(method, "config")):
            raise ConfigError("a Registrar or a Tracker", repr(method), "pass Registrar.from_pretrained()")
        self.method, self.most = _of_many_places(method), most
        self.config = self.method.config
        self._target: PreparedTarget | None = None
        self._far_away = FarInARow(self.config.accumulation.most_off, "source")
        self.reset()

    @property
    def collected(self) -> Array:
        """(N, 3) all points that are kept, mm."""
        return _together(self._kept + self._new)

    def together_with(self, source: ArrayLike) -> Array:
        """(N, 3) mm, what `register` would register with a source (n, 3): the last of those kept, and itself."""
        return _together([*self._kept, *self._new, np.asarray(source, dtype=np.float64)][-self.most :])

    def reset(self) -> None:
        """Forget all sources, and the track of a `Tracker`."""
        self._kept: list[Array] = []  # on the bone under an accepted pose, or from before there was one
        self._new: list[Array] = []  # since the last registration; several, where `collect` is called in between
        self._small: list[Array] = []  # the newest of few points, which are looked at together
        self._off_in_a_row: list[Array] = []  # off the bone under an accepted pose, and left out
        self._accepted: RegistrationResult | None = None  # the last answer that was
        self._far_away.reset()
        if isinstance(self.method, Tracker):
            self.method.reset()

    def collect(self, source: ArrayLike) -> None:
        """Keep a source (N, 3), mm, without registering; the oldest one goes when there are too many.

        An empty source, and one that is there already, changes nothing. One that is metres away from the others cannot
        be of the same bone in the same frame: it is left out, and the third in a row restarts the collection.

        Raises:
            InvalidPointCloudError: wrong shape or type, points that are metres apart, or metres away from the others.
        """
        points = finite_points(source)
        points = points[sampling.thin(points, self.config.accumulation.most_points)]
        if not len(points):
            return
        if self._far_away.restarts_with(points, self.collected):
            self.reset()
        if not _was_sent(points, self._kept + self._new):
            self._new = [*self._new, points][-self.most :]

    def prepare(self, target: str | Path | ArrayLike | Surface, units: str = "mm") -> PreparedTarget:
        """Everything static about a target; see `Registrar.prepare`."""
        return self.method.prepare(target, units)

    @answering
    @single_threaded_libraries
    def register(
        self,
        source: ArrayLike,
        target: PreparedTarget,
        initial: ArrayLike | None = None,
        viewpoint: ArrayLike | None = None,
    ) -> RegistrationResult:
        """As `Registrar.register`, of all that is collected, this source included.

        Another target than before starts a new collection. A source that cannot be registered is not kept, and one
        without a finite point is refused: what was collected before says nothing about it.

        Raises:
            ConfigError: a viewpoint is given; the collected sources were seen from many.
            InvalidPointCloudError: as `collect` and `Registrar.register`.
        """
        if viewpoint is not None:
            how = "register a camera's clouds with a LookAccumulator, or leave the viewpoint out"
            raise ConfigError("collected sources without a viewpoint", "one viewpoint for all of them", how)
        if isinstance(self.method, Registrar | Tracker):  # others have targets of their own
            check_call(target, initial)
        points = finite_points(source)
        if self._target is not None and self._target is not target:
            self.reset()
        self._target = target
        if not len(points):
            return RegistrationResult(RegistrationStatus.TOO_FEW_POINTS, reason="the source has no finite point")
        kept, before = self._kept, self._new
        self.collect(source)
        try:
            result = self.method.register(_together(self._registered_together()), target, initial)
        except Exception:
            self._new = before if self._kept is kept else []  # or the collection restarted with this source
            raise
        found = self._decide_on_new(replace(result, method=self.name), target)
        self._accepted = found if found.ok else self._accepted
        return found

    def _registered_together(self) -> list[Array]:
        """The sources that are registered as one, the newest last."""
        return (self._kept + self._new)[-self.most :]

    def _decide_on_new(self, result: RegistrationResult, target: PreparedTarget) -> RegistrationResult:
        """The answer, once the new sources that lie on the bone under its pose are kept; without a pose all are.

        It is a refusal where the newest source lies off the bone, or so many in a row that the bone has moved.
        """
        T = result.best if result.status in POSED else None
        if T is None:  # it says nothing of any source, nor of a row of those off the bone
            for source in self._new:
                self._join_small_ones(source)
            self._kept, self._new = self._registered_together(), []
            return result
        new, off = self._new, self._update_row_off_the_bone(T, target)
        self._kept = [source for source in self._kept + new if not _is_among(source, off)][-self.most :]
        self._new = []
        if len(self._off_in_a_row) >= self.config.accumulation.most_off:
            return self._restart(result)
        if new and self._off_in_a_row:
            newest = "newest source lies" if _is_among(new[-1], off) else "sources before lie"
            why = f"the {newest} off the bone where the others found it: left out"
            return _refused(result, why)
        return self._unless_it_moves(result, T, target)

    def _unless_it_moves(self, result: RegistrationResult, T: Array, target: PreparedTarget) -> RegistrationResult:
        """The answer; a refusal where the sources show that the bone moves, not sure where they hardly exclude it.

        What it may have moved by is in the covariance then. Those since a step are left; of a steady motion the last
        third.
        """
        kept, rigidity = self._kept, self.config.rigidity
        if len(kept) < FEWEST_THAT_MAY:
            return result
        order = np.repeat(np.arange(len(kept)), list(map(len, kept)))
        some = slice(None, None, 1 + len(order) // self.config.accumulation.most_points)
        points, seen = np.ascontiguousarray(_together(kept)[some]), offset_surface(target, self.config.sensor)
        fit = refine_fully(T, points, seen, self.config.refinement)
        found = creep.of_motion(fit, order[some], rigidity)
        ratio = found.finding.log_ratio
        if ratio <= MAY_MOVE * rigidity.creeps:
            return result
        if ratio <= rigidity.creeps or len(kept) < FEWEST_IN_TIME:
            widened = self._widened(
                result, covariance_of_half(fit, found.finding.size_mm), fit.moved.mean(axis=0), target
            )
            return limits.no_surer(widened, limits.MOVING, self.config)
        self.reset()
        self._kept = kept[-(len(kept) // 3) :] if found.rests_from is None else kept[found.rests_from :]
        why = "the bone moves against the frame of the sources while they are collected: only the last are kept"
        return _refused(result, f"{why}; look at what is fixed to the bone")

    def _widened(
        self, result: RegistrationResult, added: Array, about_mm: Array, target: PreparedTarget
    ) -> RegistrationResult:
        """An answer with more in its covariance and in its errors; refused where these are too large then.

        Args:
            result: an answer.
            added: (6, 6) covariance about a centre of its own.
            about_mm: (3,) that centre, target frame.
            target: the bone.
        """
        if result.covariance is None or result.centre_mm is None:  # as of methods that predict no error
            return result
        covariance = result.covariance + covariance_about(result.centre_mm - about_mm, added)
        tre_mm = predicted_rmse_mm(covariance, target.points, result.centre_mm)
        tre95_mm = result.factor95 * precision.bound_mm(covariance, target.points, result.centre_mm)
        refusal = rules.by_threshold(result.confidence, tre95_mm, self.config)
        if refusal is not None:
            return result.refused(refusal.status, refusal.reason)
        return replace(result, covariance=covariance, tre_mm=tre_mm, tre95_mm=tre95_mm)

    def _update_row_off_the_bone(self, T: Array, target: PreparedTarget) -> list[Array]:
        """Which sources lie off the bone under a pose (4, 4), mm: of the new ones, and of small ones judged with them.

        Each of them prolongs the row of those off the bone, each other one ends it. One of too few points does neither.
        """
        everything, seen = _together(self._registered_together()), offset_surface(target, self.config.sensor)
        off: list[Array] = []
        for source in self._new:
            judged = self._join_small_ones(source)
            points = _together(judged)
            if not judged:
                continue
            if not (self._lies_off(points, everything, T, seen) or self._contradicts(points, seen)):
                self._off_in_a_row = []
                continue
            off, self._small = off + judged, []
            if not _is_among(points, self._off_in_a_row):
                self._off_in_a_row = [*self._off_in_a_row, points]
        return off

    def _join_small_ones(self, source: Array) -> list[Array]:
        """Take up a source (N, 3). Returns what is judged: it, or of few points those before it too; [] for too few."""
        fewest = self.config.accumulation.fewest_points
        if len(source) >= fewest:
            self._small = []
            return [source]
        self._small = [*self._small, source]
        while sum(map(len, self._small[1:])) >= fewest:
            self._small = self._small[1:]
        return self._small if sum(map(len, self._small)) >= fewest else []

    def _restart(self, result: RegistrationResult) -> RegistrationResult:
        """Refuse, and keep nothing but the sources in a row that lie off the bone: where it is now."""
        moved = self._off_in_a_row
        self.reset()
        self._kept = moved[-self.most :]
        reason = f"{len(moved)} sources in a row lie off the bone: it has moved, and the collection restarts"
        return _refused(result, reason)

    def _lies_off(self, source: Array, points: Array, T: Array, target: PreparedTarget, least_mm: float = 0.0) -> bool:
        """True when the typical point of a source (N, 3) is much farther off the surface than that of all (M, 3).

        And farther than `least_mm`.
        """
        limits, refinement = self.config.accumulation, self.config.refinement
        some = np.ascontiguousarray(points[:: 1 + len(points) // limits.most_points])
        own, of_all = (_typical_distance_mm(T, each, target) for each in (source, some))
        return own > max(least_mm, limits.off * max(of_all, refinement.smallest_sigma_mm))

    def _contradicts(self, source: Array, target: PreparedTarget) -> bool:
        """True when a source (N, 3) lies off the bone under the last accepted pose, farther than that may be off there.

        A large source may pull the pose that it shares with those before along, and lie on the bone then.
        """
        before, last = self._registered_together()[: -len(self._new)], self._accepted
        if not before or last is None:
            return False
        T, covariance, centre_mm = last.T_target_source, last.covariance, last.centre_mm
        if T is None or covariance is None or centre_mm is None:  # as of methods that predict no error
            return False
        least_mm = last.factor95 * precision.bound_mm(covariance, se3.apply(T, source), centre_mm)
        return self._lies_off(source, _together(before), T, target, least_mm)


def _of_many_places(method: Registrar | Tracker) -> Registrar | Tracker:
    """The method for sources of which no camera saw all; others are taken as they are."""
    if isinstance(method, Tracker):
        return method.sharing_points()
    return method.of_bone_alone() if isinstance(method, Registrar) else method


def _typical_distance_mm(T: Array, points: Array, target: PreparedTarget) -> float:
    """Median distance of (N, 3) points to the surface; what lies beyond its end is off it."""
    return float(np.median(distances_mm(T, points, target)))


def _together(sources: list[Array]) -> Array:
    return np.concatenate([np.empty((0, 3)), *sources])


def _is_among(source: Array, others: list[Array]) -> bool:
    return any(np.array_equal(source, other) for other in others)


def _was_sent(source: Array, before: list[Array]) -> bool:
    """True where one of those before is the same, in any order of its points."""
    new = fingerprint(source)
    return any(len(each) == len(source) and new.is_of_same(fingerprint(each)) for each in before)


def _refused(result: RegistrationResult, reason: str) -> RegistrationResult:
    """Of a bone that is no longer where all sources together have it: that their pose is right is not believed."""
    return replace(result.refused(RegistrationStatus.LOW_CONFIDENCE, reason), confidence=0.0)
