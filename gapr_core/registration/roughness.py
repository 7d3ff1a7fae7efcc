"""The misfit that changes within centimetres: a sign of another bone, or of a wrong pose.

What a sensor gets wrong over a region (soft tissue, a warped scan) it gets wrong for all of it: residuals 14 to 22 mm
apart are nearly as alike as those of neighbours. Another subject's bone fits here and not there, ridge by ridge. So the
covariance of the residuals at short range, less that at longer range, tells the two apart (an empirical covariogram;
Matheron 1963). Noise takes no part: it is independent from point to point.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from gapr_core.geometry import sampling
from gapr_core.registration.refinement import Fit

Array = NDArray[np.float64]

NEAR_MM, FAR_MM = (0.0, 8.0), (14.0, 22.0)  # between foot points on the bone
LIMITS_MM = np.array([NEAR_MM, FAR_MM])
CENTRES = 300  # inliers, evenly spread, of which each is compared with all


def rough_misfit_mm(fit: Fit) -> float:
    """Root, mm, of the residuals' covariance over less than 8 mm, minus that over 14 to 22 mm; with their sign.

    0 where no two inliers are so near, or none so far apart.
    """
    feet, signed = on_the_bone(fit)
    chosen = sampling.thin(feet, CENTRES)
    total, count = products_mm2(feet[chosen], signed[chosen], feet, signed, LIMITS_MM, chosen)
    return signed_root(*(total / count)) if count.all() else 0.0


def on_the_bone(fit: Fit) -> tuple[Array, Array]:
    """(M, 3) foot points of the inliers and their (M,) residuals: noise must not decide which points are near."""
    inlier = fit.weights > 0.0
    signed = np.ascontiguousarray(fit.signed_mm[inlier])
    return fit.moved[inlier] - signed[:, None] * fit.gradients[inlier], signed


def signed_root(near_mm2: float, far_mm2: float) -> float:
    """Root, mm, of the difference of two covariances; its sign is that of the difference."""
    return float(np.sign(near_mm2 - far_mm2) * np.sqrt(abs(near_mm2 - far_mm2)))


@numba.njit(cache=True, nogil=True)
def products_mm2(points, residuals, others, other_residuals, limits_mm, own):  # type: ignore[no-untyped-def]
    """Products of two residuals, one of the points (N, 3) and one of the others (M, 3), by their distance.

    Returns:
        (K,) sums and (K,) counts of those within limits (K, 2), mm; `own` (N,) says which of the others is the point
        itself and takes no part, -1 where none is.
    """
    total, count = np.zeros(len(limits_mm)), np.zeros(len(limits_mm))
    squared = limits_mm**2
    farthest = squared.max()
    for i in range(len(points)):
        for j in range(len(others)):
            apart = 0.0
            for axis in range(3):
                apart += (points[i, axis] - others[j, axis]) ** 2
            if apart >= farthest or j == own[i]:
                continue
            for k in range(len(limits_mm)):
                if squared[k, 0] <= apart < squared[k, 1]:
                    total[k] += residuals[i] * other_residuals[j]
                    count[k] += 1.0
    return total, count
