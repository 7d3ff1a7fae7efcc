"""Simulators of what measures a bone in surgery: a seeded function from a `Specimen` to an `Acquired` cloud each."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gapr_core.data.sensors.acquired import Acquired
from gapr_core.data.sensors.depth_camera import depth_camera
from gapr_core.data.sensors.laser import laser
from gapr_core.data.sensors.pointer import pointer
from gapr_core.data.sensors.ultrasound import ultrasound
from gapr_core.data.specimen import Specimen

SENSORS: dict[str, Callable[[Specimen, np.random.Generator], Acquired]] = {
    "pointer": pointer,
    "ultrasound": ultrasound,
    "depth_camera": depth_camera,
    "laser": laser,
}

__all__ = ["SENSORS", "Acquired"]
