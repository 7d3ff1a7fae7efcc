"""All points off the bone by the same distance: a tip whose radius is not subtracted, a drape, cartilage, tissue.

On a patch that faces one way this is a shift of the pose, and no residual shows it. On one that bends, the source looks
grown and fits badly, so that a right pose is refused. Such a refusal asks for the stand-off that would explain it. On a
pelvis or a rib cage a layer of 4 to 8 mm fits well enough to be believed, with a pose that is off by as much. But it
fits the surface of a thicker or thinner bone better: where one more than 4 mm outside does, or one 3 mm inside, the
pose is refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gapr_core.config import RegistrarConfig, SensorConfig
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.fit import mirror
from gapr_core.registration.fit.refinement import refine_many
from gapr_core.registration.problem.sensor import offset_surface
from gapr_core.results import Refusal, RegistrationResult, RegistrationStatus

BETTER = 0.15  # log of mean squares: refused sources without a stand-off hardly fit better by more
MUCH_BETTER = 0.3  # the same, of a pose that is refused for it: answers to sources on the bone reach 0.23
FIRST_MM = (-3.0, 3.0)  # unless one of these is better than none, no other is tried
FAR_MM = (-4.5, -3.0, 4.5, 6.0, 8.0)  # outside farther than a right pose may be off (`se3.RIGHT_MM`); inside is nothing
TRIED_MM = (-2.0, -1.5, -1.0, 1.0, 1.5, 2.0, 2.5, 3.0)  # farther out than the target's surface is taken to be


def asking_the_standoff(
    result: RegistrationResult, assessment: Assessment, config: RegistrarConfig
) -> RegistrationResult:
    """The result; where a LOW_CONFIDENCE source fits better with another stand-off, the reason asks for it.

    A cloud that a camera saw is not asked: most of it may not be bone. Nor is one that `unless_off_the_bone` refused.
    """
    a = assessment
    is_asked = a.refusal is not None and a.refusal.asks_standoff
    if result.status is not RegistrationStatus.LOW_CONFIDENCE or a.seen is not None or is_asked:
        return result
    found_mm = better_mm(assessment, config)
    if found_mm is None:
        return result
    side = "outside" if found_mm > 0.0 else "inside"
    where = f"{abs(found_mm):g} mm {side} of the bone" if found_mm else "on the bone"
    stated_mm = config.sensor.standoff_mm
    question = "is the radius of the tip subtracted, or is there a standoff_mm to state?"
    if stated_mm is not None:
        question = f"is the standoff_mm of {stated_mm:g} right?"
    return replace(result, reason=f"{result.reason}; it fits better {where}: {question}")


def better_mm(assessment: Assessment, config: RegistrarConfig) -> float | None:
    """The stand-off, mm, outwards, with which it fits clearly better, refined from the pose; None without one."""
    best_mm, log_ratio = _best_of(_misfits_mm2(assessment, TRIED_MM, config))
    return assessment.target.offset_mm + best_mm if log_ratio < -BETTER else None


def unless_off_the_bone(assessment: Assessment, config: RegistrarConfig) -> Assessment:
    """The same; refused where the source, or the part of it that is bone, fits much better far outside or inside."""
    a = assessment
    first = _misfits_mm2(a, FIRST_MM, config)
    if _best_of(first)[1] >= 0.0:
        return a
    others = [mm for mm in (*TRIED_MM, *FAR_MM) if mm not in first]
    best_mm, log_ratio = _best_of(first | _misfits_mm2(a, others, config))
    if best_mm not in FAR_MM or log_ratio >= -MUCH_BETTER:
        return a
    off_mm = a.target.offset_mm + best_mm
    side = "outside" if off_mm > 0.0 else "inside"
    reason = f"the source fits best on a surface about {abs(off_mm):g} mm {side} of the bone"
    how = "is it tissue, is the radius of the tip subtracted, or is there a standoff_mm to state?"
    refusal = Refusal(RegistrationStatus.LOW_CONFIDENCE, f"{reason}: {how}", asks_standoff=True)
    return a.with_refusal(refusal, config.rules)


def _misfits_mm2(assessment: Assessment, tried_mm: Sequence[float], config: RegistrarConfig) -> dict[float, float]:
    """Mean square residual, mm^2, of the source refined on surfaces so much farther out than now, and on this one."""
    a, settings = assessment, config.verification
    some, limits_mm = a.source.subset(settings.middle_points), np.linspace(*settings.middle_limits_mm)

    def misfit_mm2(standoff_mm: float) -> float:
        target = offset_surface(a.target, SensorConfig(standoff_mm=standoff_mm)) if standoff_mm else a.target
        return float(refine_many(a.fit.T[None], some, target, limits_mm, config.num_threads)[1][0])

    return {standoff_mm: misfit_mm2(standoff_mm) for standoff_mm in dict.fromkeys((*tried_mm, 0.0))}


def _best_of(misfits_mm2: dict[float, float]) -> tuple[float, float]:
    """The stand-off that fits best, other than 0, mm, and the log of its mean square over that of 0."""
    best_mm = min((mm for mm in misfits_mm2 if mm), key=misfits_mm2.__getitem__)
    return best_mm, mirror.log_ratio(misfits_mm2[best_mm], misfits_mm2[0.0])
