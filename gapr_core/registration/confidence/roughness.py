"""The misfit that changes within centimetres: a sign of another bone, or of a wrong pose.

A sensor errs over whole regions; another subject's bone fits here and not there, ridge by ridge. So the covariance of
the residuals at short range, less that at longer range, tells the two apart (an empirical covariogram; Matheron 1963).
Independent noise takes no part. The feature is the upper end of the likely difference, which is large of few pairs:
unseen misfit is never treated as zero.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from gapr_core.geometry import sampling
from gapr_core.registration.fit.refinement import Fit

Array = NDArray[np.float64]

NEAR_MM, FAR_MM = (0.0, 6.0), (12.0, 16.0)  # between foot points on the bone; others: docs/tried.md
LIMITS_MM = np.array([NEAR_MM, FAR_MM])
CENTRES = 600  # inliers, evenly spread, of which each is compared with all
LARGEST_SIGMAS = 4.0  # standard deviations from which a residual counts as none
SURE_SIGMAS = 1.645  # above the measured difference: it is larger in 5 % of the cases
DIGITS = 6  # of a foot point, mm: smaller differences must not decide which points are near


def rough_misfit_mm(fit: Fit) -> float:
    """Bound the excess of the covariance over less than 6 mm above that over 12 to 16 mm.

    Returns its root, mm, with its sign. A product of two independent residuals of variance s^2 has a standard deviation
    of s^2, a mean of m of them s^2 / sqrt(m). `products_mm2` counts a pair of two centres twice. The bound is at most
    s^2, and s^2 where no two inliers are so near, or none so far apart.
    """
    feet, damped = on_the_bone(fit)
    largest_mm2 = float((damped**2).mean()) if len(damped) else fit.sigma_mm**2
    chosen = sampling.thin(feet, CENTRES)
    total, count = products_mm2(feet[chosen], damped[chosen], feet, damped, LIMITS_MM, chosen)
    if not count.all():
        return float(np.sqrt(largest_mm2))
    near_mm2, far_mm2 = total / count
    possible_mm2 = near_mm2 - far_mm2 + SURE_SIGMAS * largest_mm2 * np.sqrt((2.0 / count).sum())
    difference_mm2 = min(possible_mm2, largest_mm2)
    return float(np.sign(difference_mm2) * np.sqrt(abs(difference_mm2)))


def on_the_bone(fit: Fit) -> tuple[Array, Array]:
    """Compute (M, 3) rounded foot points of the inliers and their (M,) damped residuals r (1 - (r / 4 sigma)^2), mm."""
    inlier = fit.counts
    signed = fit.signed_mm[inlier]
    damped = signed * np.maximum(1.0 - (signed / (LARGEST_SIGMAS * fit.sigma_mm)) ** 2, 0.0)
    return fit.feet[inlier].round(DIGITS), damped


@numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def products_mm2(points, residuals, others, other_residuals, limits_mm, own):  # type: ignore[no-untyped-def]
    """Sum products of two residuals, one of points (N, 3) and one of others (M, 3), by their distance.

    The inner loops have no branch and read memory in order: compilers vectorise them.

    Returns:
        (K,) sums and (K,) counts of those within limits (K, 2), mm. `own` (N,) is the index of the point itself among
        the others, which takes no part; -1 where none is.
    """
    total, count = np.zeros(len(limits_mm)), np.zeros(len(limits_mm))
    squared, apart = limits_mm**2, np.empty(len(others))
    beyond = squared.max() + 1.0  # fast mathematics cannot compare with infinity
    x, y, z = others[:, 0].copy(), others[:, 1].copy(), others[:, 2].copy()
    for i in range(len(points)):
        px, py, pz = points[i]
        for j in range(len(others)):
            apart[j] = (px - x[j]) ** 2 + (py - y[j]) ** 2 + (pz - z[j]) ** 2
        if own[i] >= 0:
            apart[own[i]] = beyond
        for k in range(len(limits_mm)):
            low, high = squared[k]
            residual, pairs = 0.0, 0.0
            for j in range(len(others)):
                is_within = (apart[j] >= low) & (apart[j] < high)
                residual += other_residuals[j] if is_within else 0.0
                pairs += 1.0 if is_within else 0.0
            total[k] += residuals[i] * residual
            count[k] += pairs
    return total, count
