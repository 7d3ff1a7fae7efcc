"""Method names of the command line: our own, the baselines, and anybody's `module:factory`."""

from __future__ import annotations

import importlib

from gapr_core import baselines
from gapr_core.baselines import RegistrationMethod
from gapr_core.errors import ConfigError

OURS = "gapr"


def _from_pretrained() -> RegistrationMethod:
    from gapr_core import Registrar

    return Registrar.from_pretrained()


def _search_alone() -> RegistrationMethod:
    from gapr_core import Registrar

    return Registrar()


def _network_alone() -> RegistrationMethod:
    from gapr_core import Registrar
    from gapr_core.proposals.network import NetworkProposer

    return Registrar(proposers=[NetworkProposer.from_weights()])


OWN = {OURS: _from_pretrained, "gapr_search": _search_alone, "gapr_network": _network_alone}


def make(name: str) -> RegistrationMethod:
    """A new instance of a method.

    Args:
        name: "gapr" (the `Registrar` with the shipped weights), "gapr_search" and "gapr_network" (with one of its two
            proposers alone), a baseline of `gapr_core.baselines.REGISTRY`, or
            "package.module:factory" for a callable without arguments that returns a `RegistrationMethod`.

    Raises:
        ConfigError: for a name that leads nowhere.
    """
    if name in OWN:
        return OWN[name]()
    if ":" in name:
        return _from_module(*name.split(":", 1))
    return baselines.make(name)


def _from_module(module: str, factory: str) -> RegistrationMethod:
    try:
        method = getattr(importlib.import_module(module), factory)()
    except (ImportError, AttributeError) as error:
        raise ConfigError("module:factory of a method", f"{module}:{factory} ({error})", "check the name") from error
    if not isinstance(method, RegistrationMethod):
        raise ConfigError("a method with name, prepare and register", repr(method), "return one from the factory")
    return method
