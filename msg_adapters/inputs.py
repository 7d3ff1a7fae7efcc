"""Interface of a message type that brings partial clouds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


class Input(NamedTuple):
    """How one type of message is read. The message begins with a `std_msgs/Header`.

    Attributes:
        message: the type.
        points: (N, 3) float64 points of a message, in its own unit and frame. Rows that are not finite are dropped. So
            are exact zeros of a `PointCloud2`, which depth cameras send for "nothing seen". Raises
            `InvalidMessageError` for a message that contradicts itself.
        count: how many points the message has, usable or not.
        grid: (H, W, 3) float64 points of a message that is an image, row by row, usable or not; None for others.
            Raises as `points` does.
    """

    message: type
    points: Callable[[Any], NDArray[np.float64]]
    count: Callable[[Any], int]
    grid: Callable[[Any], NDArray[np.float64] | None] = lambda message: None
