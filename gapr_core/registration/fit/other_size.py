"""Larger or smaller: does the source fit the bone as well in another size?

A patch of a shaft and of one end says little of a bone's length, and a pose that slides along hides another size from
the residuals and from `features.scale_of`, which looks at small changes only. A source that was scaled wrong, or is of
a smaller or larger subject, fits better once it is refined in the right size.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapr_core.config import VerificationConfig
from gapr_core.registration.fit import mirror
from gapr_core.registration.fit.refinement import refine_many
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget

Array = NDArray[np.float64]

SIZES = (0.945, 1.055)  # far enough from 1 that noise and a sensor's bias fit neither better
HALFWAY = (0.9725, 1.0275)  # between these and 1: a source of this size fits in 1 as well as in one of `SIZES`


def margin(
    T: Array,
    source: PreparedSource,
    target: PreparedTarget,
    config: VerificationConfig,
    num_threads: int = 0,
    sizes: tuple[float, ...] = SIZES,
) -> float:
    """Log of the mean square residual that the source reaches in another size over its own; the least of `sizes`.

    The source grows about its centroid and is refined from the pose. Its residuals grow with it, so that they count in
    its own size: a mean square over s^2.

    Args: as `mirror.margin`.

    Returns:
        Below 0 where another size fits better, above where it fits worse, within `mirror.LIMITS`.
    """
    some, limits_mm = source.subset(config.middle_points), np.linspace(*config.middle_limits_mm)
    centre = some.mean(axis=0)
    own, *others = (
        refine_many(T[None], centre + size * (some - centre), target, limits_mm, num_threads)[1][0] / size**2
        for size in (1.0, *sizes)
    )
    return mirror.log_ratio(min(others), own)
