"""The region of interest: which points of a cloud are looked at at all. A box in a frame, and the bone's last place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gapr_core.geometry import se3
from gapr_ros.node import wire
from gapr_ros.parameters import NodeParameters

Array = NDArray[np.float64]
Crop = Callable[[Array], Array]


@dataclass(frozen=True)
class Place:
    """Where the bone was last: T_frame_model (4, 4), metres, in `frame`."""

    T_frame_model: Array
    frame: str


def has_box(parameters: NodeParameters) -> bool:
    """A box of no size is none."""
    return parameters.crop_min != parameters.crop_max


def box(parameters: NodeParameters, T_crop_cloud: Array) -> Crop:
    """Keeps the points inside the box `crop_min` to `crop_max`.

    Args:
        parameters: the corners, m, in `crop_frame`.
        T_crop_cloud: (4, 4), metres.
    """
    low, high = (np.asarray(corner) * wire.MM_PER_M for corner in (parameters.crop_min, parameters.crop_max))

    def crop(points_mm: Array) -> Array:
        there = wire.moved_mm(T_crop_cloud, points_mm)
        return points_mm[((there >= low) & (there <= high)).all(axis=1)]

    return crop


def around(model_tree: cKDTree, T_cloud_model: Array, reach_m: float) -> Crop:
    """Keeps the points near the bone where it was last.

    Args:
        model_tree: of the bone's points, mm, in its own frame.
        T_cloud_model: (4, 4), metres.
        reach_m: farther points go.
    """
    T_model_cloud = se3.inverse(T_cloud_model)

    def crop(points_mm: Array) -> Array:
        there = wire.moved_mm(T_model_cloud, points_mm)
        distance_mm, _ = model_tree.query(there, distance_upper_bound=reach_m * wire.MM_PER_M)
        return points_mm[np.isfinite(distance_mm)]

    return crop
