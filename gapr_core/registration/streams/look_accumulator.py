"""Registration of the last looks of a camera together: a wound from several places, in a frame in which it rests."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.clouds import finite_points
from gapr_core.errors import ConfigError
from gapr_core.geometry import se3
from gapr_core.registration.caveats import answering
from gapr_core.registration.checks.table import refuse
from gapr_core.registration.problem import inputs
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.registrar import Registrar, check_call
from gapr_core.registration.scenes.scene import HOW, MOST_PLACES, Look
from gapr_core.registration.streams.collection import MOST_OFF, Collection, together
from gapr_core.registration.streams.tracker import Tracker
from gapr_core.results import LookFit, RegistrationResult, RegistrationStatus
from gapr_core.runtime.clock import Clock
from gapr_core.runtime.parallel import single_threaded_libraries

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

STUCK = 10  # refusals in a row from one direction; the scene of the looks before may be gone


class Newest(Enum):
    """Verdicts of the newest look on the common pose."""

    AGREES = "alone it has the same pose"
    IS_UNCONFIRMED = "alone it has no pose, or there is no other"
    IS_DOUBTFUL = "the newest look alone gives no pose, and the one before showed the bone elsewhere"
    IS_REFUSED = "with the others it gives no pose"
    IS_TOO_SMALL = "the newest look has too few points for an image"
    SHOWS_NOTHING = (
        "the newest look shows nothing of the bone where the others have it: something is in the way, or it moved"
    )
    IS_APART = "it shows the bone elsewhere, or most others do"
    DIFFERS = "the newest look alone has another pose than all together: the bone moved, or its reference"
    CONTRADICTS = "the pose is another one than the last, in a frame in which the bone rests, and it is not sure"


STANDING = (Newest.AGREES, Newest.IS_UNCONFIRMED)  # verdicts under which the pose stands
ROW_OF = {Newest.IS_APART: "elsewhere", Newest.DIFFERS: "elsewhere", Newest.CONTRADICTS: "another pose"}
REFUSED_FOR = {
    Newest.DIFFERS: RegistrationStatus.AMBIGUOUS,
    Newest.CONTRADICTS: RegistrationStatus.AMBIGUOUS,
    Newest.SHOWS_NOTHING: RegistrationStatus.AMBIGUOUS,
    Newest.IS_DOUBTFUL: RegistrationStatus.AMBIGUOUS,
    Newest.IS_TOO_SMALL: RegistrationStatus.TOO_FEW_POINTS,
}


@dataclass(frozen=True, eq=False)
class KeptLook(Look):
    """A look of the collection."""

    # (2, 3) direction of the first of the looks that it replaced in turn; else its own. A camera that moves slowly
    # would else replace each look by the next one, and keep one alone
    first: Array


class LookAccumulator(Collection):
    """Registers each look of a camera together with those before it.

    A few images from places some ten degrees apart show more of the bone than one. All must be in one frame in which it
    rests, such as that of a reference fixed to it, and the camera's place must be known for each. A look replaces one
    from nearly the same direction, so those of a video do not push out all others. State the errors that all looks
    share, such as that of a hand-eye calibration, as `tracking_mm` of the sensor (`SensorConfig`).

    Older looks that show the bone elsewhere than the newest and most others are left out. The newest is refused where
    it does not fit the others, shows nothing of the bone there, or alone has another pose. So is an unsure pose that
    differs from the last. After three such in a row the bone or its reference has moved, and only these are kept. After
    ten refusals from one direction only the last look is kept.

    Args:
        method: registers the collected looks; a `Tracker` is copied to one whose sources count as one.
        most: number of looks to keep, the newest included; each costs time.
        apart_deg: least angle between the directions of two kept looks.

    Raises:
        ConfigError: `most` is no whole number from 1 to 16, `apart_deg` no angle from 0 to 90; a method that takes no
            viewpoint.
    """

    name = "gapr_looks"
    called = "look"

    def __init__(self, method: Registrar | Tracker, most: int = 4, apart_deg: float = 8.0) -> None:
        if not isinstance(most, int | np.integer) or not 1 <= most <= MOST_PLACES:
            how = "1 registers each by itself"
            raise ConfigError(f"a whole number of looks to keep, 1 to {MOST_PLACES}", repr(most), how)
        if not 0.0 <= apart_deg <= 90.0:
            raise ConfigError("an angle between looks, 0 to 90 deg", repr(apart_deg), "0 keeps all of them")
        if not isinstance(method, Registrar | Tracker):
            raise ConfigError("a Registrar or a Tracker", repr(method), "pass Registrar.from_pretrained()")
        super().__init__(method.sharing_points() if isinstance(method, Tracker) else method, most)
        self.apart_deg = apart_deg

    @property
    def collected(self) -> Array:
        """(N, 3) all kept points, mm."""
        return _together(self._looks)

    def together_with(self, source: ArrayLike, viewpoint: ArrayLike | None = None) -> Array:
        """Join the kept looks and this one as `register` would; (N, 3) mm. Arguments as `collect`."""
        newest = _look(source, viewpoint)
        return _together(self._with(newest)[1] if self._is_enough(newest) else self._looks)

    def reset(self) -> None:
        """Forget all looks, and the track of a `Tracker`."""
        self._looks: list[KeptLook] = []
        self._rows: dict[str, list[KeptLook]] = {}  # newest ones in a row with a verdict of `ROW_OF`
        self._refused_in_a_row: list[KeptLook] = []  # from nearly one direction, since a pose
        self._last: Array | None = None  # (4, 4) the last pose that was given
        super().reset()

    def collect(self, source: ArrayLike, viewpoint: ArrayLike | None = None) -> None:
        """Keep a look (N, 3), mm, and the place of its camera (3,), without registering; beyond `most` the oldest goes.

        A look of fewer points than a pose needs changes nothing. The third in a row that is metres away from the others
        restarts the collection.

        Raises:
            ConfigError: no viewpoint.
            InvalidPointCloudError: wrong shape or type, points that are metres apart, or metres away from the others.
        """
        newest = _look(source, viewpoint)
        if self._is_enough(newest):
            self._add(newest)

    @answering
    @single_threaded_libraries
    def register(
        self,
        source: ArrayLike,
        target: PreparedTarget,
        initial: ArrayLike | None = None,
        viewpoint: ArrayLike | None = None,
    ) -> RegistrationResult:
        """Register all kept looks, this one included, as `Registrar.register`.

        Another target than before starts a new collection. A look of fewer points than a pose needs is refused; one
        with which the others cannot be registered is not kept.

        Raises:
            ConfigError, InvalidPointCloudError: as `collect` and `Registrar.register`.
        """
        check_call(target, initial)
        look = _look(source, viewpoint)
        self._begin_with(target)
        if not self._is_enough(look):
            reason = f"the look has {len(look.points)} finite points, a pose needs {self.config.source.fewest_points}"
            return RegistrationResult(RegistrationStatus.TOO_FEW_POINTS, reason=reason, method=self.name)
        newest, before = self._add(look)
        try:
            result, asked = self._of_those_that_fit(target, initial)
        except Exception:
            self._looks = before
            raise
        clock = Clock()
        verdict = self._of_newest(result, asked, target)
        clock.lap("compare")
        answer = replace(result, method=self.name, stage_ms=_added(result.stage_ms, clock.stages))
        if verdict in REFUSED_FOR:  # the bone is no longer where the looks have it in common, for all that is known
            answer = answer.refused(refuse("newest look", 1.0, 0.0, REFUSED_FOR[verdict], verdict.value, ""))
        return replace(answer, reason=answer.reason + self._update_looks(verdict, answer, newest, before, asked))

    def _of_those_that_fit(
        self, target: PreparedTarget, initial: ArrayLike | None
    ) -> tuple[RegistrationResult, list[KeptLook]]:
        """Register the looks but older ones apart from the newest and most; returns the answer and these looks."""
        stage_ms: dict[str, float] = {}
        asked = self._looks
        while True:
            result = self.method.register(_together(asked), target, initial, asked)
            stage_ms = _added(stage_ms, result.stage_ms)
            apart = [look.fit is LookFit.APART for look in result.looks] or [False] * len(asked)
            if apart[-1] or not any(apart) or 2 * sum(apart) >= len(asked):
                return replace(result, stage_ms=stage_ms), asked
            asked = [look for look, is_apart in zip(asked, apart, strict=True) if not is_apart]

    def _of_newest(self, result: RegistrationResult, asked: list[KeptLook], target: PreparedTarget) -> Newest:
        """Judge the answer by the newest of the registered looks."""
        fits = [look.fit for look in result.looks] or [LookFit.FITS]
        may_be_there = result.status in (RegistrationStatus.OK, RegistrationStatus.AMBIGUOUS)
        if LookFit.APART in fits:
            return Newest.IS_APART
        if fits[-1] is LookFit.TOO_SMALL:
            return Newest.IS_TOO_SMALL
        if fits[-1] is LookFit.BLIND and may_be_there:
            return Newest.SHOWS_NOTHING
        T = result.T_target_source
        if T is None:
            return Newest.IS_REFUSED
        verdict = self._of_newest_alone(asked, T, target)
        is_sure = verdict is Newest.AGREES and result.confidence >= self.config.sure_from
        if verdict in STANDING and not is_sure and self._is_another(T):
            return Newest.CONTRADICTS
        return Newest.IS_DOUBTFUL if verdict is Newest.IS_UNCONFIRMED and "elsewhere" in self._rows else verdict

    def _is_another(self, T: Array) -> bool:
        """Return True where a pose (4, 4), mm, differs from the last one given since the collection began."""
        if self._last is None or self.most == 1:
            return False
        return not se3.pose_error(T, self._last, self.collected).is_right

    def _of_newest_alone(self, asked: list[KeptLook], T: Array, target: PreparedTarget) -> Newest:
        """Judge the common pose (4, 4), mm, by the newest look's alone; ones from its direction confirm nothing."""
        if len(asked) < 2:
            return Newest.IS_UNCONFIRMED if self.most > 1 else Newest.AGREES
        newest = asked[-1]
        registrar = self.method.registrar if isinstance(self.method, Tracker) else self.method
        alone = registrar.register(newest.points, target, T, newest.viewpoint)
        if alone.T_target_source is None:
            return Newest.IS_UNCONFIRMED
        if not se3.pose_error(alone.T_target_source, T, newest.points).is_right:
            return Newest.DIFFERS
        own = _direction(newest)
        is_from_elsewhere = any(_apart_deg(_direction(each), own) >= self.apart_deg for each in asked[:-1])
        return Newest.AGREES if is_from_elsewhere else Newest.IS_UNCONFIRMED

    def _update_looks(
        self,
        verdict: Newest,
        result: RegistrationResult,
        newest: KeptLook,
        before: list[KeptLook],
        asked: list[KeptLook],
    ) -> str:
        """Decide which looks stay after an answer; returns a text to add to the reason.

        Args:
            verdict: of the newest look; a pose that stands ends all counts.
            result: the answer.
            newest: the look, already kept.
            before: the looks before it.
            asked: looks of the common pose, itself included.
        """
        if verdict in STANDING:
            if len(asked) < len(self._looks):
                log.warning("%d older looks show the bone elsewhere: left out", len(self._looks) - len(asked))
            self._looks, self._rows, self._refused_in_a_row = asked, {}, []
            self._last = self._last if result.T_target_source is None else result.T_target_source.copy()
            return ""
        if verdict in ROW_OF:
            row = self._rows.setdefault(ROW_OF[verdict], [])
            row.append(newest)
            if len(row) == MOST_OFF:
                self._restart_with(row)
                return f"; {len(row)} in a row: the collection restarts with them"
            self._looks = before
            return "; left out"
        if verdict is not Newest.IS_REFUSED:
            self._looks = before
        if self._is_stuck(newest) and self._looks and self._looks != [newest]:
            self._restart_with([newest])
            return f"; {STUCK} refusals in a row: the collection restarts with the last look"
        return "" if verdict is Newest.IS_REFUSED else "; left out"

    def _is_stuck(self, newest: KeptLook) -> bool:
        """Count a refusal; true with the last of `STUCK` from nearly the direction of the first of them."""
        row = self._refused_in_a_row
        if row and _apart_deg(_direction(row[0]), _direction(newest)) >= self.apart_deg:
            row = []
        self._refused_in_a_row = [*row, newest]
        return len(self._refused_in_a_row) >= STUCK

    def _restart_with(self, looks: list[KeptLook]) -> None:
        log.warning("the collection of looks restarts with the last %d", len(looks))
        self.reset()
        self._looks = looks[-self.most :]

    def _is_enough(self, look: Look) -> bool:
        """Return True where a look has enough points for a pose."""
        return len(look.points) >= self.config.source.fewest_points

    def _add(self, look: Look) -> tuple[KeptLook, list[KeptLook]]:
        """Keep a look, and return it and those before it; none where the collection restarts with it."""
        self._unless_far(look.points)
        before = self._looks
        newest, self._looks = self._with(look)
        return newest, before

    def _with(self, look: Look) -> tuple[KeptLook, list[KeptLook]]:
        """Add a look to those kept, in place of a near one; returns it, and all with itself the last."""
        own, others = _direction(look), list(self._looks)
        apart_deg = [_apart_deg(each.first, own) for each in others]
        is_near = bool(others) and min(apart_deg) < self.apart_deg
        first = others.pop(int(np.argmin(apart_deg))).first if is_near else own
        newest = KeptLook(look.points, look.viewpoint, first)
        return newest, [*others, newest][-self.most :]


def _look(source: ArrayLike, viewpoint: ArrayLike | None) -> Look:
    if viewpoint is None:
        raise ConfigError("where the camera was for each look", "none", HOW)
    return Look(finite_points(source), inputs.numbers(viewpoint, (3,), "viewpoint", HOW))


def _added(stage_ms: Mapping[str, float], more_ms: Mapping[str, float]) -> dict[str, float]:
    """Add the times of further stages, ms, to those of stages."""
    return {stage: stage_ms.get(stage, 0.0) + more_ms.get(stage, 0.0) for stage in [*stage_ms, *more_ms]}


def _together(looks: Sequence[Look]) -> Array:
    return together([look.points for look in looks])


def _direction(look: Look) -> Array:
    """Stack the camera's place and the middle of the points, (2, 3), mm."""
    return np.stack([look.viewpoint, look.points.mean(axis=0)])


def _apart_deg(first: Array, second: Array) -> float:
    """Measure the larger angle between two directions: of the cameras, seen from the views' middle, and vice versa."""
    cameras, shown = np.stack([first, second], axis=1)
    return max(_angle_deg(cameras - shown.mean(axis=0)), _angle_deg(shown - cameras.mean(axis=0)))


def _angle_deg(pair: Array) -> float:
    """Measure the angle between two directions (2, 3) of any length."""
    a, b = pair / np.maximum(np.linalg.norm(pair, axis=1, keepdims=True), 1e-9)
    return float(np.degrees(np.arccos(np.clip(a @ b, -1.0, 1.0))))
