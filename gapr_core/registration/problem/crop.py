"""Regions of interest: a box around the wound, or the surroundings of the last pose."""

from __future__ import annotations

from numbers import Real

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.clouds import finite_points
from gapr_core.errors import ConfigError
from gapr_core.geometry import se3
from gapr_core.registration.problem import inputs
from gapr_core.registration.problem.target import PreparedTarget

Array = NDArray[np.float64]


def crop_box(points: ArrayLike, T_box_points: ArrayLike, lowest: ArrayLike, highest: ArrayLike) -> Array:
    """Select the finite points in a box; (K, 3) in the points' own frame.

    Args:
        points: (N, 3), mm, in their own frame.
        T_box_points: (4, 4) pose of that frame in the box's frame, mm.
        lowest: (3,) corner of the box, mm, box frame; included.
        highest: (3,) the opposite corner.

    Raises:
        ConfigError: a corner is not (3,) numbers, or `lowest` is not below `highest`.
        InvalidPointCloudError: the points are not (N, 3) numbers, or the pose is not rigid.
    """
    low, high = _corner(lowest), _corner(highest)
    if low.shape != (3,) or high.shape != (3,) or not (low < high).all():
        raise ConfigError("two corners x y z, the lowest first", f"{low} and {high}", "correct the box")
    points = finite_points(points)
    placed = se3.apply(inputs.rigid(T_box_points, "pose of the points' frame", "pass T_box_points in mm"), points)
    return np.asarray(points[((placed >= low) & (placed <= high)).all(axis=1)])


def crop_to_pose(points: ArrayLike, T_target_source: ArrayLike, target: PreparedTarget, margin_mm: float) -> Array:
    """Select the finite points within a margin of the bone under its last pose; (K, 3), mm, source frame.

    Args:
        points: (N, 3), mm, source frame.
        T_target_source: (4, 4) last accepted pose, mm.
        target: from `Registrar.prepare`.
        margin_mm: largest motion of the bone since, and a little more.

    Raises:
        ConfigError: a margin that is not positive.
        InvalidPointCloudError: the points are not (N, 3) numbers, or the pose is not rigid.
    """
    if not isinstance(margin_mm, Real) or not margin_mm > 0.0:
        raise ConfigError("a positive margin in mm", repr(margin_mm), "30 mm suits a bone that moves slowly")
    points = finite_points(points)
    placed = se3.apply(inputs.rigid(T_target_source, "last pose"), points)
    gaps = target.tree.query(placed, distance_upper_bound=margin_mm)[0]
    return np.asarray(points[np.isfinite(gaps)])


def _corner(values: ArrayLike) -> Array:
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError("a corner x y z in mm", repr(values), "correct the box") from error
