"""The registration method that the node uses unless it is given another one."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from gapr_ros.node.wire import MM_PER_M
from gapr_ros.parameters import NodeParameters

if TYPE_CHECKING:
    from gapr_core import RegistrarConfig


class ShippedMethod:
    """GAPR as it ships: a `Tracker`, with `track: false` the `Registrar`; an `Accumulator` of either on demand.

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
            ConfigError: the file cannot be read, or holds what no setting is.
        """
        from gapr_core import Accumulator, Registrar, Tracker

        if self._settings is None:
            self._settings = read_settings(parameters.settings_file)
        registrar = Registrar.from_pretrained(configured(self._settings, parameters), parameters.device)
        method = Tracker(registrar) if parameters.track else registrar
        return Accumulator(method, parameters.accumulate) if parameters.accumulate > 1 else method


def read_settings(path: str) -> RegistrarConfig:
    """The library's settings in a file; no path: its own.

    Raises:
        ConfigError: the file cannot be read, or holds what no setting is.
    """
    from gapr_core import RegistrarConfig
    from gapr_core.runtime import settings

    return settings.load(RegistrarConfig, path or None)


def configured(config: RegistrarConfig, parameters: NodeParameters) -> RegistrarConfig:
    """The library's settings with the node's own parameters over them."""
    sensor = config.sensor if parameters.sensor == "unknown" else replace(config.sensor, kind=parameters.sensor)
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
