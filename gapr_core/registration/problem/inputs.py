"""Inputs of a caller besides clouds: poses, places, corners."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.errors import InvalidPointCloudError
from gapr_core.geometry import se3
from gapr_core.surface import as_array

Array = NDArray[np.float64]
MOST_SHOWN = 16  # values of an array in a message


def numbers(values: ArrayLike, shape: tuple[int, ...], what: str, how: str) -> Array:
    """Copy values, a list, an array or a tensor, into a finite float64 array of a required shape.

    Raises:
        InvalidPointCloudError: another shape, or a value that is no finite number; it names `what` and `how` to fix it.
    """
    array = as_array(values, f"a finite {shape} {what}", how)
    if array.shape != shape or array.dtype.kind not in "fiu" or not np.isfinite(array).all():
        given = f"shape {array.shape}"
        if array.shape == shape:
            given = str(array.tolist()) if array.size <= MOST_SHOWN else f"{given} with values that are none"
        raise InvalidPointCloudError(f"a finite {shape} {what}", given, how)
    return array.astype(np.float64)


def rigid(pose: ArrayLike, what: str, how: str = "pass T_target_source in mm") -> Array:
    """Return the rigid (4, 4) nearest to a pose that is rigid but for rounding.

    Raises:
        InvalidPointCloudError: another shape, or a pose with a scale, a reflection or another last row.
    """
    T = numbers(pose, (4, 4), what, how)
    if why := se3.why_not_rigid(T):
        how = "no scale, no reflection, translation in the last column; lengths in mm"
        raise InvalidPointCloudError(f"a rigid (4, 4) {what}", f"a matrix whose {why}", how)
    return se3.nearest_rigid(T)
