"""The pre-operative bone: read, scaled, turned and prepared for registration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_core import clouds
from gapr_core.clouds import Surface
from gapr_core.errors import ConfigError
from gapr_ros.parameters import NodeParameters

Array = NDArray[np.float64]
AXES = {"as_is": np.array([1.0, 1.0, 1.0]), "lps_to_ras": np.array([-1.0, -1.0, 1.0])}  # both are rotations
DISPLAY_POINTS = 20_000


@dataclass(frozen=True)
class Model:
    """A bone that clouds can be registered to.

    Attributes:
        path: its file.
        target: what the registration method prepared from it.
        points_mm: (M, 3) of the bone in `model_frame`, for display.
        extent_mm: diagonal of its bounding box.
    """

    path: str
    target: Any
    points_mm: Array
    extent_mm: float


def load_model(method: Any, parameters: NodeParameters) -> Model:
    """Read the bone that the parameters name and prepare it with the registration method.

    Raises:
        GaprError: no path, an unreadable file, or something that cannot be a bone in the unit named.
    """
    if not parameters.model_path:
        raise ConfigError("model_path", "nothing", "give -p model_path:=/path/to/bone.stl")
    surface = clouds.load(parameters.model_path, units=parameters.model_unit)
    factors = AXES[parameters.model_axes] * parameters.model_scale
    normals = None if surface.normals is None else surface.normals * AXES[parameters.model_axes]
    surface = Surface(surface.points * factors, surface.faces, normals)
    target = method.prepare(surface, units="mm")
    return Model(parameters.model_path, target, _for_display(surface.points), surface.extent_mm)


def warm_up(method: Any, model: Model) -> None:
    """Register the bone to itself once, so that no cloud waits for code that is compiled on first use."""
    method.register(model.points_mm, model.target)


def _for_display(points_mm: Array) -> Array:
    step = max(1, len(points_mm) // DISPLAY_POINTS)
    return points_mm[::step]
