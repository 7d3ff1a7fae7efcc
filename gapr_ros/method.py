"""The registration method that the node uses unless it is given another one."""

from __future__ import annotations

from typing import Any

from gapr_ros.parameters import NodeParameters


def default_method(parameters: NodeParameters) -> Any:
    """GAPR's Registrar; `min_confidence` is judged by the node, where it can be changed while running."""
    from gapr_core import Registrar
    from gapr_core.config import RegistrarConfig

    config = RegistrarConfig(min_confidence=0.0, num_threads=parameters.num_threads, seed=parameters.seed)
    return Registrar(config=config)
