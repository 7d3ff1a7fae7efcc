"""The bone and the method: how both are made from the parameters, in a thread where nobody waits."""

from __future__ import annotations

import csv
import math
import threading
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rclpy.task import Future

from gapr_core import clouds
from gapr_core.baselines.base import takes
from gapr_core.errors import ConfigError
from gapr_core.formats.options import ReadOptions
from gapr_core.surface import Surface
from gapr_ros.node.host import Host
from gapr_ros.node.units import MM_PER_M
from gapr_ros.parameters import MOST_LOOKS, NodeParameters

if TYPE_CHECKING:
    from gapr_core import RegistrarConfig

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
        stamp: of the file as it was read; None where it has none.
    """

    path: str
    target: Any
    points_mm: Array
    extent_mm: float
    stamp: tuple[int, int] | None = None

    @property
    def has_changed(self) -> bool:
        """True where another file is there now than the one that was read."""
        return self.stamp is not None and _stamp_of(_expanded(self.path)) not in (None, self.stamp)

    @property
    def file(self) -> str:
        """Its file, without folder."""
        return Path(self.path).name

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
    clouds.warn_of_size(path.name, surface)
    target = method.prepare(surface, units="mm")
    points_mm = _for_display(surface)
    return Model(parameters.model_path, target, points_mm, surface.extent_mm, stamp)


def surface_of(parameters: NodeParameters) -> Surface:
    """Read the bone of `model_path`, mm, by the unit, axes and label given with it.

    Raises:
        GaprError: no path, an unreadable file, or something that cannot be a bone in the unit named.
    """
    options = ReadOptions(axes=parameters.model_axes, labels=labels_of(parameters.model_label))
    return clouds.load(_path(parameters), units=parameters.model_unit, options=options)


def _path(parameters: NodeParameters) -> Path:
    if not parameters.model_path:
        raise ConfigError("model_path", "nothing", "give -p model_path:=/path/to/bone.stl")
    if "://" in parameters.model_path:
        raise ConfigError("model_path: a path", parameters.model_path, "write it without scheme: /path/to/bone.stl")
    return _expanded(parameters.model_path)


def _expanded(path: str) -> Path:
    return Path(path).expanduser()  # a shell leaves the ~ of model_path:=~/bone.stl as it is


def _stamp_of(path: Path) -> tuple[int, int] | None:
    """Return when a file was written, ns, and its size; None if it cannot be read."""
    try:
        seen = path.stat()
    except OSError:
        return None
    return seen.st_mtime_ns, seen.st_size


def labels_of(text: str) -> tuple[str, ...]:
    """Split a parameter at its commas into names or numbers; a name with a comma is in double quotes."""
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


class ShippedMethod:
    """GAPR as it ships: a `Tracker`, with `track: false` the `Registrar`.

    Several clouds are registered as one by an `Accumulator` of either, those of a camera by a `LookAccumulator`.

    `settings_file` is read once. A method with other limits, or for another bone, has the settings of before, whatever
    has become of the file.
    """

    def __init__(self) -> None:
        self._settings: RegistrarConfig | None = None

    def read_again(self) -> None:
        """Read the file with the next method: the node is configured again."""
        self._settings = None

    def __call__(self, parameters: NodeParameters) -> Any:
        """Make a method.

        Raises:
            ConfigError: the file cannot be read, holds what no setting is, or what a parameter decides otherwise.
            WeightsError: `weights` are missing, damaged or of another format.
        """
        from gapr_core import Accumulator, LookAccumulator, Registrar, Tracker

        if self._settings is None:
            settings = _read_settings(parameters.settings_file)
            check_file(settings, parameters, _named_in(parameters.settings_file))
            self._settings = settings
        weights = _expanded(parameters.weights) if parameters.weights else None
        registrar = Registrar.from_pretrained(configured(self._settings, parameters), parameters.device, weights)
        method = Tracker(registrar) if parameters.track else registrar
        if not parameters.collects:
            return method
        if parameters.collects_looks:
            return LookAccumulator(method, min(parameters.accumulate, MOST_LOOKS))
        return Accumulator(method, parameters.accumulate)


def _read_settings(path: str) -> RegistrarConfig:
    """Read the library's settings from a file; without a path return its defaults.

    Raises:
        ConfigError: the file cannot be read, or holds what no setting is.
    """
    from gapr_core import RegistrarConfig
    from gapr_core.runtime import settings

    return settings.load(RegistrarConfig, _expanded(path) if path else None)


def check_file(config: RegistrarConfig, parameters: NodeParameters, named: Collection[str]) -> None:
    """Refuse a file that says something else than the parameters that decide: nothing it says is dropped in silence.

    Args:
        config: what the file says.
        parameters: of the node.
        named: dotted names of the settings that stand in the file.

    Raises:
        ConfigError: such a setting; the text names its parameter.
    """
    said, used = (_decided(each, parameters) for each in (config, configured(config, parameters)))
    for (setting, parameter), value in said.items():
        decides = used[setting, parameter]
        is_alike = math.isclose(value, decides) if isinstance(value, float) else value == decides  # mm of metres round
        if setting in named and not is_alike:
            what = f"{setting} from the node's parameter '{parameter}', which decides ({decides})"
            how = f"set the parameter '{parameter}' so, and leave it out of the file"
            raise ConfigError(what, f"{value} in settings_file", how)


def _named_in(path: str) -> set[str]:
    """Dotted names of all that stands in a YAML file; none without one."""
    from gapr_core.runtime import settings

    waiting: list[tuple[str, Any]] = list(settings.read_yaml(_expanded(path)).items()) if path else []
    names = set()
    while waiting:
        name, value = waiting.pop()
        names.add(name)
        if isinstance(value, dict):
            waiting += [(f"{name}.{key}", inner) for key, inner in value.items()]
    return names


def _decided(config: RegistrarConfig, parameters: NodeParameters) -> dict[tuple[str, str], Any]:
    """Return the settings that parameters decide, by (setting, parameter); some are left to the file."""
    decided: dict[tuple[str, str], Any] = {
        ("sensor.kind", "sensor"): config.sensor.kind,
        ("min_confidence", "min_confidence"): config.min_confidence,
        ("max_tre_mm", "max_tre"): config.max_tre_mm,
        ("guide", "guide"): config.guide,
    }
    if parameters.viewpoint == "none":
        decided["clutter.infer_viewpoint", "viewpoint"] = config.clutter.infer_viewpoint
    return decided


def configured(config: RegistrarConfig, parameters: NodeParameters) -> RegistrarConfig:
    """Put the node's own parameters over the library's settings."""
    is_inferred = config.clutter.infer_viewpoint and parameters.viewpoint != "none"
    clutter = replace(config.clutter, infer_viewpoint=is_inferred)
    return replace(
        config,
        sensor=replace(config.sensor, kind=parameters.sensor),
        clutter=clutter,
        min_confidence=parameters.min_confidence,
        max_tre_mm=parameters.max_tre * MM_PER_M,
        guide=parameters.guide,
    )


class Loader:
    """One bone at a time; all methods belong to the executor's thread.

    The threads are daemons: one that hangs in a file does not keep the process alive.

    Args:
        host: gets the result in the executor's thread.
        method_factory: makes the registration method from the parameters.
    """

    def __init__(self, host: Host, method_factory: Callable[[NodeParameters], Any]) -> None:
        self._host, self._method_factory = host, method_factory
        self._path, self._since = "", 0.0
        self._thread: threading.Thread | None = None

    @property
    def busy(self) -> bool:
        """A bone is being read."""
        return self._thread is not None

    def __str__(self) -> str:
        return f"loading {self._path} for {time.monotonic() - self._since:.0f} s" if self.busy else ""

    def load(self) -> Future:
        """Read and prepare the bone that the parameters name now; the future gets a `Ready`, or the exception.

        It is busy until those have been called who wait for the future (`add_done_callback`).
        """
        done, parameters = Future(), self._host.parameters
        self._path, self._since = parameters.model_path or "no model_path", time.monotonic()
        self._thread = threading.Thread(target=self._run, args=(parameters, done), name="loading", daemon=True)
        self._thread.start()
        if parameters.model_path:
            self._host.ros.get_logger().info(f"loading {self._path}")
        self._host.report()  # that it loads: with a short file nobody would see it otherwise
        return done

    def _run(self, parameters: NodeParameters, done: Future) -> None:
        """Read the bone, in the loading thread."""
        try:
            outcome: Ready | BaseException = make_ready(self._method_factory, parameters)
        except BaseException as error:  # who waits gets a MemoryError too
            outcome = error
        self._host.call_soon(partial(self._finish, done, outcome))

    def _finish(self, done: Future, outcome: Ready | BaseException) -> None:
        try:
            done.set_result(outcome)
        finally:
            self._thread = None
