"""Do the looks of a camera show the bone in one place? It or its reference may move between two of them.

Then the pose that all looks have in common is that of some of them, or lies between. So each look is laid on the bone
by itself, from that pose. Where it explains far more of the surface elsewhere, or hardly any of it here, it does not
fit the others. A look that could not have shown the bone here is blind: something was in the way, or the bone is far.
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

GAINED, AWAY_MM = 0.35, 2.0  # share of what a look compares that it explains more, and how far from the common pose
LEAST_SHARE = 0.5  # of the share that the best look explains
LEAST_COMPARED = 0.1  # of what the look with the widest view compares
REACH_MM, LIMITS_MM = 10.0, (8.0, 2.0, 8)  # around the bone, and Tukey's limits, where a look is laid on it
FEWEST_POINTS, MOST_POINTS = 40, 600  # of a look, that do so


class Own(NamedTuple):
    """What one look says by itself.

    Attributes:
        compared: share of the target's surface that it could show under the common pose.
        explained: share of the surface that lies on what it shows.
        own_compared, own_explained: the same under its own pose.
        away_mm: root mean square distance between the two poses, over its points near the bone.
    """

    compared: float
    explained: float
    own_compared: float
    own_explained: float
    away_mm: float

    @property
    def agrees(self) -> float:
        """Share of what it could show that lies there."""
        return self.explained / max(self.compared, 1e-6)

    @property
    def gained(self) -> float:
        """Share of what it could show that it explains more under its own pose."""
        return (self.own_explained - self.explained) / max(self.compared, self.own_compared, 1e-6)


class Fits(NamedTuple):
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


def fits(T: Array, scene: Scene, target: PreparedTarget, config: RegistrarConfig) -> Fits:
    """How the looks of a scene fit the pose (4, 4) that they have in common; a single one does."""
    if len(scene.images) == 1:
        return Fits(np.zeros(1, dtype=bool), np.zeros(1, dtype=bool))
    found = [_own(T, number, scene, target, config.clutter) for number in range(len(scene.images))]
    widest, best = max(each.compared for each in found), max(each.agrees for each in found)
    blind = np.array([each.compared < LEAST_COMPARED * widest and not _moved(each) for each in found])
    return Fits(~blind & [is_apart(each, best) for each in found], blind)


def is_apart(look: Own, best: float) -> bool:
    """True where a look fits far better elsewhere, or agrees far less than the best one."""
    return _moved(look) or look.agrees < LEAST_SHARE * best


def _moved(look: Own) -> bool:
    return look.gained > GAINED and look.away_mm > AWAY_MM


def refusal_of(places: Array) -> Refusal:
    """The refusal for looks from these places (K, 3), mm, that do not fit the others."""
    said = " and ".join(f"({x:.0f}, {y:.0f}, {z:.0f})" for x, y, z in places)
    why = f"what was seen from {said} mm shows the bone elsewhere than the other looks, or not at all"
    how = "the bone moved, or its reference, or something was in the way"
    return Refusal(RegistrationStatus.AMBIGUOUS, f"{why}: {how}")


def _own(T: Array, number: int, scene: Scene, target: PreparedTarget, config: ClutterConfig) -> Own:
    """Look `number` of a scene under the common pose (4, 4), and laid on the bone by itself."""
    source = scene.source
    signed, _, aside, _ = kernels.residuals_at(T, source.points, *target.kernel_view, 0.0)
    near = np.flatnonzero((scene.look == number) & (np.hypot(np.nan_to_num(signed, nan=np.inf), aside) < REACH_MM))
    own = T
    if len(near) >= FEWEST_POINTS:
        some = near[:: max(1, len(near) // MOST_POINTS)]
        own = clutter.steps_on(target, LIMITS_MM, config).refined(T[None], source, some)[0]
    points, normals = clutter.spread(target, config.final_target_points)
    seen = scene.of(number).compare(np.stack([T, own]), points, normals, config.middle_on_mm, config.front_mm)
    (compared, own_compared), (explained, own_explained) = seen.compared.tolist(), seen.explained.tolist()
    away = se3.apply(own, source.points[near]) - se3.apply(T, source.points[near])
    away_mm = float(np.sqrt((away**2).sum(axis=1).mean())) if len(near) else 0.0
    return Own(compared, explained, own_compared, own_explained, away_mm)
