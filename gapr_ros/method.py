"""The registration method that the node uses unless it is given another one."""

from __future__ import annotations

from typing import Any

from gapr_ros.parameters import NodeParameters


def default_method(parameters: NodeParameters) -> Any:
    """GAPR's Registrar as it ships."""
    from gapr_core import Registrar, RegistrarConfig

    config = RegistrarConfig(
        min_confidence=parameters.min_confidence, num_threads=parameters.num_threads, seed=parameters.seed
    )
    return Registrar.from_pretrained(config, parameters.device)
