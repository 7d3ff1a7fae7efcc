"""The models that the command writes: what they are fitted to, and how large the bound of the error is."""

import json
from dataclasses import replace

import numpy as np
import pytest
from answer_cases import made_answers

from gapr_core.calibration import __main__ as calibration
from gapr_core.calibration import conformal
from gapr_core.calibration.fit import of_unseen_people


def smallest_that_covers(scores, share):
    return np.sort(scores)[int(np.ceil((len(scores) + 1) * share)) - 1]


def test_only_accepted_answers_with_a_truth_that_no_rule_refuses_say_how_precise_poses_are():
    answers, number = made_answers(600), np.arange(600)
    true_mm = np.where(number % 5 == 0, np.nan, answers.true_mm)
    answers = replace(answers, refused=number % 3 == 0, true_mm=true_mm)
    expected = (of_unseen_people(answers) >= 0.5) & (number % 3 != 0) & (number % 5 != 0)
    assert 100 < expected.sum() < 300
    assert calibration.accepted(answers).names.tolist() == answers.names[expected].tolist()


@pytest.mark.parametrize(("count", "pointers", "decides"), [(900, 300, "overall"), (2400, 72, "in each")])
def test_the_bound_covers_all_answers_of_unseen_sensors_and_each_sensor_of_unseen_subjects(count, pointers, decides):
    answers = made_answers(count, error_scale=lambda features, family: np.where(family == "pointer", 3.0, 1.0))
    is_pointer = answers.family == "pointer"
    answers = answers.of(~is_pointer | (np.cumsum(is_pointer) <= pointers))
    if decides == "in each":  # few enough to be left out of 95.5 % of all
        answers = replace(answers, family=np.where(answers.family == "laser", "waves", answers.family))
    _, factor, card = calibration.fit_precision([answers])
    used = calibration.accepted(answers).with_features(calibration.SHARED)
    known = used.family != "laser"
    new_sensor = conformal.scales_of_unseen_families(used, known)
    new_subject = conformal.scales_of_unseen_people(used, known)
    by_sensor, by_subject = (used.true_mm / (scale * used.tre95_mm) for scale in (new_sensor, new_subject))
    overall = smallest_that_covers(by_sensor[known], 0.955)
    in_each = max(smallest_that_covers(by_subject[used.family == name], 0.91) for name in np.unique(used.family[known]))
    assert (overall > 1.2 * in_each) if decides == "overall" else (in_each > 1.2 * overall)
    assert factor == pytest.approx(max(overall, in_each))
    assert card["accepted"] == len(used)
    for rows, scale in (("coverage", new_subject), ("coverage_unseen_families", new_sensor)):
        covered = used.true_mm <= factor * scale * used.tre95_mm
        assert card[rows]["pointer"]["covered"] == pytest.approx(covered[used.family == "pointer"].mean(), abs=1e-4)


def test_sensors_that_are_held_out_change_no_model_and_no_bound(tmp_path):
    answers = made_answers(600, error_scale=lambda features, family: np.where(family == "laser", 5.0, 1.0))
    is_held_out = answers.family == "laser"
    answers = replace(answers, right=answers.right ^ is_held_out)
    records = records_of(answers)
    written = {}
    for name, of_it in (("with", np.full(600, True)), ("without", ~is_held_out)):
        (tmp_path / name).mkdir()
        cards = calibration.write_models([records[number] for number in np.flatnonzero(of_it)], tmp_path / name, {})
        models = {path.name: json.loads(path.read_text()) for path in (tmp_path / name).iterdir()}
        assert cards["search"]["pairs"] == of_it.sum() and ("laser" in cards["precision"]["coverage"]) == of_it.all()
        written[name] = {name: model | {"card": None} for name, model in models.items()}
    assert set(written["with"]) == {"confidence_search.json", "precision.json"}
    assert written["with"] == written["without"]


def records_of(answers):
    """Of one round, as `collect` keeps them."""
    return [
        {"name": str(answers.names[k]), "family": str(answers.family[k]), "seen_as": "L2", "what": "own",
         "bone": "femur", "people": list(answers.people[k]), "answers": {"search": {
             "features": dict(zip(answers.feature_names, answers.features[k].tolist(), strict=True)), "refusal": None,
             "right": bool(answers.right[k]), "true_mm": answers.true_mm[k], "tre_mm": answers.tre_mm[k],
             "tre95_mm": answers.tre95_mm[k], "nees": answers.nees[k]}}}
        for k in range(len(answers))
    ]  # fmt: skip
