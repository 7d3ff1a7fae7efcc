"""The two numbers of an answer: models that can be read, and their product by Bayes' rule."""

import json
import math

import numpy as np
import pytest

from gapr_core.errors import WeightsError
from gapr_core.registration.confidence.additive import FORMAT, Additive, Curve, as_dict
from gapr_core.registration.confidence.classifier import (
    LARGEST_EVIDENCE,
    LARGEST_LOG_ODDS,
    Classifier,
    Judgement,
    bone_probability,
    joint,
)
from gapr_core.registration.confidence.features import BONE, FEATURES_OF, SCENE, SIGNS

USUAL = dict.fromkeys({name for names in FEATURES_OF.values() for name in names}, 0.0)


def model(constant, feature="support"):
    """A constant, and the feature itself between -2 and 2."""
    return Additive(constant, (Curve(feature, np.array([-2.0, 2.0]), np.array([-2.0, 2.0])),))


def made(pose=1.0, bone=0.0):
    scene = model(pose - 3.0, "rival_margin")
    return Classifier({BONE: model(pose), SCENE: scene}, {BONE: model(bone, "extent"), SCENE: model(bone, "extent")})


@pytest.mark.parametrize("evidence", [-2.0, -0.3, 0.0, 1.0, 3.0])
@pytest.mark.parametrize("prior", [0.001, 0.01, 0.3, 0.9])
def test_the_probability_of_this_bone_is_that_of_bayes(evidence, prior):
    this, other = 10.0**evidence * (1.0 - prior), prior
    assert bone_probability(evidence, prior) == pytest.approx(this / (this + other))
    assert joint(Judgement(0.4, evidence), prior) == pytest.approx(this / (this + other) / (1.0 + math.exp(-0.4)))


@pytest.mark.parametrize(("prior", "probability"), [(0.0, 1.0), (1.0, 0.0)])
def test_a_certain_prior_leaves_nothing_to_the_data(prior, probability):
    assert bone_probability(-3.0, prior) == bone_probability(3.0, prior) == probability


def test_each_number_is_of_its_model_and_its_kind():
    classifier = made(pose=1.0, bone=math.log(10.0))
    found = classifier.judge(BONE, USUAL | {"support": -0.5, "extent": 2.0})
    assert found.pose_log_odds == pytest.approx(0.5) and found.contributions == {"support": -0.5}
    assert found.bone_evidence == pytest.approx(1.0 + 2.0 / math.log(10.0)), "natural logarithms become those to 10"
    assert classifier.judge(SCENE, USUAL | {"rival_margin": 1.5}).pose_log_odds == pytest.approx(-0.5)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_no_number_is_surer_than_records_can_show(sign):
    found = made(50.0 * sign, 50.0 * sign).judge(BONE, USUAL)
    assert (found.pose_log_odds, found.bone_evidence) == (sign * LARGEST_LOG_ODDS, sign * LARGEST_EVIDENCE)


def test_a_feature_outside_of_the_fitted_range_counts_as_its_edge_and_none_gives_no_probability():
    far, edge = (made().judge(BONE, USUAL | {"support": value}) for value in (1e6, 2.0))
    assert far.pose_log_odds == edge.pose_log_odds
    assert math.isnan(joint(made().judge(BONE, USUAL | {"support": math.nan}), 0.01))


def written(path, **changes):
    classifier = made()
    data = {
        name: {kind: as_dict(each) for kind, each in getattr(classifier, name).items()} for name in ("pose", "bone")
    }
    data |= {"format": FORMAT, "kind": "confidence", "rho_pose": 0.5, "rho_bone": 0.25, "card": {"pairs": 3}}
    path.write_text(json.dumps(data | changes))
    return path


def test_a_written_model_reads_back_the_same(tmp_path):
    again = Classifier.load(written(tmp_path / "confidence.json"))
    assert (again.rho_pose, again.rho_bone, again.card) == (0.5, 0.25, {"pairs": 3})
    features = dict.fromkeys(USUAL, 0.3)
    for kind in FEATURES_OF:
        found, expected = (each.judge(kind, features) for each in (again, made()))
        assert found.pose_log_odds == pytest.approx(expected.pose_log_odds, abs=1e-4)
        assert found.bone_evidence == pytest.approx(expected.bone_evidence, abs=1e-4)


def of_bone(**changes):
    return {"pose": {kind: as_dict(model(0.0, "extent")) | changes for kind in FEATURES_OF}}


@pytest.mark.parametrize("damage", [
    {"format": 2}, {"kind": "precision"}, {"pose": None}, {"bone": {}}, {"rho_pose": None}, {"card": 1.0},
    {"pose": {BONE: as_dict(model(0.0))}},  # no scene
    {"bone": dict.fromkeys(FEATURES_OF, as_dict(model(0.0, "rival_margin")))},  # of bone alone there is none
    of_bone(constant=None), of_bone(constant=math.nan), of_bone(curves=3), of_bone(curves=[{}]),
    of_bone(curves=[{"feature": "extent", "knots": [0.0, 1.0], "adds": [0.0]}]),
    of_bone(curves=[{"feature": "extent", "knots": [1.0, 0.0], "adds": [0.0, 1.0]}]),
    of_bone(curves=[{"feature": "extent", "knots": [], "adds": []}]),
])  # fmt: skip
def test_another_model_or_a_damaged_one_is_an_error_that_names_the_file(tmp_path, damage):
    with pytest.raises(WeightsError, match="damaged.json.*gapr_core.calibration"):
        Classifier.load(written(tmp_path / "damaged.json", **damage))


@pytest.mark.parametrize("text", [None, "", "{", "[]", "3"])
def test_a_file_that_is_no_model_is_an_error_that_names_it(tmp_path, text):
    if text is not None:
        (tmp_path / "cut.json").write_text(text)
    with pytest.raises(WeightsError, match="cut.json"):
        Classifier.load(tmp_path / "cut.json")


def test_what_ships_is_of_these_features_and_falls_or_rises_as_their_signs_say():
    shipped = Classifier.load()
    assert 0.0 <= shipped.rho_pose <= 1.0 and 0.0 <= shipped.rho_bone <= 1.0
    assert {"command", "commit", "seed", *FEATURES_OF} <= shipped.card.keys()
    assert set(SIGNS) <= set(USUAL) and set(SIGNS.values()) == {1, -1}
    curves = [each for models in (shipped.pose, shipped.bone) for each in models.values()]
    signed = [curve for each in curves for curve in each.curves if curve.feature in SIGNS]
    assert signed and all((SIGNS[curve.feature] * np.diff(curve.adds) >= -1e-9).all() for curve in signed)
