"""GAPR: partial-to-full rigid registration of bones, with a confidence and with refusals.

Heavy parts load when first used: `import gapr_core` takes neither torch, open3d nor numba along.
"""

from __future__ import annotations

from importlib import import_module

from gapr_core.runtime import compiled_code

TYPE_CHECKING = False  # as of typing, which is not loaded here: nothing catches a Ctrl-C that comes meanwhile
if TYPE_CHECKING:  # `X as X`: what mypy --strict takes for exported
    from typing import Any

    from gapr_core.clouds import load as load
    from gapr_core.config import RegistrarConfig as RegistrarConfig
    from gapr_core.config import SensorConfig as SensorConfig
    from gapr_core.errors import ConfigError as ConfigError
    from gapr_core.errors import GaprError as GaprError
    from gapr_core.errors import InvalidPointCloudError as InvalidPointCloudError
    from gapr_core.errors import MethodUnavailableError as MethodUnavailableError
    from gapr_core.errors import WeightsError as WeightsError
    from gapr_core.formats.options import ReadOptions as ReadOptions
    from gapr_core.registration.check_points import check_points as check_points
    from gapr_core.registration.problem.crop import crop_box as crop_box
    from gapr_core.registration.problem.crop import crop_to_pose as crop_to_pose
    from gapr_core.registration.problem.target import PreparedTarget as PreparedTarget
    from gapr_core.registration.registrar import Registrar as Registrar
    from gapr_core.registration.streams.accumulator import Accumulator as Accumulator
    from gapr_core.registration.streams.look_accumulator import LookAccumulator as LookAccumulator
    from gapr_core.registration.streams.tracker import Tracker as Tracker
    from gapr_core.results import LookFit as LookFit
    from gapr_core.results import RegistrationResult as RegistrationResult
    from gapr_core.results import RegistrationStatus as RegistrationStatus
    from gapr_core.surface import Surface as Surface

__version__ = "0.2.0"

_HOMES = {
    "Registrar": "registration.registrar",
    "Tracker": "registration.streams.tracker",
    "Accumulator": "registration.streams.accumulator",
    "LookAccumulator": "registration.streams.look_accumulator",
    "RegistrarConfig": "config",
    "SensorConfig": "config",
    "PreparedTarget": "registration.problem.target",
    "RegistrationResult": "results",
    "RegistrationStatus": "results",
    "LookFit": "results",
    "Surface": "surface",
    "load": "clouds",
    "ReadOptions": "formats.options",
    "check_points": "registration.check_points",
    "crop_box": "registration.problem.crop",
    "crop_to_pose": "registration.problem.crop",
    "GaprError": "errors",
    "InvalidPointCloudError": "errors",
    "ConfigError": "errors",
    "WeightsError": "errors",
    "MethodUnavailableError": "errors",
}
__all__ = [*_HOMES, "__version__"]


compiled_code.find_a_place()


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'gapr_core' has no attribute {name!r}")
    return getattr(import_module(f"gapr_core.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    """List the public names for a notebook, those not loaded yet among them."""
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})
