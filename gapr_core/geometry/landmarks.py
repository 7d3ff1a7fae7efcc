"""A first pose from pairs of landmarks: the same few points touched on the patient and marked on the model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.errors import InvalidPointCloudError
from gapr_core.geometry import se3
from gapr_core.geometry.extent import BEYOND

Array = NDArray[np.float64]

FEWEST_PAIRS = 3
NARROWEST = 0.05  # spread across over spread along, below which landmarks lie on a line


@dataclass(frozen=True, eq=False)
class LandmarkPose:
    """Where landmarks put the source.

    Attributes:
        T_target_source: (4, 4), mm: `initial` of `Registrar.register`.
        rms_mm: root-mean-square distance of the pairs under it (fiducial registration error).
    """

    T_target_source: Array
    rms_mm: float


def paired_pose(source: ArrayLike, target: ArrayLike) -> LandmarkPose:
    """Find the rigid motion that lays landmarks on their partners best (Arun 1987; Kabsch 1976).

    Args:
        source: (K, 3) landmarks in the source's frame, mm, K >= 3, not on one line.
        target: (K, 3) the same landmarks, in the same order, in the target's frame, mm.

    Raises:
        InvalidPointCloudError: another number or shape, values that are not finite or beyond 1e12, or points on a line.
    """
    source, target = _checked(source, "source"), _checked(target, "target")
    if len(source) != len(target):
        given = f"{len(source)} and {len(target)}"
        raise InvalidPointCloudError("as many source as target landmarks", given, "name the same points, in one order")
    T = se3.kabsch(source, target)
    distances = np.linalg.norm(se3.apply(T, source) - target, axis=1)
    return LandmarkPose(T, float(np.sqrt((distances**2).mean())))


def _checked(points: ArrayLike, name: str) -> Array:
    try:
        points = np.asarray(points, dtype=np.float64)
    except (TypeError, ValueError, RuntimeError) as error:  # the last: a tensor with a gradient
        how = "pass one row of x, y, z for each"
        raise InvalidPointCloudError(f"{name} landmarks (K, 3), mm", str(error), how) from error
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < FEWEST_PAIRS or not (np.abs(points) < BEYOND).all():
        expected = f"at least {FEWEST_PAIRS} finite {name} landmarks (K, 3), mm"
        raise InvalidPointCloudError(expected, f"an array of shape {points.shape}", "add or correct them")
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if spread[1] <= NARROWEST * spread[0]:
        raise InvalidPointCloudError(f"{name} landmarks in a plane", "landmarks on a line", "touch one to the side")
    return points
