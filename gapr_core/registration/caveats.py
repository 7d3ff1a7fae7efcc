"""What surrounds every `register`: any kind of source goes in; the bone, the source and the warnings come out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

from gapr_core import clouds
from gapr_core.config import RegistrarConfig
from gapr_core.geometry import extent, pinhole
from gapr_core.registration.problem.sensor import errors
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.results import RegistrationResult, ResultWarning
from gapr_core.surface import Surface

Array = NDArray[np.float64]
Source = str | Path | ArrayLike | Surface


class Register(Protocol):
    """`register` as its users see it."""

    def __call__(
        self, source: Source, target: PreparedTarget, initial: ArrayLike | None = None, viewpoint: Any = None
    ) -> RegistrationResult: ...


LOOSE_DEG = 5.0  # a turn that may be larger than what counts as right
WITHIN_95 = float(ndtri(0.975))
SENSOR_UNKNOWN = ResultWarning(
    "sensor_unknown",
    "The sensor is not named, so the error bound allows for any.",
    "Name it: sensor.kind=pointer, ultrasound, depth_camera, laser or structured_light.",
)
TRACKING_UNKNOWN = ResultWarning(
    "tracking_unknown",
    "A tracker's error is not in the bound.",
    "State it: sensor.tracking_mm and sensor.tracking_deg, for the place and the attitude of the whole cloud.",
)


def answering(register: Callable[..., RegistrationResult]) -> Register:
    """Let a `register` take a path, an array or a `Surface`, and complete its result with what a reader needs."""

    @wraps(register)
    def call(self: Any, source: Source, target: Any, initial: Any = None, viewpoint: Any = None) -> RegistrationResult:
        method, points, viewpoint = _seen(self, source, viewpoint)
        result = register(method, points, target, initial, viewpoint)
        if result.bone is not None or not isinstance(target, PreparedTarget):
            return result
        result = replace(result, warnings=_warnings(result, target, self.config))
        return completed(result, target.surface, clouds.finite_points(points))

    return call  # type: ignore[return-value]  # as a method it is bound


def completed(result: RegistrationResult, bone: Surface, source: Array) -> RegistrationResult:
    """Add bone, source (N, 3), both mm, and the warning of the bone's size, on refusals too."""
    odd = clouds.odd_size(bone)
    return replace(result, bone=bone, source=source, warnings=(*result.warnings, *((odd,) if odd else ())))


def _seen(method: Any, source: Source, viewpoint: Any) -> tuple[Any, ArrayLike, Any]:
    """Choose the method, points and viewpoint for a source; one from several places is bone alone."""
    if isinstance(source, str | Path):
        source = clouds.load(source)
    if not isinstance(source, Surface):
        return method, source, viewpoint
    if source.joined or source.faces is not None:
        alone = getattr(method, "of_bone_alone", lambda: method)  # a collection is that already
        return alone(), source.points, viewpoint
    camera = pinhole.camera_of(source.points) if source.camera is None else source.camera
    return method, source.points, camera if viewpoint is None else viewpoint


def _warnings(result: RegistrationResult, target: PreparedTarget, config: RegistrarConfig) -> tuple[ResultWarning, ...]:
    """Collect the caveats of an accepted pose, known ones first."""
    if not result.ok:
        return result.warnings
    known = errors(config.sensor, 0)
    found = [SENSOR_UNKNOWN] if config.sensor.kind == "unknown" else []
    if known.tracking_mm == 0.0 and known.tracking_deg == 0.0:
        found.append(TRACKING_UNKNOWN)
    if result.inferred_viewpoint is not None:
        place = "{:.0f}, {:.0f}, {:.0f}".format(*result.inferred_viewpoint)
        text = f"The cloud is taken for what a camera at {place} mm saw: as bone alone it gave no pose."
        found.append(ResultWarning("viewpoint_inferred", text, "Give the camera's place as the viewpoint."))
    turn = loosest_turn(result, target.points)
    if turn is not None and turn[1] > LOOSE_DEG:
        text = f"The bone may still turn about {turn[0]} by {turn[1]:.0f} degrees."
        found.append(ResultWarning("turn_loose", text, "Measure places away from that axis."))
    return (*result.warnings, *found)


def loosest_turn(result: RegistrationResult, bone: Array) -> tuple[str, float] | None:
    """Name the axis of the bone (N, 3), mm, with the loosest turn, and its 95 % bound, deg."""
    if result.covariance is None:
        return None
    variances, axes = np.linalg.eigh(result.covariance[3:, 3:])
    turn_deg = np.degrees(WITHIN_95 * result.factor95 * np.sqrt(max(variances[-1], 0.0)))
    return extent.axis_in_words(axes[:, -1], bone), float(turn_deg)
