"""What holds at the moment when the worker takes a cloud in hand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_ros.node.model import Model
from gapr_ros.node.region import Place
from gapr_ros.parameters import NodeParameters

Array = NDArray[np.float64]


@dataclass(frozen=True)
class InitialPose:
    """A pose that somebody gave: T_frame_model (4, 4), metres, in `frame` (empty: that of the cloud)."""

    T_frame_model: Array
    frame: str


@dataclass(frozen=True)
class Situation:
    """What holds at the moment when a cloud is taken in hand.

    `oldest` is the first epoch of what may be collected, `why` the last one ended.
    """

    method: Any
    model: Model
    parameters: NodeParameters
    epoch: int
    oldest: int
    why: str
    initial_pose: InitialPose | None
    place: Place | None
    now_ns: int
