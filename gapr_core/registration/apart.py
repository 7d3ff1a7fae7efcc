"""Do the looks of a camera show the bone in one place? It or its reference may move between two of them.

Then the pose that all looks have in common is that of some of them, or lies between. So each look is laid on the bone
by itself, from that pose. Where far more of the surface lies on it elsewhere, where it looked through the bone here, or
agrees far less than the others, it does not fit them. A look that could not have shown the bone here is blind:
something was in the way, or the bone is far.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gapr_core.config import ClutterConfig, RegistrarConfig
from gapr_core.geometry import se3
from gapr_core.registration import clutter, kernels
from gapr_core.registration.looks import Scene
from gapr_core.registration.target import PreparedTarget
from gapr_core.results import Refusal, RegistrationStatus

Array = NDArray[np.float64]

GAINED, AWAY_MM = 0.25, 2.0  # share of what a look could show that lies on it only in its own pose, and how far that is
SEEN_THROUGH = 0.15  # share that it would have hidden
LEAST_NEAR, LEAST_ON = 0.5, 0.3  # of the share of the best look: what lies near what a look shows, and on it
LEAST_COMPARED = 0.1  # of what the look with the widest view could show
REACH_MM, LIMITS_MM = 10.0, (8.0, 2.0, 8)  # around the bone, and Tukey's limits, where a look is laid on it
FEWEST_POINTS, MOST_POINTS = 40, 600  # of a look, that do so


class Own(NamedTuple):
    """What one look says by itself, as shares of the target's surface.

    Attributes:
        compared: it could show under the common pose.
        on: lies on what it shows, at the scale of the noise (`clutter.on_mm`).
        near: lies near it (`clutter.middle_on_mm`).
        seen_through: lies in front of it.
        own_compared, own_on: the first two under its own pose.
        away_mm: root mean square distance between the two poses, over its points near the bone.
    """

    compared: float
    on: float
    near: float
    seen_through: float
    own_compared: float
    own_on: float
    away_mm: float

    def share(self, of_surface: float) -> float:
        """Share of what it could show."""
        return of_surface / max(self.compared, 1e-6)

    @property
    def fits_elsewhere(self) -> bool:
        """True where far more lies on it in its own pose."""
        gained = (self.own_on - self.on) / max(self.compared, self.own_compared, 1e-6)
        return gained > GAINED and self.away_mm > AWAY_MM


class LookFits(NamedTuple):
    """Which of K looks do not fit the pose that all have in common.

    Attributes:
        apart: (K,) that show the bone elsewhere.
        blind: (K,) that show hardly anything where the bone is.
    """

    apart: NDArray[np.bool_]
    blind: NDArray[np.bool_]

    @property
    def is_refused(self) -> bool:
        """True where one look is apart, or half of them are blind."""
        return bool(self.apart.any() or 2 * self.blind.sum() >= len(self.blind))


def look_fits(T: Array, scene: Scene, target: PreparedTarget, config: RegistrarConfig) -> LookFits:
    """How the looks of a scene fit the pose (4, 4) that they have in common; a single one does."""
    if len(scene.images) == 1:
        return LookFits(np.zeros(1, dtype=bool), np.zeros(1, dtype=bool))
    signed, _, aside, _ = kernels.residuals_at(T, scene.source.points, *target.kernel_view, 0.0)
    close = np.hypot(np.nan_to_num(signed, nan=np.inf), aside) < REACH_MM
    found = [_own(T, number, close, scene, target, config.clutter) for number in range(len(scene.images))]
    widest = max(each.compared for each in found)
    blind = np.array([each.compared < LEAST_COMPARED * widest and not each.fits_elsewhere for each in found])
    seeing = [each for each, is_blind in zip(found, blind, strict=True) if not is_blind]
    near, on = (max(each.share(value) for each, value in zip(seeing, values, strict=True))
                for values in ([each.near for each in seeing], [each.on for each in seeing]))  # fmt: skip
    return LookFits(~blind & [is_apart(each, near, on) for each in found], blind)


def is_apart(look: Own, near: float, on: float) -> bool:
    """True where a look fits far better elsewhere, saw through the bone, or agrees far less than the best one does.

    Args:
        look: what it says.
        near, on: the largest shares of all looks that are not blind.
    """
    disagrees = look.share(look.near) < LEAST_NEAR * near or look.share(look.on) < LEAST_ON * on
    return look.fits_elsewhere or look.share(look.seen_through) > SEEN_THROUGH or disagrees


def refusal_of(places: Array) -> Refusal:
    """The refusal for looks from these places (K, 3), mm, that do not fit the others."""
    said = " and ".join(f"({x:.0f}, {y:.0f}, {z:.0f})" for x, y, z in places)
    why = f"what was seen from {said} mm shows the bone elsewhere than the looks have it in common, or not at all"
    how = "the bone moved, or its reference, or something was in the way"
    return Refusal(RegistrationStatus.AMBIGUOUS, f"{why}: {how}")


def _own(
    T: Array, number: int, is_close: NDArray[np.bool_], scene: Scene, target: PreparedTarget, config: ClutterConfig
) -> Own:
    """Look `number` of a scene under the common pose (4, 4), and laid on the bone by its points (N,) close to it."""
    source, close = scene.source, np.flatnonzero((scene.look == number) & is_close)
    own = T
    if len(close) >= FEWEST_POINTS:
        some = close[:: -(-len(close) // MOST_POINTS)]
        own = clutter.steps_on(target, LIMITS_MM, config).refined(T[None], source, some)[0]
    points, normals = clutter.spread(target, config.final_target_points)
    alone, poses = scene.of(number), np.stack([T, own])
    near, on = (
        alone.compare(poses, points, normals, mm, config.front_mm) for mm in (config.middle_on_mm, config.on_mm)
    )
    away_mm = se3.rms_apart_mm(own, T, source.points[close]) if len(close) else 0.0
    (compared, own_compared), (on_it, own_on) = near.compared.tolist(), on.explained.tolist()
    return Own(compared, on_it, float(near.explained[0]), float(on.violating[0]), own_compared, own_on, away_mm)
