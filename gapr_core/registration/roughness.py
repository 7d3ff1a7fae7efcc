"""The misfit that changes within centimetres: a sign of another bone, or of a wrong pose.

What a sensor gets wrong over a region (soft tissue, a warped scan) it gets wrong for all of it: residuals 15 to 20 mm
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
CENTRES = 300  # inliers, evenly spread, of which each is compared with all


def rough_misfit_mm(fit: Fit) -> float:
    """Root of the residuals' covariance over at most 8 mm less that over 14 to 22 mm; negative where that is.

    0 where no two inliers are as near, or none as far.
    """
    inlier = fit.weights > 0.0
    signed = np.ascontiguousarray(fit.signed_mm[inlier])
    feet = fit.moved[inlier] - signed[:, None] * fit.gradients[inlier]  # noise must not decide which points are near
    near, far = covariances_mm2(feet, signed, sampling.thin(feet, CENTRES), np.array([NEAR_MM, FAR_MM]))
    if np.isnan(near) or np.isnan(far):
        return 0.0
    return float(np.sign(near - far) * np.sqrt(abs(near - far)))


@numba.njit(cache=True, nogil=True)
def covariances_mm2(points, residuals, chosen, limits_mm):  # type: ignore[no-untyped-def]
    """(K,) mean product of two residuals, one of a chosen point, that lie within limits (K, 2), mm, of each other.

    NaN where no two do.
    """
    total, count = np.zeros(len(limits_mm)), np.zeros(len(limits_mm))
    for i in chosen:
        for j in range(len(points)):
            apart = 0.0
            for axis in range(3):
                apart += (points[i, axis] - points[j, axis]) ** 2
            for k in range(len(limits_mm)):
                if i != j and limits_mm[k, 0] ** 2 <= apart < limits_mm[k, 1] ** 2:
                    total[k] += residuals[i] * residuals[j]
                    count[k] += 1.0
    return np.where(count > 0.0, total / np.maximum(count, 1.0), np.nan)
