"""The models that the command writes: what they are fitted to, and how large the bound of the error is."""

import json
from dataclasses import replace

import numpy as np
import pytest
from answer_cases import made_answers, records_of

from gapr_core.calibration import __main__ as calibration
from gapr_core.calibration import conformal
from gapr_core.calibration.fit import confidences, of_unseen_people
from gapr_core.errors import ConfigError
from gapr_core.registration.confidence.classifier import Classifier
from gapr_core.registration.confidence.features import FEATURES_OF
from gapr_core.registration.uncertainty.error_calibration import Precision


def test_only_right_answers_that_are_accepted_and_that_no_finding_refuses_say_how_precise_poses_are(tmp_path):
    expected, records = 0, []
    for kind in FEATURES_OF:
        answers = replace(made_answers(900, kind=kind, others=0.2), refused=np.arange(900) % 3 == 0)
        chosen = (confidences(of_unseen_people(answers)) >= 0.5) & ~answers.refused & answers.right
        expected, records = expected + int(chosen.sum()), records + records_of(answers)
    cards = calibration.write_models(records, tmp_path, {})
    assert cards["precision"]["accepted"] == expected > 300
    classifier, precision = Classifier.load(tmp_path / "confidence.json"), Precision.load(tmp_path / "precision.json")
    assert set(classifier.pose) == set(classifier.bone) == set(FEATURES_OF)
    assert (classifier.rho_pose, classifier.rho_bone) == (0.8, 0.8), "of no stream"
    assert len(precision.factors) == len(precision.confidences)


def test_a_kind_without_answers_is_one_sentence(tmp_path):
    with pytest.raises(ConfigError, match="answers of the kind 'scene'.*collect more"):
        calibration.write_models(records_of(made_answers(300, others=0.2)), tmp_path, {})


def test_the_bound_is_that_of_answers_whose_subject_no_model_had_seen():
    answers = made_answers(1200, error_scale=lambda features, family: np.where(family == "pointer", 3.0, 1.0))
    answers = answers.with_features(calibration.SHARED)
    confidence = np.random.default_rng(3).uniform(0.5, 1.0, 1200)
    data, card = calibration.fit_precision([(answers, confidence)])
    known = answers.family != "laser"
    by_subject, by_sensor = (
        scales(answers, known) for scales in (conformal.scales_of_unseen_people, conformal.scales_of_unseen_families)
    )
    scores = answers.true_mm / (by_subject * answers.tre95_mm)
    at, factors = conformal.factors(scores[known], confidence[known], answers.family[known])
    assert data["confidences"] == pytest.approx(at, abs=1e-4) and data["factors"] == pytest.approx(factors, abs=1e-4)
    factor = np.interp(confidence, at, factors)
    for rows, scale in (("coverage", by_subject), ("coverage_unseen_families", by_sensor)):
        covered = answers.true_mm <= factor * scale * answers.tre95_mm
        of_pointers = covered[answers.family == "pointer"]
        assert card[rows]["pointer"]["covered"] == pytest.approx(of_pointers.mean(), abs=1e-4)


def test_sensors_that_are_held_out_change_no_model_and_no_bound(tmp_path):
    records, written = [], {}
    for kind in FEATURES_OF:
        answers = made_answers(
            600, kind=kind, others=0.2, error_scale=lambda features, family: np.where(family == "laser", 5.0, 1.0)
        )
        records += records_of(replace(answers, right=answers.right ^ (answers.family == "laser")))
    for name, of_it in (("with", records), ("without", [each for each in records if each["family"] != "laser"])):
        (tmp_path / name).mkdir()
        cards = calibration.write_models(of_it, tmp_path / name, {})
        models = {path.name: json.loads(path.read_text()) for path in (tmp_path / name).iterdir()}
        assert ("laser" in cards["precision"]["coverage"]) is (name == "with")
        written[name] = {name: model | {"card": None} for name, model in models.items()}
    assert set(written["with"]) == {"confidence.json", "precision.json"}
    assert written["with"] == written["without"]
