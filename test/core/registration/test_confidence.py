"""The confidence: a model that can be read, for one proposer's answers only."""

import json
import math

import numpy as np
import pytest

from gapr_core.errors import MethodUnavailableError, WeightsError
from gapr_core.registration.confidence.additive import Additive, Curve, as_dict
from gapr_core.registration.confidence.classifier import CALIBRATIONS, Calibration
from gapr_core.registration.confidence.features import FEATURES, FEATURES_OF


@pytest.fixture
def model():
    """Log odds 1 + margin between -2 and 2, one more for each feature that has come up in the list."""
    curves = [Curve(name, np.array([-2.0, 2.0]), np.array([-2.0, 2.0]) * (name == "margin")) for name in FEATURES]
    return Additive(1.0, tuple(curves))


def written(path, model, **changes):
    data = {"format": 2, "kind": "confidence", "proposer": "search", **as_dict(model), "card": {"pairs": 3}} | changes
    path.write_text(json.dumps(data))
    return path


def test_the_probability_is_that_of_the_log_odds(model):
    calibration = Calibration("search", model, {})
    usual = dict.fromkeys(FEATURES, 0.0)
    assert calibration.probability(usual) == pytest.approx(1.0 / (1.0 + math.exp(-1.0)))
    assert calibration.probability(usual | {"margin": -1.0}) == pytest.approx(0.5)
    assert calibration.probability(usual | {"margin": -2.0}) == pytest.approx(1.0 / (1.0 + math.exp(1.0)))


@pytest.mark.parametrize("log_odds", [50.0, -50.0])
def test_no_probability_is_surer_than_records_can_show(model, log_odds):
    found = Calibration("search", Additive(log_odds, model.curves), {}).probability(dict.fromkeys(FEATURES, 0.0))
    assert found == pytest.approx(1.0 / (1.0 + math.exp(-math.copysign(9.0, log_odds))), rel=1e-9)


def test_contributions_say_what_speaks_for_and_against(model):
    contributions = Calibration("search", model, {}).contributions(dict.fromkeys(FEATURES, 0.0) | {"margin": -1.5})
    assert contributions == {name: -1.5 if name == "margin" else 0.0 for name in FEATURES}


def test_a_feature_outside_of_the_fitted_range_counts_as_its_edge(model):
    calibration = Calibration("search", model, {})
    usual = dict.fromkeys(FEATURES, 0.0)
    assert calibration.probability(usual | {"margin": 1e6}) == calibration.probability(usual | {"margin": 2.0})
    assert calibration.probability(usual | {"support": -1e9}) == calibration.probability(usual)


def test_a_feature_that_is_no_number_gives_no_probability(model):
    assert math.isnan(Calibration("search", model, {}).probability(dict.fromkeys(FEATURES, math.nan)))


def test_a_written_model_reads_back_the_same(model, tmp_path):
    again = Calibration.load(written(tmp_path / "confidence.json", model))
    features = dict.fromkeys(FEATURES, 0.3)
    assert again.proposer == "search" and again.card == {"pairs": 3}
    assert again.probability(features) == pytest.approx(Calibration("", model, {}).probability(features), abs=1e-5)


def test_a_model_of_an_older_format_says_so(model, tmp_path):
    old = tmp_path / "old.json"
    old.write_text(json.dumps({"names": FEATURES, "card": {}, "means": [], "scales": [], "layers": []}))
    with pytest.raises(WeightsError, match="of format 2.*python -m gapr_core.calibration"):
        Calibration.load(old)
    with pytest.raises(WeightsError, match="confidence model of format 2"):
        Calibration.load(written(tmp_path / "other.json", model, kind="precision"))


def test_a_missing_model_and_one_of_other_features_are_errors(model, tmp_path):
    with pytest.raises(WeightsError, match="reinstall"):
        Calibration.load(tmp_path / "none.json")
    fewer = Additive(0.0, model.curves[1:])
    with pytest.raises(WeightsError, match="fit it again"):
        Calibration.load(written(tmp_path / "fewer.json", fewer))
    for swapped in ((*model.curves[1:], model.curves[0]), model.curves[::-1]):
        with pytest.raises(WeightsError, match="fit it again"):
            Calibration.load(written(tmp_path / "swapped.json", Additive(0.0, swapped)))


@pytest.mark.parametrize("damage", [
    {"constant": None}, {"constant": float("nan")}, {"curves": 3}, {"curves": [{}]}, {"card": 1.0},
    {"curves": [{"feature": "margin", "knots": [0.0, 1.0], "adds": [0.0]}]},
    {"curves": [{"feature": "margin", "knots": [1.0, 0.0], "adds": [0.0, 1.0]}]},
    {"curves": [{"feature": "margin", "knots": [], "adds": []}]},
])  # fmt: skip
def test_a_damaged_model_is_an_error_that_names_the_file(model, tmp_path, damage):
    with pytest.raises(WeightsError, match="damaged.json"):
        Calibration.load(written(tmp_path / "damaged.json", model, **damage))


@pytest.mark.parametrize("text", ["", "{", "[]", "3"])
def test_a_file_that_is_no_model_is_an_error_that_names_it(tmp_path, text):
    (tmp_path / "cut.json").write_text(text)
    with pytest.raises(WeightsError, match="cut.json"):
        Calibration.load(tmp_path / "cut.json")


def test_a_proposer_without_a_fitted_confidence_gets_nobody_elses():
    with pytest.raises(MethodUnavailableError, match="'my_own'.*network, search, track, scene.*gapr_core.calibration"):
        Calibration.shipped("my_own")


@pytest.mark.parametrize("proposer", CALIBRATIONS)
def test_what_ships_is_of_these_features_and_of_its_proposer(proposer):
    shipped = Calibration.shipped(proposer)
    assert shipped.proposer == proposer and shipped.model.features == FEATURES_OF[proposer]
    assert {"pairs", "command", "commit", "seed", "unseen_subjects", "unseen_families"} <= shipped.card.keys()
