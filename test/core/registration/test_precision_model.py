"""What errors of known size say about predicted ones."""

import json

import numpy as np
import pytest

from gapr_core.errors import WeightsError
from gapr_core.registration.confidence.additive import Additive, Curve, as_dict
from gapr_core.registration.confidence.features import FEATURES
from gapr_core.registration.uncertainty.error_calibration import PRECISION_FEATURES, SCALE_LIMITS, Precision


def curves(name, knots, adds):
    return tuple(Curve(each, np.array(knots), np.array(adds) * (each == name)) for each in PRECISION_FEATURES)


FEATURE_VALUES = dict.fromkeys(FEATURES, 0.0)


def test_the_scale_follows_the_features_and_the_predicted_error():
    by_tre = Precision(Additive(0.2, curves("log_tre", [-1.0, 1.0], [-1.0, 1.0])), 1.1, {})
    assert by_tre.scale(FEATURE_VALUES, np.exp(0.5)) == pytest.approx(np.exp(0.7))
    by_misfit = Precision(Additive(0.2, curves("smooth_misfit", [0.0, 1.0], [0.0, 1.0])), 1.1, {})
    assert by_misfit.scale(FEATURE_VALUES | {"smooth_misfit": 0.4}, 1.0) == pytest.approx(np.exp(0.6))


def test_the_scale_stays_within_its_limits():
    assert [Precision(Additive(c, ()), 1.0, {}).scale(FEATURE_VALUES, 1.0) for c in (-9.0, 9.0)] == list(SCALE_LIMITS)


def test_unscaled_predictions_are_those_of_the_covariance():
    assert Precision.unscaled().scale(FEATURE_VALUES, 3.0) == 1.0 and Precision.unscaled().factor95 == 1.0


def test_a_model_reads_back_the_same_and_a_wrong_one_is_an_error(tmp_path):
    model = Additive(0.2, curves("log_tre", [-1.0, 1.0], [-1.0, 1.0]))
    data = {"format": 2, "kind": "precision", **as_dict(model), "factor95": 1.2, "card": {}}
    (tmp_path / "good.json").write_text(json.dumps(data))
    assert Precision.load(tmp_path / "good.json").scale(FEATURE_VALUES, 1.5) == pytest.approx(
        Precision(model, 1.2, {}).scale(FEATURE_VALUES, 1.5), abs=1e-4
    )
    for damage in ({"factor95": 0.0}, {"factor95": None}, {"curves": data["curves"][1:]}, {"format": 1}):
        (tmp_path / "bad.json").write_text(json.dumps(data | damage))
        with pytest.raises(WeightsError, match="bad.json"):
            Precision.load(tmp_path / "bad.json")
    (tmp_path / "bad.json").write_text(json.dumps(data | {"factor95": float("inf")}))
    with pytest.raises(WeightsError, match="factor95 above 0; got .*inf"):
        Precision.load(tmp_path / "bad.json")


def test_what_ships_loads_and_makes_no_prediction_tiny():
    shipped = Precision.load()
    assert 0.8 < shipped.factor95 < 3.0
