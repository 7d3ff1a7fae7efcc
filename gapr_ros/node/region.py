"""The region of interest: which points of a cloud are looked at at all. A box in a frame, and the bone's last place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from gapr_core import crop_box, crop_to_pose
from gapr_ros.node import units
from gapr_ros.node.model import Model
from gapr_ros.node.refusal import Reason, RefusedError
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

    Raises:
        RefusedError: too_few_points, for a box that no point fits in.
    """
    if not all(low < high for low, high in zip(parameters.crop_min, parameters.crop_max, strict=True)):
        corners = (
            f"crop_min {list(parameters.crop_min)} is not below crop_max {list(parameters.crop_max)} along every axis"
        )
        raise RefusedError(Reason.TOO_FEW_POINTS, f"the box is empty: {corners}; correct them")
    low, high = (units.to_mm(np.asarray(corner), "m") for corner in (parameters.crop_min, parameters.crop_max))
    return partial(crop_box, T_box_points=units.in_mm(T_crop_cloud), lowest=low, highest=high)


def around(model: Model, T_cloud_model: Array, reach_m: float) -> Crop:
    """Keeps the points near the bone where it was last.

    Args:
        model: the bone in its own frame, mm.
        T_cloud_model: (4, 4), metres.
        reach_m: farther points go.
    """
    T_target_source = units.core_pose(T_cloud_model)
    return partial(crop_to_pose, T_target_source=T_target_source, target=model, margin_mm=reach_m * units.MM_PER_M)
