"""What is known of a sensor before its residuals are seen: its stand-off, noise, smooth bias and scale."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gapr_core.config import SensorConfig
from gapr_core.registration.problem.target import PreparedTarget


@dataclass(frozen=True)
class Errors:
    """Standard deviations of what no residual shows, or few points cannot.

    Attributes:
        offset_mm: mean stand-off, outwards; it is subtracted.
        standoff_mm: of the stand-off about that mean, the same in all points.
        noise_mm: of a point.
        bias_mm: typical size of the smooth bias.
        scale: of the relative error of the size.
        local_mm: of an error that near points share and others do not: a slice that the tracker puts elsewhere.
        along_beam: stand-off and scale act along one beam, as depths of an image do, not along each point's normal.
        tracking_mm: of an error of the whole cloud's place, along each axis.
        tracking_deg: of an error of its attitude about its centroid, about each axis.
    """

    offset_mm: float
    standoff_mm: float
    noise_mm: float
    bias_mm: float
    scale: float
    local_mm: float = 0.0
    along_beam: bool = False
    tracking_mm: float = 0.0
    tracking_deg: float = 0.0

    @property
    def place_covariance(self) -> NDArray[np.float64]:
        """(6, 6) covariance of the whole cloud's place, x y z (mm) rx ry rz (rad), about its centroid."""
        return np.diag(np.repeat(np.square([self.tracking_mm, np.radians(self.tracking_deg)]), 3))


LEAST_STANDOFF_MM = 0.1  # standard deviation: that of the surest kind
STATED = ("noise_mm", "bias_mm", "scale", "tracking_mm", "tracking_deg")  # that the user may know better
KINDS = {
    # pictures of unknown making are wrong by .3 % of their size
    "unknown": Errors(offset_mm=0.0, standoff_mm=0.5, noise_mm=0.5, bias_mm=0.1, scale=0.003),
    # a real one lies .34 to .62 mm outside
    "pointer": Errors(offset_mm=0.5, standoff_mm=0.35, noise_mm=0.4, bias_mm=0.15, scale=0.0),
    # sound is 1 to 3 % faster or slower than assumed, and a tracked slice lies .1 to .5 mm off
    "ultrasound": Errors(
        offset_mm=0.0, standoff_mm=0.6, noise_mm=0.5, bias_mm=0.2, scale=0.02, local_mm=0.3, along_beam=True
    ),
    # its range is wrong by 1 %, and light enters wet bone before it comes back
    "depth_camera": Errors(offset_mm=0.0, standoff_mm=0.1, noise_mm=0.7, bias_mm=0.2, scale=0.01),
    "laser": Errors(offset_mm=0.0, standoff_mm=0.1, noise_mm=0.15, bias_mm=0.15, scale=0.002),
    # a tracked scanner is placed to a fifth of a millimetre
    "structured_light": Errors(
        offset_mm=0.0, standoff_mm=0.1, noise_mm=0.2, bias_mm=0.15, scale=0.001, tracking_mm=0.2, tracking_deg=0.2
    ),
}


def errors(sensor: SensorConfig, points: int) -> Errors:
    """The errors to expect of a source of so many points; what the user states replaces what is usual.

    Who names no sensor and brings up to 2000 points (`sparse_points`) may have touched the bone: a pointer read at
    60 Hz gives as many in half a minute. A denser cloud is a camera's or a laser's, but no surer than a named one.
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
    """The target whose surface elements lie where the sensor sees them: farther out by the stand-off.

    The residual of a point becomes its signed distance to the bone less the stand-off. Everything else of the target
    stays, and so does the target itself where the stand-off is 0. That of a target that lies farther out already is
    added to its own.
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
