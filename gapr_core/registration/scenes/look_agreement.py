"""Do the looks of a camera show the bone in one place? It or its reference may move between two of them.

The pose that all looks have in common then fits only some of them, or none exactly. So each look is laid on the bone by
itself, from that pose. Where far more of the surface lies on it elsewhere, where it looked through the bone here, or
agrees far less than the others, it may be apart. A look with an error of its own seems so, too: it is registered in
full, and fits where its own pose is accepted and nearly the same. A look that could not have shown the bone here is
blind: something was in the way, or the bone is far.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gapr_core.config import RegistrarConfig
from gapr_core.geometry import se3
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.fit import kernels
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.scenes import clutter
from gapr_core.registration.scenes.scene import Scene
from gapr_core.results import LookAnswer, LookFit, Refusal, RegistrationStatus

Array = NDArray[np.float64]
Alone = Callable[[Scene], Assessment | None]  # registers one look in full

# All chosen on scenes of train subjects, looks at rest and moved.
GAINED, AWAY_MM = 0.25, 2.0  # share of what a look could show that lies on it only in its own pose, and how far that is
SEEN_THROUGH = 0.15  # share in front of what it measured
LEAST_NEAR, LEAST_ON = 0.5, 0.3  # of the share of the best look: what lies near what a look shows, and on it
LEAST_COMPARED = 0.1  # of what the look with the widest view could show
SAME_POSE_MM, SAME_POSE_DEG = 3.0, 3.0  # to the pose of a look that is registered by itself
REACH_MM = 10.0  # around the bone: what is laid on it from the common pose
LIMITS_MM = (8.0, 2.0, 8)  # Tukey's, the first, the last and how many steps
FEWEST_POINTS, MOST_POINTS = 40, 600  # of a look, that are laid on it


class LookShares(NamedTuple):
    """What one look says by itself, as shares of the target's surface.

    Attributes:
        compared: it could show under the common pose.
        on: lies on what it shows, at the scale of the noise (`clutter.on_mm`).
        near: lies near it (`clutter.middle_on_mm`).
        seen_through: lies in front of what it measured.
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


def unless_apart(
    assessment: Assessment, scene: Scene, target: PreparedTarget, alone: Alone, config: RegistrarConfig
) -> Assessment:
    """The same with what each look of its scene says of it; refused where one is apart, or half of them are blind.

    Args:
        assessment: the pose that all looks have in common.
        scene: what was seen from one place or from several.
        target: the bone.
        alone: registers one of the looks in full; asked of each that seems to be apart.
        config: limits of the registration, and what an accepted pose has to reach.
    """
    if len(scene.given) < 2:
        return assessment
    fits = [LookFit.TOO_SMALL] * len(scene.given)
    found = _fits(assessment, scene, target, alone, config)
    for name, fit in zip(scene.names, found, strict=True):
        fits[name] = fit
    answers = tuple(map(LookAnswer, scene.given, fits))
    do_not_fit = LookFit.APART in found or 2 * found.count(LookFit.BLIND) >= len(found)
    refusal = _refusal(answers) if do_not_fit else None
    return replace(assessment, looks=answers).with_refusal(refusal, config.rules)


def is_refused(assessment: Assessment) -> bool:
    """True where a scene was refused for its looks."""
    refusal = assessment.refusal
    not_fitting = any(look.fit in (LookFit.APART, LookFit.BLIND) for look in assessment.looks)
    return not_fitting and refusal is not None and refusal.status is RegistrationStatus.AMBIGUOUS


def _fits(
    assessment: Assessment, scene: Scene, target: PreparedTarget, alone: Alone, config: RegistrarConfig
) -> list[LookFit]:
    """How each of the K looks fits; a pose that is refused anyway says nothing about them."""
    if not assessment.reaches(config.worth_checking):
        return [LookFit.NOT_ASKED] * len(scene.images)
    found = look_fits(assessment.fit.T, scene, target, config)
    for number, fit in enumerate(found):
        if fit is LookFit.APART and _has_same_pose(alone(scene.each[number]), assessment, config):
            found[number] = LookFit.FITS
    return found


def _has_same_pose(own: Assessment | None, common: Assessment, config: RegistrarConfig) -> bool:
    """True where a look by itself has an accepted pose, nearly the one that all have in common."""
    if own is None or not own.reaches(config.min_confidence):
        return False
    shift_mm, turn_deg = se3.pose_error(own.fit.T, common.fit.T, own.source.points)
    return shift_mm <= SAME_POSE_MM and turn_deg <= SAME_POSE_DEG


def look_fits(T: Array, scene: Scene, target: PreparedTarget, config: RegistrarConfig) -> list[LookFit]:
    """How each of the K looks of a scene fits the pose (4, 4) that they have in common; a single one does."""
    if len(scene.images) == 1:
        return [LookFit.FITS]
    signed, _, aside, _ = kernels.residuals_at(T, scene.source.points, *target.kernel_view, 0.0)
    close = np.hypot(np.nan_to_num(signed, nan=np.inf), aside) < REACH_MM
    found = [_shares_of_look(T, number, close, scene, target, config) for number in range(len(scene.images))]
    widest = max(each.compared for each in found)
    blind = np.array([each.compared < LEAST_COMPARED * widest and not each.fits_elsewhere for each in found])
    seeing = [each for each, is_blind in zip(found, blind, strict=True) if not is_blind]
    near = max(each.share(each.near) for each in seeing)
    on = max(each.share(each.on) for each in seeing)
    return [
        LookFit.BLIND if is_blind else LookFit.APART if is_apart(each, near, on) else LookFit.FITS
        for each, is_blind in zip(found, blind, strict=True)
    ]


def is_apart(look: LookShares, near: float, on: float) -> bool:
    """True where a look fits far better elsewhere, saw through the bone, or agrees far less than the best one does.

    Args:
        look: what it says.
        near, on: the largest shares of all looks that are not blind.
    """
    disagrees = look.share(look.near) < LEAST_NEAR * near or look.share(look.on) < LEAST_ON * on
    return look.fits_elsewhere or look.share(look.seen_through) > SEEN_THROUGH or disagrees


def _refusal(answers: tuple[LookAnswer, ...]) -> Refusal:
    places = [look.viewpoint for look in answers if look.fit in (LookFit.APART, LookFit.BLIND)]
    said = " and ".join(f"({x:.0f}, {y:.0f}, {z:.0f})" for x, y, z in places)
    why = f"what was seen from {said} mm shows the bone elsewhere than the looks have it in common, or not at all"
    how = "the bone moved, or its reference, or something was in the way"
    return Refusal(RegistrationStatus.AMBIGUOUS, f"{why}: {how}")


def _shares_of_look(
    T: Array, number: int, is_close: NDArray[np.bool_], scene: Scene, target: PreparedTarget, config: RegistrarConfig
) -> LookShares:
    """Look `number` of a scene under the common pose (4, 4), and laid on the bone by its points (N,) close to it."""
    source, close = scene.source, np.flatnonzero((scene.look == number) & is_close)
    own, settings, threads = T, config.clutter, config.num_threads
    if len(close) >= FEWEST_POINTS:
        some = close[:: -(-len(close) // MOST_POINTS)]
        own = clutter.steps_on(target, LIMITS_MM, settings).refined(T[None], source, some)[0]
    points, normals = clutter.spread(target, settings.final_target_points)
    alone, poses = scene.each[number], np.stack([T, own])
    near, on = (
        alone.compare(poses, points, normals, on_mm, settings.front_mm, threads)
        for on_mm in (settings.middle_on_mm, settings.on_mm)
    )
    away_mm = se3.rms_apart_mm(own, T, source.points[close]) if len(close) else 0.0
    (compared, own_compared), (on_it, own_on) = near.compared.tolist(), on.explained.tolist()
    return LookShares(compared, on_it, float(near.explained[0]), float(on.violating[0]), own_compared, own_on, away_mm)
