"""The fit of additive models: a convex problem with one solution, so the fit depends on no seed.

Every feature gets a piecewise linear curve over its own quantiles. Its steps from knot to knot are the unknowns. A
ridge keeps them small, a second one keeps neighbouring slopes alike, and a sign bounds them where physics gives one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit

from gapr_core.registration.confidence.additive import Additive, Curve

Array = NDArray[np.float64]
Loss = Callable[[Array], tuple[float, Array]]  # mean loss of the model's values (N,), and its gradient (N,)

QUANTILES = (0.005, 0.05, 0.15, 0.3, 0.5, 0.7, 0.85, 0.95, 0.995)  # knots of a feature's curve
RIDGE = 1.0  # of each step, in records
BENDING = 3.0  # of the difference of neighbouring steps, in records
HUBER = 0.7  # residual in log units from which it counts linearly


@dataclass(frozen=True, eq=False)
class Basis:
    """The steps of all curves over a table of features.

    Attributes:
        names: (F,) features.
        knots: (F,) arrays (K_f,), ascending.
        columns: (N, S) share of each step that a record has taken, 0 to 1; S is the sum of K_f - 1.
        owner: (S,) feature of each step.
    """

    names: tuple[str, ...]
    knots: tuple[Array, ...]
    columns: Array
    owner: NDArray[np.intp]


def basis_of(table: Array, names: tuple[str, ...]) -> Basis:
    """Build steps between the quantiles of each column of (N, F) features."""
    knots = tuple(_knots(column) for column in table.T)
    steps = [np.clip((column[:, None] - at[:-1]) / np.diff(at), 0.0, 1.0)
             for column, at in zip(table.T, knots, strict=True)]  # fmt: skip
    owner = np.repeat(np.arange(len(names)), [len(at) - 1 for at in knots])
    return Basis(names, knots, np.hstack(steps), owner)


def fit_log_odds(table: Array, right: NDArray[np.bool_], names: tuple[str, ...], signs: Mapping[str, int]) -> Additive:
    """Fit the model of the log odds that an answer is right, by penalised maximum likelihood.

    Args:
        table: (N, F) features.
        right: (N,) mask of the right answers; all records weigh the same.
        names: (F,) names of the features.
        signs: +1 for a feature that can only raise the odds as it grows, -1 for one that can only lower them.
    """

    def loss(values: Array) -> tuple[float, Array]:
        return float((np.logaddexp(0.0, values) - right * values).mean()), (expit(values) - right) / len(right)

    return _fit(basis_of(table, names), loss, signs)


def fit_centre(table: Array, wanted: Array, names: tuple[str, ...]) -> Additive:
    """Fit the model of the middle of numbers (N,) by features (N, F), with Huber's loss against outliers."""

    def loss(values: Array) -> tuple[float, Array]:
        off = values - wanted
        inner = np.clip(off, -HUBER, HUBER)
        return float((inner * (off - 0.5 * inner)).mean()), inner / len(off)

    return _fit(basis_of(table, names), loss, {})


def _fit(basis: Basis, loss: Loss, signs: Mapping[str, int]) -> Additive:
    records, steps = basis.columns.shape
    same = np.flatnonzero(basis.owner[1:] == basis.owner[:-1]) if steps else np.empty(0, int)

    def objective(x: Array) -> tuple[float, Array]:
        value, slope = loss(x[0] + basis.columns @ x[1:])
        bend = x[1:][same + 1] - x[1:][same]
        gradient = np.r_[slope.sum(), basis.columns.T @ slope + RIDGE / records * x[1:]]
        np.add.at(gradient, 1 + same + 1, BENDING / records * bend)
        np.add.at(gradient, 1 + same, -BENDING / records * bend)
        return value + 0.5 * (RIDGE * x[1:] @ x[1:] + BENDING * bend @ bend) / records, gradient

    limits = {1: (0.0, None), -1: (None, 0.0), 0: (None, None)}
    bounds = [(None, None), *(limits[signs.get(basis.names[owner], 0)] for owner in basis.owner)]
    found = minimize(objective, np.zeros(1 + steps), jac=True, method="L-BFGS-B", bounds=bounds,
                     options={"maxiter": 2000, "maxfun": 4000, "ftol": 1e-11, "gtol": 1e-8})  # fmt: skip
    return _centred(basis, found.x)


def _centred(basis: Basis, x: Array) -> Additive:
    """Centre the curves on the records: a contribution then compares with the usual one."""
    constant, curves = float(x[0]), []
    for number, (name, knots) in enumerate(zip(basis.names, basis.knots, strict=True)):
        own = basis.owner == number
        usual = float((basis.columns[:, own] @ x[1:][own]).mean())
        curves.append(Curve(name, knots, np.r_[0.0, np.cumsum(x[1:][own])] - usual))
        constant += usual
    return Additive(constant, tuple(curves))


def _knots(column: Array) -> Array:
    """Compute distinct quantiles of a feature (N,); one knot where it never varies."""
    return np.unique(np.round(np.quantile(column, QUANTILES), 6))
