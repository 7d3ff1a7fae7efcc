"""Did the bone rest while its sources were collected?

Sources of a bone that creeps blur together, and each lies as near to the common pose as all of them. But the first and
the last of them, refined apart, then lie in two poses: farther from each other than the covariances of both allow for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gapr_core.config import RegistrarConfig
from gapr_core.geometry.twists import covariance_about, error_twist, nees
from gapr_core.registration import covariance
from gapr_core.registration.refinement import refine_fully
from gapr_core.registration.sensor import offset_surface
from gapr_core.registration.target import PreparedTarget

Array = NDArray[np.float64]

KNOWN_MM, KNOWN_DEG = 1.0, 1.5  # standard deviations up to which the pose of a part says something


@dataclass(frozen=True)
class Apart:
    """How far two poses of one bone lie apart.

    Attributes:
        nees: squared distance in standard deviations of both; of poses alike it has the chi-square distribution of 6.
            0 where one of them is hardly known: far from the common pose a covariance says little.
        shift_mm: at the middle of the second source.
        turn_deg: of one against the other.
    """

    nees: float
    shift_mm: float
    turn_deg: float


def apart(first: Array, last: Array, T: Array, target: PreparedTarget, config: RegistrarConfig) -> Apart:
    """How far two sources (N, 3) and (M, 3), mm, lie apart, each refined from their common pose T (4, 4).

    What is wrong with the model is wrong for both, and does not count.
    """
    surface, exact = offset_surface(target, config.sensor), replace(config.covariance, model_mm=0.0)
    fits = [refine_fully(T, np.ascontiguousarray(points), surface, config.refinement) for points in (first, last)]
    found = [covariance.estimate(fit, exact, config.sensor) for fit in fits]
    is_known = all(each.largest_shift_mm < KNOWN_MM and each.largest_turn_deg < KNOWN_DEG for each in found)
    middles = [fit.moved.mean(axis=0) for fit in fits]
    both = covariance_about(middles[1] - middles[0], found[0].covariance) + found[1].covariance
    twist = error_twist(fits[0].T, fits[1].T, last)
    shift_mm, turn_rad = np.linalg.norm(twist[:3]), np.linalg.norm(twist[3:])
    return Apart(nees(twist, both) if is_known else 0.0, float(shift_mm), float(np.degrees(turn_rad)))
