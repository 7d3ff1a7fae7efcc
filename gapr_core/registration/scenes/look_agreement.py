"""Agreement of the looks of a camera: the bone or its reference may move between two of them.

Each look is laid on the bone by itself, from the common pose. It is apart where far more of the surface lies on it
elsewhere, where it looked through the bone, or where it agrees far less than the others. One that seems apart is
registered in full, and fits where its own pose is accepted and nearly the same. A look that could not have shown the
bone is blind.
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
from gapr_core.registration.fit.refinement import distances_mm
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.scenes import clutter
from gapr_core.registration.scenes.scene import Scene
from gapr_core.results import Effect, Finding, LookAnswer, LookFit, RegistrationStatus

Array = NDArray[np.float64]
Alone = Callable[[Scene], Assessment | None]  # registers one look in full

CHECK = "looks apart"
# All limits were chosen on scenes of train subjects, looks at rest and moved.
GAINED, AWAY_MM = 0.25, 2.0  # least share of a look's view that only its own pose explains, and distance of that pose
SEEN_THROUGH = 0.15  # largest share in front of the measured surface
LEAST_NEAR, LEAST_ON = 0.5, 0.3  # least shares near the measured surface and on it, over those of the best look
LEAST_COMPARED = 0.1  # least compared share, over that of the look with the widest view
SAME_POSE_MM, SAME_POSE_DEG = 3.0, 3.0  # between the common pose and that of a look registered by itself
REACH_MM = 10.0  # distance from the bone of the points that are laid on it from the common pose
LIMITS_MM = (8.0, 2.0, 8)  # Tukey scales: the first, the last, the number of steps
FEWEST_POINTS, MOST_POINTS = 40, 600  # points of a look that are laid on the bone


class LookShares(NamedTuple):
    """Agreement of one look by itself, as shares of the target's surface."""

    compared: float  # share visible to it under the common pose
    on: float  # share on its measured surface, at the scale of the noise (`clutter.on_mm`)
    near: float  # share near that surface (`clutter.middle_on_mm`)
    seen_through: float  # share in front of that surface
    own_compared: float  # as `compared`, under its own pose
    own_on: float  # as `on`, under its own pose
    away_mm: float  # root mean square distance between the two poses, over its points near the bone

    def share(self, of_surface: float) -> float:
        """Divide a share of the surface by the compared one."""
        return of_surface / max(self.compared, 1e-6)

    @property
    def fits_elsewhere(self) -> bool:
        """True where far more of the surface lies on it in its own pose."""
        gained = (self.own_on - self.on) / max(self.compared, self.own_compared, 1e-6)
        return gained > GAINED and self.away_mm > AWAY_MM


def unless_apart(
    assessment: Assessment, scene: Scene, target: PreparedTarget, alone: Alone, config: RegistrarConfig
) -> Assessment:
    """Add the fit of each look of a scene; refuse where one is apart, or half of them are blind.

    Args:
        assessment: the common pose of all looks.
        scene: views from one place or from several.
        target: the bone.
        alone: registers a look in full that seems to be apart.
        config: settings of the registration.
    """
    if len(scene.given) < 2:
        return assessment
    fits = [LookFit.TOO_SMALL] * len(scene.given)
    own_fits = _fits(assessment, scene, target, alone, config)
    for name, fit in zip(scene.names, own_fits, strict=True):
        fits[name] = fit
    answers = tuple(map(LookAnswer, scene.given, fits))
    do_not_fit = LookFit.APART in own_fits or 2 * own_fits.count(LookFit.BLIND) >= len(own_fits)
    answered = replace(assessment, looks=answers)
    return answered.with_finding(_apart(answers)) if do_not_fit else answered


def _fits(
    assessment: Assessment, scene: Scene, target: PreparedTarget, alone: Alone, config: RegistrarConfig
) -> list[LookFit]:
    """Judge the fit of each of the K looks; not asked where the pose is refused anyway."""
    if not assessment.reaches(config.worth_checking):
        return [LookFit.NOT_ASKED] * len(scene.images)
    fits = look_fits(assessment.fit.T, scene, target, config)
    for number, fit in enumerate(fits):
        if fit is LookFit.APART and _has_same_pose(alone(scene.each[number]), assessment, config):
            fits[number] = LookFit.FITS
    return fits


def _has_same_pose(own: Assessment | None, common: Assessment, config: RegistrarConfig) -> bool:
    """Return True where a look by itself has an accepted pose, nearly the common one."""
    if own is None or not own.reaches(config.min_confidence):
        return False
    shift_mm, turn_deg = se3.pose_error(own.fit.T, common.fit.T, own.source.points)
    return shift_mm <= SAME_POSE_MM and turn_deg <= SAME_POSE_DEG


def look_fits(T: Array, scene: Scene, target: PreparedTarget, config: RegistrarConfig) -> list[LookFit]:
    """Judge the fit of each of K looks to their common pose (4, 4); a single look fits."""
    if len(scene.images) == 1:
        return [LookFit.FITS]
    close = distances_mm(T, scene.source.points, target) < REACH_MM
    shares = [_shares_of_look(T, number, close, scene, target, config) for number in range(len(scene.images))]
    widest = max(each.compared for each in shares)
    blind = np.array([each.compared < LEAST_COMPARED * widest and not each.fits_elsewhere for each in shares])
    seeing = [each for each, is_blind in zip(shares, blind, strict=True) if not is_blind]
    near = max(each.share(each.near) for each in seeing)
    on = max(each.share(each.on) for each in seeing)
    return [
        LookFit.BLIND if is_blind else LookFit.APART if is_apart(each, near, on) else LookFit.FITS
        for each, is_blind in zip(shares, blind, strict=True)
    ]


def is_apart(look: LookShares, near: float, on: float) -> bool:
    """Return True where a look fits far better elsewhere, saw through the bone, or agrees far less than the best.

    `near` and `on` are the largest shares of all looks that are not blind.
    """
    disagrees = look.share(look.near) < LEAST_NEAR * near or look.share(look.on) < LEAST_ON * on
    return look.fits_elsewhere or look.share(look.seen_through) > SEEN_THROUGH or disagrees


def _apart(answers: tuple[LookAnswer, ...]) -> Finding:
    places = [look.viewpoint for look in answers if look.fit in (LookFit.APART, LookFit.BLIND)]
    names = " and ".join(f"({x:.0f}, {y:.0f}, {z:.0f})" for x, y, z in places)
    text = f"the looks from {names} mm show the bone elsewhere than the others, or not at all"
    advice = "check that neither the bone nor its reference moved, and that nothing was in the way"
    share = len(places) / len(answers)
    return Finding(CHECK, Effect.REFUSE, share, 0.5, RegistrationStatus.AMBIGUOUS, text, advice)


def _shares_of_look(
    T: Array, number: int, is_close: NDArray[np.bool_], scene: Scene, target: PreparedTarget, config: RegistrarConfig
) -> LookShares:
    """Measure look `number` under the common pose (4, 4), and refined by its points (N,) close to the bone."""
    source, close = scene.source, np.flatnonzero((scene.look == number) & is_close)
    own, settings, threads = T, config.clutter, config.num_threads
    if len(close) >= FEWEST_POINTS:
        some = close[:: -(-len(close) // MOST_POINTS)]
        own = clutter.refine_on(source, some, target, LIMITS_MM, 1.0, T[None])[0]
    points, normals = clutter.spread(target, settings.final_target_points)
    alone, poses = scene.each[number], np.stack([T, own])
    near, on = (
        alone.compare(poses, points, normals, on_mm, settings.front_mm, threads)
        for on_mm in (settings.middle_on_mm, settings.on_mm)
    )
    away_mm = se3.rms_apart_mm(own, T, source.points[close]) if len(close) else 0.0
    (compared, own_compared), (on_it, own_on) = near.compared.tolist(), on.explained.tolist()
    return LookShares(compared, on_it, float(near.explained[0]), float(on.violating[0]), own_compared, own_on, away_mm)
