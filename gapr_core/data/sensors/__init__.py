"""Simulators of the sensors of surgery: a seeded function from a `Specimen` to an `Acquired` cloud each."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from gapr_core.data.sensors.acquired import Acquired
from gapr_core.data.sensors.covered import covered
from gapr_core.data.sensors.depth_camera import depth_camera
from gapr_core.data.sensors.laser import laser
from gapr_core.data.sensors.moving import moving
from gapr_core.data.sensors.photogrammetry import photogrammetry
from gapr_core.data.sensors.pointer import pointer
from gapr_core.data.sensors.stereo import stereo
from gapr_core.data.sensors.structured_light import structured_light
from gapr_core.data.sensors.tracing import tracing
from gapr_core.data.sensors.ultrasound import ultrasound
from gapr_core.data.specimen import Specimen

Sensor = Callable[[Specimen, np.random.Generator], Acquired]
SENSORS: dict[str, Sensor] = {
    "pointer": pointer,
    "tracing": tracing,
    "ultrasound": ultrasound,
    "depth_camera": depth_camera,
    "laser": laser,
    "structured_light": structured_light,
    "stereo": stereo,
    "photogrammetry": photogrammetry,
    "covered": covered,
    "moving": moving,
}
"""What measures, and in the last two what it meets: bone that is covered, bone that moves."""
SPARSE: dict[str, Sensor] = {
    "pointer_50": partial(pointer, points=(50, 50), only_dots=True),
    "ultrasound_4": partial(ultrasound, count=(4, 4)),
}
"""The fewest points with which surgeons register: 50 dots, four slices."""

__all__ = ["SENSORS", "SPARSE", "Acquired"]
