"""An answer read back from JSON, and its makers: the keys of docs/reference/json.md."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.config import RegistrarConfig
from gapr_core.errors import ConfigError
from gapr_core.geometry import se3
from gapr_core.results import RegistrationResult, RegistrationStatus
from gapr_core.runtime import files, origin


def read_json(path: Path) -> RegistrationResult:
    """Read the accepted pose that `RegistrationResult.to_json` wrote, with its covariance.

    Raises:
        ConfigError: no such file, another one, or an answer without a pose.
    """
    how = "give a file that gapr register --json wrote"
    found = files.read_json(path, "the answer of a registration", how)
    try:
        status = RegistrationStatus(found["status"])
        transform, covariance, centre = (found[key] for key in ("transform", "covariance", "centre_mm"))
        factor95, confidence = float(found["factor95"]), float(found.get("confidence", 0.0))
        if not (0.0 < factor95 < np.inf and 0.0 <= confidence <= 1.0):
            raise ValueError(f"factor95 {factor95:g} and confidence {confidence:g}")
    except (ValueError, KeyError, TypeError) as error:
        given = f"no {error} in it" if isinstance(error, KeyError) else str(error)
        raise ConfigError(f"the answer of a registration in {path}", given, how) from error
    if status is not RegistrationStatus.OK or covariance is None or centre is None:
        why = f"{status}: {found.get('reason') or 'without a covariance'}"
        raise ConfigError(f"an accepted pose with its covariance in {path}", why, "register again, then check")
    T, C, middle = _array(transform, (4, 4), path), _array(covariance, (6, 6), path), _array(centre, (3,), path)
    if why := se3.why_not_rigid(T):
        raise ConfigError(f"a rigid transform in {path}", f"a matrix whose {why}", how)
    return RegistrationResult(status, T, C, confidence, centre_mm=middle, factor95=factor95)


def _array(values: Any, shape: tuple[int, ...], path: Path) -> NDArray[np.float64]:
    try:
        array = np.asarray(values, dtype=np.float64)
    except (ValueError, TypeError) as error:
        raise ConfigError(f"numbers {shape} in {path}", str(error), "give a file that gapr register wrote") from error
    if array.shape != shape or not np.isfinite(array).all():
        raise ConfigError(f"finite numbers {shape} in {path}", str(array.shape), "give a file that gapr register wrote")
    return array


def made_by(method: str, config: RegistrarConfig) -> dict[str, Any]:
    """Name the makers of an answer: method, calibration of its confidence, version, settings and weights."""
    from gapr_core.benchmark import methods

    by = {"method": method, "calibrated": method in methods.OWN, "weights": methods.made_of(method)}
    return origin.of_answers(config) | by
