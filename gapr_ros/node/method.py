"""The registration method that the node uses unless it is given another one."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from gapr_ros.node.wire import MM_PER_M
from gapr_ros.parameters import NodeParameters

if TYPE_CHECKING:
    from gapr_core import RegistrarConfig


def default_method(parameters: NodeParameters) -> Any:
    """GAPR as it ships: a `Tracker`, with `track: false` the `Registrar`; an `Accumulator` of either on demand."""
    from gapr_core import Accumulator, Registrar, Tracker

    registrar = Registrar.from_pretrained(configured(parameters), parameters.device)
    method = Tracker(registrar) if parameters.track else registrar
    return Accumulator(method, parameters.accumulate) if parameters.accumulate > 1 else method


def configured(parameters: NodeParameters) -> RegistrarConfig:
    """The library's settings: those of `settings_file`, with the node's own parameters over them.

    Raises:
        ConfigError: the file cannot be read, or holds what no setting is.
    """
    from gapr_core import RegistrarConfig
    from gapr_core.runtime import settings

    config = settings.load(RegistrarConfig, parameters.settings_file or None)
    sensor = config.sensor if parameters.sensor == "unknown" else replace(config.sensor, kind=parameters.sensor)
    if parameters.standoff:
        sensor = replace(sensor, standoff_mm=parameters.standoff * MM_PER_M)
    return replace(
        config,
        sensor=sensor,
        min_confidence=parameters.min_confidence,
        max_tre_mm=parameters.max_tre * MM_PER_M,
        guide=parameters.guide,
        num_threads=parameters.num_threads,
        seed=parameters.seed,
    )
