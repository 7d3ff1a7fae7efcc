"""The misfit that the frames of a stream share: a sign of another bone that one frame does not show as well.

A sensor's noise is another one in every frame, and so is much of its bias. Another subject's ridges stay where they are
on the bone. So the mean product of two residuals of different frames, whose foot points are near each other, is the
variance of what stays there. Soft tissue stays as well, but is smooth: as in `roughness`, what points 12 to 16 mm apart
have in common is taken off, and is a number of its own. Both grow clear with the frames: each adds pairs with all that
are remembered.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from gapr_core.geometry import sampling
from gapr_core.registration.confidence.roughness import CENTRES, FAR_MM, NEAR_MM, on_the_bone, products_mm2, signed_root
from gapr_core.registration.fit.refinement import Fit

Array = NDArray[np.float64]

LIMITS_MM = np.array([(1.0, NEAR_MM[1]), FAR_MM])  # a point that comes again, in a cloud that grows, has the same noise
FRAMES, POINTS = 6, 500  # how many frames are remembered, and how many points of each
FEWEST_PAIRS = 300  # with fewer near ones nothing is known
USUAL_PAIRS = 1000  # with so many the covariance counts by half: the fewer, the more chance is in it


class SharedMisfit:
    """What the residuals of frames have in common, of one stream on one target.

    Args:
        memory: frames after which the weight of a pair of points has fallen to about 1/e, at least 1.
    """

    def __init__(self, memory: float) -> None:
        self._kept_share = 1.0 - 1.0 / memory
        self.forget()

    def forget(self) -> None:
        """Forget all frames."""
        self._frames: deque[tuple[Array, Array]] = deque(maxlen=FRAMES)
        self._total, self._count = np.zeros(len(LIMITS_MM)), np.zeros(len(LIMITS_MM))

    def add(self, fit: Fit) -> tuple[float, float] | None:
        """Take in the next frame.

        Returns:
            Roots, mm, of the covariance that the frames share at short range only, and of that at long range, negative
            where the covariance is; None while one of them has too few pairs of points of different frames.
        """
        feet, damped = on_the_bone(fit)
        if self._frames and len(feet):
            chosen = sampling.thin(feet, CENTRES)
            others, other_damped = (np.concatenate(each) for each in zip(*self._frames, strict=True))
            nobody = np.full(len(chosen), -1)
            total, count = products_mm2(feet[chosen], damped[chosen], others, other_damped, LIMITS_MM, nobody)
            self._total = self._kept_share * self._total + total
            self._count = self._kept_share * self._count + count
        few = sampling.thin(feet, POINTS)
        self._frames.append((feet[few], damped[few]))
        if self._count.min() < FEWEST_PAIRS:
            return None
        near, far = self._total / (self._count + USUAL_PAIRS)
        return signed_root(near - far), signed_root(far)
