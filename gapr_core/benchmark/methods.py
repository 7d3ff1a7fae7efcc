"""Method names of the command line: our own, the baselines, and anybody's `module:factory`."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from gapr_core import baselines
from gapr_core.baselines import RegistrationMethod
from gapr_core.baselines.base import takes
from gapr_core.config import RegistrarConfig
from gapr_core.errors import ConfigError, GaprError
from gapr_core.results import RegistrationResult
from gapr_core.runtime import origin, settings

if TYPE_CHECKING:
    from gapr_core import Registrar

OURS = "gapr"


Maker = Callable[[RegistrarConfig, str | None], RegistrationMethod]


def _from_pretrained(config: RegistrarConfig, weights: str | None) -> RegistrationMethod:
    from gapr_core import Registrar

    return Registrar.from_pretrained(config, weights=weights)


def _search_alone(config: RegistrarConfig, weights: str | None) -> RegistrationMethod:
    from gapr_core import Registrar

    if weights is not None:
        raise ConfigError("weights for a method with a network", "gapr_search", "leave --weights out")
    return _named(Registrar(config), "gapr_search")


def _network_alone(config: RegistrarConfig, weights: str | None) -> RegistrationMethod:
    from gapr_core.registration.registrar import Registrar, pretrained_network

    return _named(Registrar(config, [pretrained_network(weights=weights)]), "gapr_network")


def _named(registrar: Registrar, name: str) -> Registrar:
    registrar.name = name
    return registrar


def _tracker(config: RegistrarConfig, weights: str | None) -> RegistrationMethod:
    from gapr_core import Tracker

    return Tracker.from_pretrained(config, weights=weights)


OWN: dict[str, Maker] = {
    OURS: _from_pretrained,
    "gapr_search": _search_alone,
    "gapr_network": _network_alone,
    "gapr_tracker": _tracker,
}


def _paper_pipeline(weights: str | None) -> RegistrationMethod:
    from gapr_core.benchmark.paper_pipeline import PaperPipeline

    return PaperPipeline(weights) if weights else PaperPipeline()


def _peer(weights: str | None, name: str, pose: str = "own") -> RegistrationMethod:
    """Load a network of others by its module in `gapr_core.benchmark`."""
    from gapr_core.benchmark.peer import Peer

    if weights is None:
        raise ConfigError(f"{name}@WEIGHTS", "no weights", f"train them with python -m gapr_core.training.{name}")
    code = importlib.import_module(f"gapr_core.benchmark.{name}").Checkout.at()
    return Peer(code, weights, pose)


def _refined(make_coarse: Trained, weights: str | None) -> RegistrationMethod:
    coarse = make_coarse(weights)
    return baselines.Refined(coarse, baselines.PointToPlane(), f"{coarse.name}{REFINED}")


PEERS = ("geotransformer", "predator")
REFINED = "+point_to_plane"
Trained = Callable[[str | None], RegistrationMethod]
RAW: dict[str, Trained] = {
    "gapr_paper": _paper_pipeline,
    **{name: partial(_peer, name=name) for name in PEERS},
    **{f"{name}_ransac": partial(_peer, name=name, pose="ransac") for name in PEERS},
}
TRAINED = RAW | {name + REFINED: partial(_refined, maker) for name, maker in RAW.items()}  # NAME, or NAME@WEIGHTS


def _with_weights(name: str) -> tuple[str, str | None]:
    """Split a name such as "gapr_paper@runs/mine/weights.safetensors+point_to_plane" into method and weights.

    Raises:
        ConfigError: no weights after the `@` of a method that takes some, as of a variable that is not set.
    """
    method, has_weights, rest = name.partition("@")
    ending = REFINED if has_weights and rest.endswith(REFINED) else ""
    weights = rest.removesuffix(REFINED) or None
    if has_weights and weights is None and method in (*OWN, *RAW):
        raise ConfigError(f"{method}@WEIGHTS", f"no weights in {name!r}", "name their file, or leave @ out")
    return method + ending, weights


def is_own(name: str) -> bool:
    """Return whether a name is one of our methods, with weights of one's own ("gapr@FILE") or without."""
    return _with_weights(name)[0] in OWN


def names() -> tuple[str, ...]:
    """List every method that has a name: ours, then the baselines."""
    return (*OWN, *TRAINED, *sorted(baselines.REGISTRY))


def check(wanted: Sequence[str]) -> None:
    """Raise `ConfigError` where a name is none of `names()` and no module:factory; nothing is loaded."""
    for name in wanted:
        is_known = name in names() or (_with_weights(name)[0] in (*OWN, *TRAINED) and "@" in name) or ":" in name
        if not is_known:
            raise ConfigError(f"one of {', '.join(names())}, or module:factory", repr(name), "name one of them")


def make(name: str, config: RegistrarConfig | None = None) -> RegistrationMethod:
    """Make a new instance of a method.

    Args:
        name: "gapr" is the `Registrar` with the shipped weights, "gapr@WEIGHTS" with others. "gapr_search" and
            "gapr_network" have one proposer. "gapr_tracker" is a `Tracker`, "gapr_paper" or "gapr_paper@WEIGHTS" the
            paper's pipeline. "geotransformer@WEIGHTS" and "predator@WEIGHTS" are their authors' code (see `peer`).
            Others are baselines of `gapr_core.baselines.REGISTRY`, or "package.module:factory", a callable that returns
            a `RegistrationMethod`.
        config: settings of our own methods.

    Raises:
        ConfigError: for a name that leads nowhere, and for settings where the method has none.
        MethodUnavailableError: a library is missing.
    """
    method, weights = _with_weights(name)
    if method in OWN:
        return OWN[method](config or RegistrarConfig(), weights)
    if config not in (None, RegistrarConfig()):
        raise ConfigError(
            f"settings for one of {', '.join(OWN)}", f"settings for {name}", "leave --config and --set out"
        )
    if method in TRAINED:
        return TRAINED[method](weights)
    if ":" in name:
        return _from_module(*name.split(":", 1))
    check([name])
    return baselines.make(name)


def config_of(name: str, config: RegistrarConfig) -> RegistrarConfig | None:
    """Choose the settings for a method: those given for our own, none for the others."""
    return config if is_own(name) else None


def settings_of(name: str, config: RegistrarConfig) -> str:
    """List the settings that are not the default, as `name=value` with commas."""
    return ", ".join(settings.changes(config)) if is_own(name) else ""


def made_of(name: str) -> str:
    """Hash the weights or the module behind a name; empty for a baseline.

    Of a module only its own file counts, not what it imports, nor its folder where it is a package.
    """
    method, weights = _with_weights(name)
    if method in (*OWN, *TRAINED):
        if weights is None:
            return origin.shipped_weights()
        return _digest_or_none(Path(weights or ""))
    if ":" not in name:
        return ""
    try:
        found = importlib.util.find_spec(name.split(":", 1)[0])
    except Exception:  # whatever its package does when it is imported: `make` says what is wrong
        return ""
    return _digest_or_none(Path(found.origin)) if found and found.origin else ""


def _digest_or_none(path: Path) -> str:
    return origin.digest_of([path]) if path.is_file() else ""


def register(
    method: RegistrationMethod, source: ArrayLike, target: Any, viewpoint: ArrayLike | None
) -> RegistrationResult:
    """Ask a method; pass the camera's place, (3,) mm in the source's frame, if it takes one."""
    if viewpoint is None or not takes(method, "viewpoint"):
        return method.register(source, target)
    return method.register(source, target, viewpoint=viewpoint)  # type: ignore[call-arg]


def _from_module(module: str, factory: str) -> RegistrationMethod:
    try:
        method = getattr(importlib.import_module(module), factory)()
    except GaprError:
        raise
    except Exception as error:  # whatever a module does when it is imported, and a factory when it is called
        is_missing = isinstance(error, ModuleNotFoundError) and error.name == module.partition(".")[0]
        how = "put the folder of its file on PYTHONPATH, or correct the name" if is_missing else "check the name"
        raise ConfigError("module:factory of a method", f"{module}:{factory} ({error})", how) from error
    if not isinstance(method, RegistrationMethod):
        raise ConfigError("a method with name, prepare and register", repr(method), "return one from the factory")
    return method
