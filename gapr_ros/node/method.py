"""The registration method that the node uses unless it is given another one."""

from __future__ import annotations

import math
import os
from collections.abc import Collection
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from gapr_core.errors import ConfigError
from gapr_ros.node.units import MM_PER_M
from gapr_ros.parameters import MOST_LOOKS, NodeParameters

if TYPE_CHECKING:
    from gapr_core import RegistrarConfig


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
        """
        from gapr_core import Accumulator, LookAccumulator, Registrar, Tracker

        if self._settings is None:
            settings = read_settings(parameters.settings_file)
            check_file(settings, parameters, _named_in(parameters.settings_file))
            self._settings = settings
        registrar = Registrar.from_pretrained(configured(self._settings, parameters), parameters.device)
        method = Tracker(registrar) if parameters.track else registrar
        if not parameters.collects:
            return method
        if parameters.collects_looks:
            return LookAccumulator(method, min(parameters.accumulate, MOST_LOOKS))
        return Accumulator(method, parameters.accumulate)


def read_settings(path: str) -> RegistrarConfig:
    """The library's settings in a file; no path: its own.

    Raises:
        ConfigError: the file cannot be read, or holds what no setting is.
    """
    from gapr_core import RegistrarConfig
    from gapr_core.runtime import settings

    return settings.load(RegistrarConfig, _expanded(path) or None)


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


def _expanded(path: str) -> str:
    return os.path.expanduser(path)  # a shell leaves the ~ of settings_file:=~/settings.yaml as it is


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
    """What parameters of the node decide, by (setting, parameter); some of them leave it to the file."""
    decided: dict[tuple[str, str], Any] = {
        ("sensor.kind", "sensor"): config.sensor.kind,
        ("min_confidence", "min_confidence"): config.min_confidence,
        ("max_tre_mm", "max_tre"): config.max_tre_mm,
        ("guide", "guide"): config.guide,
        ("num_threads", "num_threads"): config.num_threads,
        ("seed", "seed"): config.seed,
    }
    if parameters.standoff:
        decided["sensor.standoff_mm", "standoff"] = config.sensor.standoff_mm
    if parameters.viewpoint == "none":
        decided["clutter.infer_viewpoint", "viewpoint"] = config.clutter.infer_viewpoint
    if parameters.model_error >= 0.0:
        decided["covariance.model_mm", "model_error"] = config.covariance.model_mm
    return decided


def configured(config: RegistrarConfig, parameters: NodeParameters) -> RegistrarConfig:
    """The library's settings with the node's own parameters over them."""
    sensor = replace(config.sensor, kind=parameters.sensor)
    if parameters.standoff:
        sensor = replace(sensor, standoff_mm=parameters.standoff * MM_PER_M)
    covariance = config.covariance
    if parameters.model_error >= 0.0:
        covariance = replace(covariance, model_mm=parameters.model_error * MM_PER_M)
    is_inferred = config.clutter.infer_viewpoint and parameters.viewpoint != "none"
    clutter = replace(config.clutter, infer_viewpoint=is_inferred)
    return replace(
        config,
        sensor=sensor,
        covariance=covariance,
        clutter=clutter,
        min_confidence=parameters.min_confidence,
        max_tre_mm=parameters.max_tre * MM_PER_M,
        guide=parameters.guide,
        num_threads=parameters.num_threads,
        seed=parameters.seed,
    )
