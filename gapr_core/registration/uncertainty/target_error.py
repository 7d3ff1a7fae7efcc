"""The error to expect at targets: from the covariance of the pose to mm at points of the bone.

A pose error e moves a point p by J(p) e with J = [I, -[p - c]x]. The mean square over points is TRE^2 = e^T A e with A
= mean J^T J: a weighted sum of chi-square variables when e is normal with covariance C. Its mean is tr(A C)
(Fitzpatrick 1998). Its 95 % quantile is that of the scaled chi-square with the same mean and variance (Satterthwaite
1946).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from gapr_core.geometry.twists import mean_square

Array = NDArray[np.float64]

QUANTILE = 0.95


def bound_mm(covariance: Array, points: Array, centre: Array, quantile: float = QUANTILE) -> float:
    """Bound the error over points (M, 3) with probability `quantile`, mm.

    Args:
        covariance: (6, 6) x y z (mm) rx ry rz (rad), rotation about `centre`.
        points: (M, 3) target points, mm, target frame; one for the error at a single target.
        centre: (3,) mm, target frame.
        quantile: 0 to 1.
    """
    product = mean_square(points, centre) @ covariance
    mean, variance = np.trace(product), 2.0 * np.trace(product @ product)
    scale, freedom = variance / (2.0 * mean), 2.0 * mean**2 / variance
    chi_square = 2.0 * gammaincinv(freedom / 2.0, quantile)  # as `scipy.stats.chi2.ppf`, which takes long to import
    return float(np.sqrt(scale * chi_square))
