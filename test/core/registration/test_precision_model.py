"""What errors of known size say about predicted ones."""

import json

import numpy as np
import pytest

from gapr_core.errors import WeightsError
from gapr_core.registration.confidence.additive import FORMAT, Additive, Curve, as_dict
from gapr_core.registration.uncertainty.error_calibration import PRECISION_FEATURES, SCALE_LIMITS, Precision

FEATURES = dict.fromkeys(PRECISION_FEATURES, 0.0)


def precision(constant=0.2, by="log_tre", confidences=(0.5, 0.9), factors=(1.6, 1.2)):
    """The logarithm of the scale: a constant, and one feature itself between -1 and 1."""
    curves = tuple(
        Curve(each, np.array([-1.0, 1.0]), np.array([-1.0, 1.0]) * (each == by)) for each in PRECISION_FEATURES
    )
    return Precision(Additive(constant, curves), confidences, factors, {})


def test_the_scale_follows_the_features_and_the_predicted_error():
    assert precision().scale(FEATURES, np.exp(0.5)) == pytest.approx(np.exp(0.7))
    assert precision(by="smooth_misfit").scale(FEATURES | {"smooth_misfit": 0.4}, 1.0) == pytest.approx(np.exp(0.6))
    assert [precision(c).scale(FEATURES, 1.0) for c in (-9.0, 9.0)] == list(SCALE_LIMITS)


def test_the_factor_is_linear_in_the_confidence_and_ends_at_its_edges():
    found = [precision().factor95(confidence) for confidence in (0.0, 0.5, 0.6, 0.9, 1.0)]
    assert found == pytest.approx([1.6, 1.6, 1.5, 1.2, 1.2])


def test_unscaled_predictions_are_those_of_the_covariance():
    unscaled = Precision.unscaled()
    assert unscaled.scale(FEATURES, 3.0) == unscaled.factor95(0.2) == unscaled.factor95(0.99) == 1.0


def test_a_model_reads_back_the_same_and_a_wrong_one_is_an_error(tmp_path):
    made = precision()
    data = {"format": FORMAT, "kind": "precision", **as_dict(made.model), "confidences": made.confidences,
            "factors": made.factors, "card": {}}  # fmt: skip
    (tmp_path / "good.json").write_text(json.dumps(data))
    again = Precision.load(tmp_path / "good.json")
    assert again.scale(FEATURES, 1.5) == pytest.approx(made.scale(FEATURES, 1.5), abs=1e-4)
    assert again.factor95(0.7) == pytest.approx(made.factor95(0.7))
    for damage in ({"factors": [1.2, 0.0]}, {"factors": None}, {"factors": [1.2]}, {"confidences": [0.9, 0.5]},
                   {"factors": [1.2, float("inf")]}, {"confidences": [], "factors": []},
                   {"curves": as_dict(made.model)["curves"][1:]}, {"format": 1}):  # fmt: skip
        (tmp_path / "bad.json").write_text(json.dumps(data | damage))
        with pytest.raises(WeightsError, match="bad.json"):
            Precision.load(tmp_path / "bad.json")


def test_what_ships_gives_surer_answers_no_looser_bound():
    factors = [Precision.load().factor95(confidence) for confidence in np.linspace(0.0, 1.0, 21)]
    assert 0.5 < factors[-1] and (np.diff(factors) <= 0.0).all()
