"""Registration of the last sources of a stream together: a probe's images, in a frame in which the bone rests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.clouds import finite_points
from gapr_core.errors import ConfigError
from gapr_core.geometry import sampling, se3
from gapr_core.geometry.twists import bound_mm, covariance_about, predicted_rmse_mm
from gapr_core.registration.caveats import answering
from gapr_core.registration.checks.conclude import by_threshold
from gapr_core.registration.checks.deformation import covariance_of_half, of_motion
from gapr_core.registration.checks.table import refuse
from gapr_core.registration.fit.refinement import distances_mm, refine_fully
from gapr_core.registration.problem.sensor import offset_surface
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.registrar import Registrar, check_call
from gapr_core.registration.streams.collection import MOST_OFF, Collection, together
from gapr_core.registration.streams.evidence import fingerprint, is_repeated
from gapr_core.registration.streams.tracker import Tracker
from gapr_core.results import Finding, RegistrationResult, RegistrationStatus
from gapr_core.runtime.parallel import single_threaded_libraries

Array = NDArray[np.float64]

OFF = 2.5  # distance off the bone of a discarded source, over that of all together
FEWEST_POINTS = 20  # of a source checked by itself; a smaller one is checked with those before it
MOST_POINTS = 6000  # kept of one source, and compared with
POSED = (RegistrationStatus.OK, RegistrationStatus.AMBIGUOUS)  # statuses whose pose fits the sources
FEWEST_IN_TIME = 6  # least sources for a refusal by motion
FEWEST_THAT_MAY = 3  # least sources for a wider bound by motion
MAY_MOVE, MOVES = 1.0, 6.0  # least log likelihood ratios of a possible and of a certain motion


class Accumulator(Collection):
    """Registers each source together with those before it.

    All sources must be in one frame in which the bone rests, such as that of a reference fixed to it. A source off the
    bone under this or the last accepted pose is left out, and the answer refused if it is the newest. After three in a
    row the bone or its reference has moved, and only these are kept. Where all show that the bone moves (see
    `of_motion`), the answer is refused, and those since a step or the last third are kept.

    Args:
        method: registers the collected sources; a `Tracker` is not changed but copied to one whose sources count as one
            (`Tracker.sharing_points`).
        most: number of sources to keep, the newest included.

    Raises:
        ConfigError: `most` is no whole number, or less than 1; a method that cannot register.
    """

    name = "gapr_accumulator"

    def __init__(self, method: Registrar | Tracker, most: int) -> None:
        if not isinstance(most, int | np.integer) or most < 1:
            raise ConfigError("a whole number of sources to keep, at least 1", repr(most), "1 registers each by itself")
        if not (hasattr(method, "register") and hasattr(method, "config")):
            raise ConfigError("a Registrar or a Tracker", repr(method), "pass Registrar.from_pretrained()")
        if isinstance(method, Tracker):  # no single camera saw the sources
            method = method.sharing_points()
        super().__init__(method.of_bone_alone() if isinstance(method, Registrar) else method, most)

    @property
    def collected(self) -> Array:
        """(N, 3) all kept points, mm."""
        return together(self._kept + self._new)

    def together_with(self, source: ArrayLike) -> Array:
        """Join the last kept sources and a source (n, 3) as `register` would; (N, 3) mm."""
        return together([*self._kept, *self._new, np.asarray(source, dtype=np.float64)][-self.most :])

    def reset(self) -> None:
        """Forget all sources, and the track of a `Tracker`."""
        self._kept: list[Array] = []  # on the bone under an accepted pose, or from before there was one
        self._new: list[Array] = []  # since the last registration; several, where `collect` is called in between
        self._small: list[Array] = []  # the newest of few points, which are looked at together
        self._off_in_a_row: list[Array] = []  # off the bone under an accepted pose, and left out
        self._accepted: RegistrationResult | None = None  # the last answer that was
        super().reset()

    def collect(self, source: ArrayLike) -> None:
        """Keep a source (N, 3), mm, without registering; beyond `most` the oldest goes.

        An empty source, or a repeated one, changes nothing. The third in a row that is metres away from the others
        restarts the collection.

        Raises:
            InvalidPointCloudError: wrong shape or type, points that are metres apart, or metres away from the others.
        """
        points = finite_points(source)
        points = points[sampling.thin(points, MOST_POINTS)]
        if not len(points):
            return
        self._unless_far(points)
        new = fingerprint(points)
        if not any(is_repeated(fingerprint(each), new) for each in self._kept + self._new):
            self._new = [*self._new, points][-self.most :]

    @answering
    @single_threaded_libraries
    def register(
        self,
        source: ArrayLike,
        target: PreparedTarget,
        initial: ArrayLike | None = None,
        viewpoint: ArrayLike | None = None,
    ) -> RegistrationResult:
        """Register all collected sources, this one included, as `Registrar.register`.

        Another target than before starts a new collection. A source that cannot be registered is not kept; one without
        a finite point is refused.

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
        self._begin_with(target)
        if not len(points):
            return RegistrationResult(RegistrationStatus.TOO_FEW_POINTS, reason="the source has no finite point")
        kept, before = self._kept, self._new
        self.collect(source)
        try:
            result = self.method.register(together(self._registered_together()), target, initial)
        except Exception:
            self._new = before if self._kept is kept else []  # or the collection restarted with this source
            raise
        answer = self._decide_on_new(replace(result, method=self.name), target)
        self._accepted = answer if answer.ok else self._accepted
        return answer

    def _registered_together(self) -> list[Array]:
        """Return the sources that are registered as one, the newest last."""
        return (self._kept + self._new)[-self.most :]

    def _decide_on_new(self, result: RegistrationResult, target: PreparedTarget) -> RegistrationResult:
        """Keep the new sources that lie on the bone under the answer's pose, without a pose all; refuse for others."""
        T = result.best if result.status in POSED else None
        if T is None:  # no evidence on any source, nor on a row of those off the bone
            for source in self._new:
                self._join_small_ones(source)
            self._kept, self._new = self._registered_together(), []
            return result
        new, off = self._new, self._update_row_off_the_bone(T, target)
        self._kept = [source for source in self._kept + new if not _is_among(source, off)][-self.most :]
        self._new = []
        if len(moved := self._off_in_a_row) >= MOST_OFF:
            self.reset()
            self._kept = moved[-self.most :]
            why = f"{len(moved)} sources in a row lie off the bone: it has moved, and the collection restarts"
            return result.refused(_off_the_bone(moved, why))
        if new and self._off_in_a_row:
            newest = "newest source lies" if _is_among(new[-1], off) else "sources before lie"
            why = f"the {newest} off the bone where the others found it: left out"
            return result.refused(_off_the_bone(moved, why))
        return self._unless_it_moves(result, T, target)

    def _unless_it_moves(self, result: RegistrationResult, T: Array, target: PreparedTarget) -> RegistrationResult:
        """Refuse where the sources show that the bone moves; widen the covariance where they hardly exclude it."""
        kept = self._kept
        if len(kept) < FEWEST_THAT_MAY:
            return result
        order = np.repeat(np.arange(len(kept)), list(map(len, kept)))
        some = slice(None, None, 1 + len(order) // MOST_POINTS)
        points, seen = np.ascontiguousarray(together(kept)[some]), offset_surface(target, self.config.sensor)
        fit = refine_fully(T, points, seen, self.config.refinement)
        motion, rests_from = of_motion(fit, order[some])
        if motion.log_ratio <= MAY_MOVE:
            return result
        if motion.log_ratio <= MOVES or len(kept) < FEWEST_IN_TIME:
            added = covariance_of_half(fit, motion.size_mm)
            return self._widened(result, added, fit.moved.mean(axis=0), target)
        self.reset()
        self._kept = kept[-(len(kept) // 3) :] if rests_from is None else kept[rests_from:]
        why = "the bone moves against the frame of the sources while they are collected: only the last are kept"
        advice = "look at what is fixed to the bone"
        status = RegistrationStatus.LOW_CONFIDENCE
        return result.refused(refuse("bone moves", motion.log_ratio, MOVES, status, why, advice))

    def _widened(
        self, result: RegistrationResult, added: Array, about_mm: Array, target: PreparedTarget
    ) -> RegistrationResult:
        """Add a covariance (6, 6) about a centre (3,), mm, to an answer; refuse too large a bound."""
        if result.covariance is None or result.centre_mm is None:  # as of methods that predict no error
            return result
        covariance = result.covariance + covariance_about(result.centre_mm - about_mm, added)
        tre_mm = predicted_rmse_mm(covariance, target.points, result.centre_mm)
        tre95_mm = result.factor95 * bound_mm(covariance, target.points, result.centre_mm)
        refusal = by_threshold(result.confidence, result.confidence, tre95_mm, self.config)
        if refusal is not None:
            return result.refused(refusal)
        return replace(result, covariance=covariance, tre_mm=tre_mm, tre95_mm=tre95_mm)

    def _update_row_off_the_bone(self, T: Array, target: PreparedTarget) -> list[Array]:
        """Find the sources off the bone under a pose (4, 4), mm, and update their row."""
        everything, seen = together(self._registered_together()), offset_surface(target, self.config.sensor)
        off: list[Array] = []
        for source in self._new:
            judged = self._join_small_ones(source)
            points = together(judged)
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
        """Add a source (N, 3); returns it to judge, a small one with those before it; [] for too few points."""
        if len(source) >= FEWEST_POINTS:
            self._small = []
            return [source]
        self._small = [*self._small, source]
        while sum(map(len, self._small[1:])) >= FEWEST_POINTS:
            self._small = self._small[1:]
        return self._small if sum(map(len, self._small)) >= FEWEST_POINTS else []

    def _lies_off(self, source: Array, points: Array, T: Array, target: PreparedTarget, least_mm: float = 0.0) -> bool:
        """Return True where the median distance of a source (N, 3) is far above that of all points, and `least_mm`."""
        refinement = self.config.refinement
        some = np.ascontiguousarray(points[:: 1 + len(points) // MOST_POINTS])
        own, of_all = (_typical_distance_mm(T, each, target) for each in (source, some))
        return own > max(least_mm, OFF * max(of_all, refinement.smallest_sigma_mm))

    def _contradicts(self, source: Array, target: PreparedTarget) -> bool:
        """Return True where a source (N, 3) lies off the bone under the last accepted pose."""
        before, last = self._registered_together()[: -len(self._new)], self._accepted
        if not before or last is None:
            return False
        T, covariance, centre_mm = last.T_target_source, last.covariance, last.centre_mm
        if T is None or covariance is None or centre_mm is None:  # as of methods that predict no error
            return False
        least_mm = last.factor95 * bound_mm(covariance, se3.apply(T, source), centre_mm)
        return self._lies_off(source, together(before), T, target, least_mm)


def _typical_distance_mm(T: Array, points: Array, target: PreparedTarget) -> float:
    """Compute the median distance of (N, 3) points to the surface; points past its edge are off it."""
    return float(np.median(distances_mm(T, points, target)))


def _off_the_bone(row: list[Array], text: str) -> Finding:
    """Refuse for a row of sources off the bone."""
    return refuse("off the bone", len(row), 0.0, RegistrationStatus.LOW_CONFIDENCE, text, "")


def _is_among(source: Array, others: list[Array]) -> bool:
    return any(np.array_equal(source, other) for other in others)
