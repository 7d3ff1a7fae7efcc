"""Verdict of check points on an accepted pose."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Verdict(str, Enum):
    """Verdict of the check points on a pose."""

    HOLDS = "HOLDS"  # they lie where they should, and an error that matters would have shown, and did not
    SAYS_LITTLE = "SAYS_LITTLE"  # they lie where they should, but such an error might not show in them
    CONTRADICTED = "CONTRADICTED"  # they lie farther off than the pose's covariance allows, or show such an error

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True, eq=False)
class PointCheck:
    """The answer to one `check_points` call.

    Attributes:
        verdict: what the points say.
        probability: that the points of a right pose lie as far off or farther, 0 to 1.
        points: (N, 3) mm, source frame, the points that were checked.
        distance_mm: (N,) signed distance to the surface, positive outside, the sensor's stand-off taken off; NaN where
            no surface is near.
        expected_mm: (N,) its standard deviation under a right pose; NaN with it.
        unseen_mm: 95 % bound of the error over the bone that these points alone leave open.
        tre95_mm: 95 % bound of the pose's error over the bone by registration and check points together.
        next_point, next_normal: (3,) mm and unit, target frame: where another point lowers `unseen_mm` most.
        shown_mm: error of the pose over the bone at which registration and check points together put it; in `tre95_mm`.
    """

    verdict: Verdict
    probability: float
    points: Array
    distance_mm: Array
    expected_mm: Array
    unseen_mm: float
    tre95_mm: float
    next_point: Array
    next_normal: Array
    shown_mm: float = 0.0

    def __str__(self) -> str:
        return self.text()

    def text(self, none_near: str = "none near the bone: are they in the frame and the unit of the source?") -> str:
        """Return the answer in one line; `none_near` stands for points without a surface near."""
        sizes = np.abs(self.distance_mm)
        far, count = int(np.isnan(sizes).sum()), f"{len(sizes)} point{'s' if len(sizes) > 1 else ''}"
        largest = f"{far} with no surface near" if far else f"{sizes.max():.1f} mm off at most"
        if far == len(sizes):
            largest = none_near
        return (
            f"{self.verdict}  {count}, {largest}  probability {self.probability:.3f}  "
            f"shown {self.shown_mm:.1f} mm  unseen {self.unseen_mm:.1f} mm  TRE 95 %: {self.tre95_mm:.1f} mm"
        )
