"""The answer as JSON: the keys of docs/reference/json.md."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gapr_core.config import RegistrarConfig
from gapr_core.results import Patch, RegistrationResult
from gapr_core.runtime import origin


def as_json(result: RegistrationResult) -> dict[str, Any]:
    """The contract of the JSON output: transform is 4x4 row-major, source -> target, mm; null on a refusal."""
    pose, covariance, seen_from = result.T_target_source, result.covariance, result.inferred_viewpoint
    return {
        "transform": None if pose is None else pose.tolist(),
        "confidence": result.confidence,
        "status": str(result.status),
        "covariance": None if covariance is None else covariance.tolist(),
        "centre_mm": None if result.centre_mm is None else np.asarray(result.centre_mm).tolist(),
        "seconds": result.seconds,
        "tre_mm": result.tre_mm,
        "tre95_mm": result.tre95_mm,
        "inlier_ratio": result.inlier_ratio,
        "inferred_viewpoint": None if seen_from is None else np.asarray(seen_from).tolist(),
        "contributions": {name: round(log_odds, 3) for name, log_odds in result.contributions.items()},
        "reason": result.reason,
    }


def made_by(method: str, config: RegistrarConfig) -> dict[str, Any]:
    """What made an answer: the method, whether its confidence is calibrated, the version, settings and weights."""
    from gapr_core.benchmark import methods

    return {"method": method, "calibrated": method in methods.OWN} | origin.of_answers(config)


def guidance_json(result: RegistrationResult, spots: Sequence[Patch]) -> dict[str, Any] | None:
    """The bound over the bone now, and patches in order of what a look there would gain; None where none is known."""
    if result.guidance is None:
        return None
    patches = [
        {"centre_mm": spot.centre.tolist(), "normal": spot.normal.tolist(), "tre95_mm": spot.tre95_mm,
         "rivals_excluded": spot.rivals_excluded, "gain_mm": spot.gain_mm}
        for spot in spots
    ]  # fmt: skip
    return {"now_mm": result.guidance.now_mm, "patches": patches}
