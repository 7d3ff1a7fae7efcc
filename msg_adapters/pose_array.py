"""PoseArray to (N, 3): the positions of a digitiser's tip; orientations are not used."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PoseArray
from numpy.typing import NDArray

from msg_adapters.inputs import Input


def positions(message: PoseArray) -> NDArray[np.float64]:
    """(N, 3) positions, unit and frame of the message; rows that are not finite are dropped."""
    rows = [(pose.position.x, pose.position.y, pose.position.z) for pose in message.poses]
    points = np.array(rows, dtype=np.float64).reshape(-1, 3)
    return points[np.isfinite(points).all(axis=1)]


INPUT = Input(PoseArray, positions, lambda message: len(message.poses))
