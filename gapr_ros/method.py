"""The registration method that the node uses unless it is given another one."""

from __future__ import annotations

from typing import Any

from gapr_ros.parameters import NodeParameters


def default_method(parameters: NodeParameters) -> Any:
    """GAPR as it ships: a `Tracker`, or with `track: false` the `Registrar` for every cloud."""
    from gapr_core import Registrar, RegistrarConfig, Tracker

    config = RegistrarConfig(
        min_confidence=parameters.min_confidence, num_threads=parameters.num_threads, seed=parameters.seed
    )
    registrar = Registrar.from_pretrained(config, parameters.device)
    return Tracker(registrar) if parameters.track else registrar
