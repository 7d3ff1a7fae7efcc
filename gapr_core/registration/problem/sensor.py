"""Errors of a sensor, known before its residuals: stand-off, noise, smooth bias and scale."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gapr_core.config import SensorConfig
from gapr_core.registration.problem.target import PreparedTarget


@dataclass(frozen=True)
class Errors:
    """Standard deviations of errors that no residual shows, or that few points cannot show."""

    offset_mm: float  # mean stand-off, outwards; it is subtracted
    standoff_mm: float  # stand-off about that mean, the same in all points
    noise_mm: float  # noise of a point
    bias_mm: float  # typical size of the smooth bias
    scale: float  # relative error of the size
    local_mm: float = 0.0  # error that only near points share, such as a slice that the tracker misplaces
    along_beam: bool = False  # stand-off and scale act along one beam, as in depth images, not along each normal
    tracking_mm: float = 0.0  # error of the whole cloud's place, along each axis
    tracking_deg: float = 0.0  # error of its attitude about its centroid, about each axis

    @property
    def place_covariance(self) -> NDArray[np.float64]:
        """(6, 6) covariance of the whole cloud's place, x y z (mm) rx ry rz (rad), about its centroid."""
        return np.diag(np.repeat(np.square([self.tracking_mm, np.radians(self.tracking_deg)]), 3))


LEAST_STANDOFF_MM = 0.1  # standard deviation of the surest kind
STATED = ("noise_mm", "bias_mm", "scale", "tracking_mm", "tracking_deg")  # values that the user may state
KINDS = {
    # models of unknown origin are wrong by .3 % of their size
    "unknown": Errors(offset_mm=0.0, standoff_mm=0.5, noise_mm=0.5, bias_mm=0.1, scale=0.003),
    # measured pointers lie .34 to .62 mm outside
    "pointer": Errors(offset_mm=0.5, standoff_mm=0.35, noise_mm=0.4, bias_mm=0.15, scale=0.0),
    # sound is 1 to 3 % faster or slower than assumed, and a tracked slice lies .1 to .5 mm off
    "ultrasound": Errors(
        offset_mm=0.0, standoff_mm=0.6, noise_mm=0.5, bias_mm=0.2, scale=0.02, local_mm=0.3, along_beam=True
    ),
    # its range is wrong by 1 %, and light enters wet bone before it comes back
    "depth_camera": Errors(offset_mm=0.0, standoff_mm=0.1, noise_mm=0.7, bias_mm=0.2, scale=0.01),
    "laser": Errors(offset_mm=0.0, standoff_mm=0.1, noise_mm=0.15, bias_mm=0.15, scale=0.002),
    # a tracked scanner is located to 0.2 mm
    "structured_light": Errors(
        offset_mm=0.0, standoff_mm=0.1, noise_mm=0.2, bias_mm=0.15, scale=0.001, tracking_mm=0.2, tracking_deg=0.2
    ),
}


def errors(sensor: SensorConfig, points: int) -> Errors:
    """Return the errors to expect of a source of `points` points; stated values replace the usual ones.

    An unnamed sensor with up to `sparse_points` may have touched the bone, as a pointer read for half a minute. A
    denser cloud is a camera's or a laser's, but no surer than a named one.
    """
    usual = KINDS[sensor.kind]
    if sensor.kind == "unknown":
        falling_mm = usual.standoff_mm * min(1.0, sensor.sparse_points / max(points, 1))
        usual = replace(usual, standoff_mm=max(falling_mm, LEAST_STANDOFF_MM))
    stated = {name: getattr(sensor, name) for name in STATED}
    usual = replace(usual, **{name: value for name, value in stated.items() if value is not None})
    if sensor.standoff_mm is None:
        return usual
    return replace(usual, offset_mm=sensor.standoff_mm, standoff_mm=sensor.known_standoff_mm)


def offset_surface(target: PreparedTarget, sensor: SensorConfig) -> PreparedTarget:
    """Move the target's surface elements to where the sensor sees them: farther out by the stand-off.

    A residual becomes the signed distance to the bone less the stand-off. One of 0 returns the same object.
    """
    offset_mm = errors(sensor, 0).offset_mm
    if offset_mm == 0.0:
        return target
    elements = target.elements.copy()
    elements[:, :3] += offset_mm * elements[:, 3:6]
    both = None if target.both_cortices is None else offset_surface(target.both_cortices, sensor)
    return replace(
        target, elements=np.ascontiguousarray(elements), both_cortices=both, offset_mm=target.offset_mm + offset_mm
    )
