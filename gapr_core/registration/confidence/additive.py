"""Additive models: a number as the sum of one piecewise linear curve for each feature.

The sum can be read: each feature's share is a line through a few points (Hastie and Tibshirani 1986). A value far
outside the fitted range counts as its edge.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from gapr_core.errors import WeightsError

Array = NDArray[np.float64]
Model = TypeVar("Model")
FORMAT = 3
FIT_AGAIN = "fit it again: python -m gapr_core.calibration --anatomy DIR --out DIR"


@dataclass(frozen=True, eq=False)
class Curve:
    """The contribution of one feature: linear between the knots, constant beyond the first and the last."""

    feature: str  # its name
    knots: Array  # (K,) values of the feature, ascending
    adds: Array  # (K,) contributions at the knots

    def at(self, values: Any) -> Array:
        """Evaluate the contribution at any values (...) of the feature."""
        return np.asarray(np.interp(values, self.knots, self.adds))


@dataclass(frozen=True, eq=False)
class Additive:
    """A constant and one curve for each feature."""

    constant: float
    curves: tuple[Curve, ...]

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the features, in the order of the curves."""
        return tuple(curve.feature for curve in self.curves)

    def contributions(self, features: Mapping[str, float]) -> dict[str, float]:
        """Evaluate each feature's contribution; with the constant their sum is the model's value."""
        return {curve.feature: float(curve.at(features[curve.feature])) for curve in self.curves}

    def value(self, features: Mapping[str, float]) -> float:
        """Sum the contributions of one answer's features."""
        return self.constant + sum(self.contributions(features).values())

    def values(self, table: Array) -> Array:
        """Evaluate (N,) sums for features (N, F) in the order of the curves."""
        columns = [curve.at(column) for curve, column in zip(self.curves, table.T, strict=True)]
        return self.constant + np.sum(columns, axis=0) if columns else np.full(len(table), self.constant)


def as_dict(model: Additive) -> dict[str, Any]:
    """Convert a model to plain lists, for a file."""
    curves = [{"feature": curve.feature, "knots": np.round(curve.knots, 6).tolist(),
               "adds": np.round(curve.adds, 5).tolist()} for curve in model.curves]  # fmt: skip
    return {"constant": round(model.constant, 5), "curves": curves}


def from_dict(data: Mapping[str, Any]) -> Additive:
    """Build the model that `as_dict` wrote; raises ValueError for damaged curves."""
    curves = tuple(Curve(str(c["feature"]), np.array(c["knots"], float), np.array(c["adds"], float))
                   for c in data["curves"])  # fmt: skip
    for curve in curves:
        if curve.knots.shape != curve.adds.shape or curve.knots.ndim != 1 or not len(curve.knots):
            raise ValueError(f"the curve of {curve.feature} has {curve.knots.shape} knots for {curve.adds.shape}")
        if not (np.isfinite(curve.adds).all() and (np.diff(curve.knots) > 0.0).all()):
            raise ValueError(f"the curve of {curve.feature} is not finite, or its knots do not ascend")
    constant = float(data["constant"])
    if not np.isfinite(constant):
        raise ValueError("its constant is not finite")
    return Additive(constant, curves)


def load(path: str | Path, kind: str, build: Callable[[dict[str, Any]], Model]) -> Model:
    """Read a model's JSON file of a kind, for example "confidence", and build the model.

    Raises:
        WeightsError: no such file, a damaged one, or one of another format or kind.
    """
    path = Path(path)
    if not path.is_file():
        raise WeightsError(f"a {kind} model", f"no file {path}", "reinstall the package, or " + FIT_AGAIN)
    try:
        data = json.loads(path.read_text())
        given = data.get("format", 1), data.get("kind", kind)
        if given == (FORMAT, kind):
            return build(data)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise WeightsError(f"a whole {kind} model", f"{path}: {error!r}", FIT_AGAIN) from error
    raise WeightsError(f"a {kind} model of format {FORMAT}", f"{path}: {given[1]} of {given[0]}", FIT_AGAIN)
