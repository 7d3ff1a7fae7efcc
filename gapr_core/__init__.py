"""GAPR: partial-to-full rigid registration of bones, with a confidence and with refusals.

Heavy parts load when first used: `import gapr_core` takes neither torch, open3d nor numba along.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from gapr_core.runtime import compiled_code

if TYPE_CHECKING:
    from gapr_core.clouds import load
    from gapr_core.config import RegistrarConfig, SensorConfig
    from gapr_core.errors import ConfigError, GaprError, InvalidPointCloudError, MethodUnavailableError, WeightsError
    from gapr_core.formats.options import ReadOptions
    from gapr_core.registration.check_points import check_points
    from gapr_core.registration.problem.crop import crop_box, crop_to_pose
    from gapr_core.registration.problem.target import PreparedTarget
    from gapr_core.registration.registrar import Registrar
    from gapr_core.registration.streams.accumulator import Accumulator
    from gapr_core.registration.streams.following import FollowedPose
    from gapr_core.registration.streams.look_accumulator import LookAccumulator
    from gapr_core.registration.streams.tracker import Tracker
    from gapr_core.results import LookFit, RegistrationResult, RegistrationStatus
    from gapr_core.surface import Surface

__version__ = "0.2.0"

_HOMES = {
    "Registrar": "registration.registrar",
    "Tracker": "registration.streams.tracker",
    "Accumulator": "registration.streams.accumulator",
    "LookAccumulator": "registration.streams.look_accumulator",
    "FollowedPose": "registration.streams.following",
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
    """What a notebook offers after `gapr_core.`: the public names, those not loaded yet among them."""
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})
