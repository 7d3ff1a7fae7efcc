"""The fit of additive models, on data whose answer is known."""

import numpy as np
import pytest
from scipy.special import expit

from gapr_core.calibration.additive import fit_centre, fit_log_odds
from gapr_core.metrics.confidence import expected_calibration_error

NAMES = ("a", "b", "c")


@pytest.fixture(scope="module")
def world():
    """Log odds 2 a - |b|; c says nothing."""
    rng = np.random.default_rng(0)
    table = rng.normal(size=(6000, 3))
    return table, rng.random(6000) < expit(2.0 * table[:, 0] - np.abs(table[:, 1]))


def test_the_curves_are_those_of_the_world(world):
    model = fit_log_odds(*world, NAMES, {})
    a, b, c = model.curves
    assert a.at(1.0) - a.at(-1.0) == pytest.approx(4.0, rel=0.15)
    assert b.at(0.0) - b.at(1.5) == pytest.approx(1.5, abs=0.4)
    assert b.at(0.0) - b.at(-1.5) == pytest.approx(1.5, abs=0.4)
    assert np.ptp(c.adds) < 0.6


def test_the_probabilities_are_probabilities_on_records_that_were_not_fitted(world):
    table, right = world
    model = fit_log_odds(table[:4000], right[:4000], NAMES, {})
    assert expected_calibration_error(expit(model.values(table[4000:])), right[4000:]) < 0.035


def test_a_sign_holds_where_the_data_say_otherwise(world):
    model = fit_log_odds(*world, NAMES, {"a": -1})
    assert (np.diff(model.curves[0].adds) <= 0.0).all()
    assert (np.diff(fit_log_odds(*world, NAMES, {"a": 1}).curves[0].adds) >= 0.0).all()


def test_the_same_records_in_another_order_give_the_same_model(world):
    table, right = world
    order = np.random.default_rng(1).permutation(len(right))
    first, second = fit_log_odds(table, right, NAMES, {}), fit_log_odds(table[order], right[order], NAMES, {})
    assert np.abs(first.values(table) - second.values(table)).max() < 1e-3


def test_no_record_counts_more_than_another(world):
    table, right = world
    model = fit_log_odds(table, right, NAMES, {})
    assert expit(model.values(table)).mean() == pytest.approx(right.mean(), abs=1e-4)


def test_a_contribution_is_none_on_the_average_and_they_add_up_to_the_value(world):
    table, right = world
    model = fit_log_odds(table, right, NAMES, {})
    assert all(abs(curve.at(column).mean()) < 1e-9 for curve, column in zip(model.curves, table.T, strict=True))
    one = dict(zip(NAMES, table[7], strict=True))
    assert model.constant + sum(model.contributions(one).values()) == pytest.approx(model.values(table[7:8])[0])
    assert model.value(one) == pytest.approx(model.values(table[7:8])[0])


def test_a_feature_that_never_varies_adds_nothing(world):
    table, right = world
    model = fit_log_odds(np.column_stack([table[:, :2], np.full(len(table), 0.7)]), right, NAMES, {})
    assert model.curves[2].at([-5.0, 0.7, 5.0]).tolist() == [0.0, 0.0, 0.0]


def test_the_middle_of_numbers_is_found_in_spite_of_outliers():
    rng = np.random.default_rng(2)
    table = rng.uniform(-1.0, 1.0, (3000, 2))
    wanted = 0.5 * table[:, 0] + rng.normal(0.0, 0.2, 3000)
    wanted[::50] += 20.0
    model = fit_centre(table, wanted, ("a", "b"))
    assert model.curves[0].at(0.8) - model.curves[0].at(-0.8) == pytest.approx(0.8, abs=0.1)
    assert np.median(wanted - model.values(table)) == pytest.approx(0.0, abs=0.04)
