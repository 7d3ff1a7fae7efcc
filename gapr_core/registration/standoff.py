"""All points outside of the bone by the same distance: a tip whose radius is not subtracted, a drape, cartilage.

On a patch that faces one way this is a shift of the pose, and no residual shows it. On one that bends, the source looks
grown and fits badly, so that a right pose is refused. Such a refusal asks for the stand-off that would explain it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gapr_core.config import RegistrarConfig, SensorConfig
from gapr_core.registration import mirror
from gapr_core.registration.assessment import Assessment
from gapr_core.registration.refinement import refine_many
from gapr_core.registration.sensor import offset_surface
from gapr_core.results import RegistrationResult, RegistrationStatus

BETTER = 0.15  # log of mean squares: refused sources without a stand-off hardly fit better by more
TRIED_MM = (-2.0, -1.5, -1.0, 1.0, 1.5, 2.0, 2.5, 3.0)  # farther out than the target's surface is taken to be


def asking_the_standoff(
    result: RegistrationResult, assessment: Assessment, config: RegistrarConfig
) -> RegistrationResult:
    """The result; where a LOW_CONFIDENCE source fits better with another stand-off, the reason asks for it.

    A cloud that a camera saw is not asked: most of it may not be bone.
    """
    if result.status is not RegistrationStatus.LOW_CONFIDENCE or assessment.seen is not None:
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
    a, settings = assessment, config.verification
    some, limits_mm = a.source.subset(settings.middle_points), np.linspace(*settings.middle_limits_mm)

    def misfit_mm2(standoff_mm: float) -> float:
        target = offset_surface(a.target, SensorConfig(standoff_mm=standoff_mm)) if standoff_mm else a.target
        return float(refine_many(a.fit.T[None], some, target, limits_mm, config.num_threads)[1][0])

    misfits = {standoff_mm: misfit_mm2(standoff_mm) for standoff_mm in TRIED_MM}
    best_mm = min(misfits, key=misfits.__getitem__)
    is_better = mirror.log_ratio(misfits[best_mm], misfit_mm2(0.0)) < -BETTER
    return a.target.offset_mm + best_mm if is_better else None
