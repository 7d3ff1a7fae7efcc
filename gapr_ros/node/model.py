"""The pre-operative bone: read, scaled, turned and prepared for registration."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gapr_core import clouds
from gapr_core.baselines.base import takes
from gapr_core.errors import ConfigError
from gapr_core.formats.options import ReadOptions
from gapr_core.surface import Surface
from gapr_ros.parameters import NodeParameters

Array = NDArray[np.float64]
DISPLAY_POINTS = 20_000


@dataclass(frozen=True)
class Model:
    """A bone that clouds can be registered to.

    Attributes:
        path: its file.
        target: what the registration method prepared from it.
        points_mm: (M, 3) of the bone in `model_frame`, for display.
        extent_mm: diagonal of its bounding box.
        tree: of `points_mm`.
        stamp: of the file as it was read; None where it has none.
    """

    path: str
    target: Any
    points_mm: Array
    extent_mm: float
    tree: cKDTree
    stamp: tuple[int, int] | None = None

    @property
    def has_changed(self) -> bool:
        """True where another file is there now than the one that was read."""
        return self.stamp is not None and _stamp_of(_expanded(self.path)) not in (None, self.stamp)

    @property
    def file(self) -> str:
        """Its file, without folder."""
        return Path(self.path).name

    @property
    def name(self) -> str:
        """Its file, without folder and ending."""
        return Path(self.path).stem

    def __str__(self) -> str:
        return f"{self.path}: {len(self.target.points)} points, {self.extent_mm:.0f} mm across"


def load_model(method: Any, parameters: NodeParameters) -> Model:
    """Read the bone that the parameters name and prepare it with the registration method.

    Raises:
        GaprError: as `surface_of`.
    """
    path = _path(parameters)
    stamp = _stamp_of(path)
    surface = surface_of(parameters)
    clouds.warn_of_size(path, surface.extent_mm)
    target = method.prepare(surface, units="mm")
    points_mm = _for_display(surface)
    return Model(parameters.model_path, target, points_mm, surface.extent_mm, cKDTree(points_mm), stamp)


def surface_of(parameters: NodeParameters) -> Surface:
    """The bone that `model_path` names, mm, by the unit, axes, label and scale that stand with it.

    Raises:
        GaprError: no path, an unreadable file, or something that cannot be a bone in the unit named.
    """
    options = ReadOptions(axes=parameters.model_axes, labels=labels_of(parameters.model_label))
    surface = clouds.load(_path(parameters), units=parameters.model_unit, options=options)
    return Surface(surface.points * parameters.model_scale, surface.faces, surface.normals)


def _path(parameters: NodeParameters) -> Path:
    if not parameters.model_path:
        raise ConfigError("model_path", "nothing", "give -p model_path:=/path/to/bone.stl")
    if "://" in parameters.model_path:
        raise ConfigError("model_path: a path", parameters.model_path, "write it without scheme: /path/to/bone.stl")
    return _expanded(parameters.model_path)


def _expanded(path: str) -> Path:
    return Path(path).expanduser()  # a shell leaves the ~ of model_path:=~/bone.stl as it is


def _stamp_of(path: Path) -> tuple[int, int] | None:
    """When a file was written, ns, and its size; None where it cannot be read."""
    try:
        seen = path.stat()
    except OSError:
        return None
    return seen.st_mtime_ns, seen.st_size


def labels_of(text: str) -> tuple[str, ...]:
    """The names or numbers of a parameter, with commas between them; a name with a comma in it is in double quotes."""
    words = next(csv.reader([text], skipinitialspace=True), [])
    return tuple(word.strip() for word in words if word.strip())


@dataclass(frozen=True)
class Ready:
    """A registration method with the bone that it has prepared, and the parameters that both were made from."""

    method: Any
    model: Model
    parameters: NodeParameters


def make_ready(method_factory: Callable[[NodeParameters], Any], parameters: NodeParameters) -> Ready:
    """Make the method, read the bone, prepare it, and warm up; seconds, so do it where nobody waits.

    Raises:
        GaprError: as `load_model`, or a method that cannot be made.
    """
    method = method_factory(parameters)
    model = load_model(method, parameters)
    warm_up(method, model, has_place=parameters.names_a_place)
    return Ready(method, model, parameters)


def warm_up(method: Any, model: Model, has_place: bool = False) -> None:
    """Register the bone to itself once, so that no cloud waits for code that is compiled on first use.

    As a camera sees it from three times its extent away, where the place of one is named: that is other code.
    """
    points, options = model.points_mm, {}
    if has_place and takes(method, "viewpoint"):
        options["viewpoint"] = points.mean(axis=0) + [0.0, 0.0, 3.0 * model.extent_mm]
    method.register(points, model.target, **options)
    if hasattr(method, "reset"):
        method.reset()


def _for_display(surface: Surface) -> Array:
    """(N, 3) mm, spread over the surface: the corners of a coarse mesh can be centimetres apart."""
    if surface.faces is not None:
        return surface.sample(DISPLAY_POINTS, np.random.default_rng(0))[0]
    return surface.points[:: max(1, len(surface.points) // DISPLAY_POINTS)]
