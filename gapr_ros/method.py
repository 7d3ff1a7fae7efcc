"""The registration method that the node uses unless it is given another one."""

from __future__ import annotations

from typing import Any

from gapr_ros.parameters import NodeParameters


def default_method(parameters: NodeParameters) -> Any:
    """GAPR as it ships: a `Tracker`, with `track: false` the `Registrar`; an `Accumulator` of either on demand."""
    from gapr_core import Accumulator, Registrar, RegistrarConfig, Tracker

    config = RegistrarConfig(
        min_confidence=parameters.min_confidence, num_threads=parameters.num_threads, seed=parameters.seed
    )
    registrar = Registrar.from_pretrained(config, parameters.device)
    method = Tracker(registrar) if parameters.track else registrar
    return Accumulator(method, parameters.accumulate) if parameters.accumulate > 1 else method
