"""The last looks of a camera registered together: a wound seen from several places, in a frame in which it rests."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.clouds import finite_points
from gapr_core.errors import ConfigError
from gapr_core.geometry import se3
from gapr_core.registration import inputs
from gapr_core.registration.looks import HOW, MOST_PLACES, Look
from gapr_core.registration.registrar import Registrar, check_call
from gapr_core.registration.target import PreparedTarget
from gapr_core.registration.tracking import Tracker
from gapr_core.results import RegistrationResult, RegistrationStatus
from gapr_core.runtime.parallel import single_threaded_libraries
from gapr_core.surface import Surface

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

STUCK = 10  # refusals in a row from one direction; what the looks before show may be gone
NOT_SEEN = "the newest look shows nothing of the bone where the others have it: something is in the way, or it moved"
DIFFERS = "the newest look alone has another pose than all together: the bone moved, or its reference"
APART_MM = 1e-6  # between the places of two looks, so that those of a camera at rest stay two


class LookAccumulator:
    """Registers each look of a camera together with those before it.

    A single image of a wound shows little of the bone, with one set of errors. A few from places some ten degrees apart
    show more of it and of what hid it. All must be in one frame in which the bone rests, such as that of a reference
    fixed to it, and the camera's place must be known for each. A look takes the place of one from nearly the same
    direction, so that those of a video do not push out all others. A look that does not fit the others (`looks_apart`)
    is left out, and refused if it is the newest; so is a newest one that alone has another pose. After three of them in
    a row the bone or its reference has moved, and only these three are kept, whatever their directions; after `STUCK`
    refusals without a look from elsewhere, or looks that show nothing, the last one alone.

    Args:
        method: registers what is collected; of a `Tracker`, which stays as it is, one whose sources count as one.
        most: how many looks are kept, the newest among them; each costs time.
        apart_deg: between the directions of two looks that are kept.

    Raises:
        ConfigError: `most` is no whole number from 1 to 16, `apart_deg` no angle from 0 to 90; a method that takes no
            viewpoint.
    """

    name = "gapr_looks"

    def __init__(self, method: Registrar | Tracker, most: int = 4, apart_deg: float = 8.0) -> None:
        if not isinstance(most, int | np.integer) or not 1 <= most <= MOST_PLACES:
            how = "1 registers each by itself"
            raise ConfigError(f"a whole number of looks to keep, 1 to {MOST_PLACES}", repr(most), how)
        if not 0.0 <= apart_deg <= 90.0:
            raise ConfigError("an angle between looks, 0 to 90 deg", repr(apart_deg), "0 keeps all of them")
        if not isinstance(method, Registrar | Tracker):
            raise ConfigError("a Registrar or a Tracker", repr(method), "pass Registrar.from_pretrained()")
        self.method = method.sharing_points() if isinstance(method, Tracker) else method
        self.most, self.apart_deg, self.config = most, apart_deg, method.config
        self._target: PreparedTarget | None = None
        self.reset()

    @property
    def collected(self) -> Array:
        """(N, 3) all points that are kept, mm."""
        return _together(self._looks)

    def together_with(self, source: ArrayLike) -> Array:
        """(N, 3) mm, what `register` would register with a source (n, 3) from a new place: those kept, and itself."""
        newest = Look(np.asarray(source, dtype=np.float64), np.zeros(3))
        return _together([*self._looks, newest][-self.most :])

    def reset(self) -> None:
        """Forget all looks, and the track of a `Tracker`."""
        self._looks: list[Look] = []
        self._apart_in_a_row: list[Look] = []  # newest ones that did not fit those before
        self._refused_in_a_row = 0  # since a pose, or a look from another direction
        if isinstance(self.method, Tracker):
            self.method.reset()

    def collect(self, source: ArrayLike, viewpoint: ArrayLike | None = None) -> None:
        """Keep a look (N, 3), mm, and where its camera was (3,), without registering.

        It takes the place of those from nearly the same direction; beyond `most` the oldest goes. An empty look changes
        nothing.

        Raises:
            ConfigError: no viewpoint.
            InvalidPointCloudError: wrong shape or type.
        """
        if viewpoint is None:
            raise ConfigError("where the camera was for each look", "none", HOW)
        look = Look(finite_points(source), inputs.numbers(viewpoint, (3,), "viewpoint", HOW))
        if not len(look.points):
            return
        others = [each for each in self._looks if _apart_deg(each, look) >= self.apart_deg]
        if len(others) == len(self._looks):
            self._refused_in_a_row = 0
        self._looks = [*others, look][-self.most :]

    def prepare(self, target: str | Path | ArrayLike | Surface, units: str = "mm") -> PreparedTarget:
        """Everything static about a target; see `Registrar.prepare`."""
        return self.method.prepare(target, units)

    @single_threaded_libraries
    def register(
        self,
        source: ArrayLike,
        target: PreparedTarget,
        initial: ArrayLike | None = None,
        viewpoint: ArrayLike | None = None,
    ) -> RegistrationResult:
        """As `Registrar.register`, of all looks that are kept, this one included.

        Another target than before starts a new collection. A look without a finite point is refused: those before say
        nothing about it. A look with which the others cannot be registered is not kept.

        Raises:
            ConfigError, InvalidPointCloudError: as `collect` and `Registrar.register`.
        """
        check_call(target, initial)
        if self._target is not None and self._target is not target:
            self.reset()
        self._target = target
        if not len(finite_points(source)):
            return RegistrationResult(RegistrationStatus.TOO_FEW_POINTS, reason="the look has no finite point")
        before = self._looks
        self.collect(source, viewpoint)
        places = self._places()
        of_points = np.repeat(places, [len(look.points) for look in self._looks], axis=0)
        try:
            result = replace(self.method.register(self.collected, target, initial, of_points), method=self.name)
        except Exception:
            self._looks = before
            raise
        apart = np.zeros(len(places), dtype=bool)
        if result.looks_apart is not None:
            apart = (places[:, None] == result.looks_apart).all(axis=2).any(axis=1)
        if result.ok:
            return self._unless_newest_differs(result, target, before, is_blind=bool(apart[-1]))
        if apart[-1]:
            return self._refused(result, result.reason + self._leave_out_newest(before))
        self._apart_in_a_row = []
        if apart.any():
            self._looks = [look for look, off in zip(self._looks, apart, strict=True) if not off]
            return replace(result, reason=f"{result.reason}; left out from now on")
        return replace(result, reason=result.reason + self._count_refusal())

    def _unless_newest_differs(
        self, result: RegistrationResult, target: PreparedTarget, before: list[Look], is_blind: bool
    ) -> RegistrationResult:
        """The pose of all looks; refused where the newest shows nothing of the bone there, or alone another pose."""
        if is_blind:
            reason = NOT_SEEN + self._count_refusal()
            if self._refused_in_a_row:  # else it is the only one that is left
                self._looks = before
            return self._refused(result, reason)
        if self._differs(self._looks[-1], result, target):
            return self._refused(result, DIFFERS + self._leave_out_newest(before))
        self._apart_in_a_row, self._refused_in_a_row = [], 0
        return result

    def _differs(self, newest: Look, result: RegistrationResult, target: PreparedTarget) -> bool:
        """True where the newest look alone has a pose that is not right if that of all is."""
        if len(self._looks) < 2:
            return False
        registrar = self.method.registrar if isinstance(self.method, Tracker) else self.method
        alone = registrar.register(newest.points, target, result.T_target_source, newest.viewpoint)
        if alone.T_target_source is None or result.T_target_source is None:
            return False
        return not se3.pose_error(alone.T_target_source, result.T_target_source, newest.points).is_right

    def _refused(self, result: RegistrationResult, reason: str) -> RegistrationResult:
        """Of a bone that is no longer where the looks have it in common, for all that is known."""
        refused = result.refused(RegistrationStatus.AMBIGUOUS, reason)
        return replace(refused, confidence=min(result.confidence, self.config.rules.ruled_out))

    def _places(self) -> Array:
        """(K, 3) mm, where the camera was for each look; no two are the same."""
        places = np.reshape([look.viewpoint for look in self._looks], (-1, 3))
        return places + APART_MM * np.outer(np.arange(len(places)), np.eye(3)[0])

    def _count_refusal(self) -> str:
        """Keep the last look alone where the camera rests and nothing is found. Returns what is said of it."""
        self._refused_in_a_row += 1
        if self._refused_in_a_row < STUCK or len(self._looks) < 2:
            return ""
        last = self._looks[-1:]
        self.reset()
        self._looks = last
        return f"; {STUCK} refusals in a row: the collection restarts with the last look"

    def _leave_out_newest(self, before: list[Look]) -> str:
        """Go back to the looks before; with the last of `most_off` in a row, to those. Returns what is said of it."""
        self._apart_in_a_row = [*self._apart_in_a_row, self._looks[-1]]
        if len(self._apart_in_a_row) < self.config.accumulation.most_off:
            self._looks = before
            return "; left out"
        moved = self._apart_in_a_row
        log.warning("%d looks in a row do not fit those before: the collection restarts with them", len(moved))
        self.reset()
        self._looks = moved[-self.most :]
        return f"; {len(moved)} in a row: the collection restarts with them"


def _together(looks: list[Look]) -> Array:
    return np.concatenate([np.empty((0, 3)), *(look.points for look in looks)])


def _apart_deg(first: Look, second: Look) -> float:
    """Angle between the directions in which the cameras of two looks are, each from the middle of what it saw."""
    ahead = [look.viewpoint - look.points.mean(axis=0) for look in (first, second)]
    a, b = (each / max(float(np.linalg.norm(each)), 1e-9) for each in ahead)
    return float(np.degrees(np.arccos(np.clip(a @ b, -1.0, 1.0))))
