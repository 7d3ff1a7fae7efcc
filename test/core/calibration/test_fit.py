"""The confidence's fit and its judges."""

from dataclasses import replace

import numpy as np
import pytest
from answer_cases import OTHERS_MISFIT, made_answers

from gapr_core.calibration import __main__ as calibration
from gapr_core.calibration import fit as fits
from gapr_core.calibration.answers import answers_of, together
from gapr_core.calibration.fit import Models
from gapr_core.calibration.pairs import HELD_OUT, TWINS
from gapr_core.errors import ConfigError
from gapr_core.registration.confidence.additive import Additive
from gapr_core.registration.confidence.classifier import LARGEST_EVIDENCE, LARGEST_LOG_ODDS, Judgement, joint
from gapr_core.registration.confidence.features import BONE, FEATURES_OF, SCENE


@pytest.fixture(scope="module")
def answers():
    return made_answers(others=0.2)


def test_the_fit_learns_what_separates_right_from_wrong(answers):
    rows = fits.by_group(answers, fits.of_unseen_people(answers), answers.family)
    assert rows["all"]["auroc"] > 0.96 and rows["all"]["ece"] < 0.08
    assert set(rows) == {"all", "laser", "pointer", "ultrasound"}
    assert sum(rows[name]["pairs"] for name in rows if name != "all") == len(answers)


def test_the_evidence_of_the_bone_is_a_likelihood_ratio_whatever_the_mix():
    """Of normal misfits of means 0 and d the log ratio is d^2 / 2 - d x; how many others there are adds nothing."""
    mixes = [made_answers(6000, others=others) for others in (0.1, 0.5)]
    misfit = mixes[0].features[:, FEATURES_OF[BONE].index("smooth_misfit")]
    usual = (misfit > -0.5) & (misfit < 2.5)
    few, many = (fits.numbers(fits.fit(mix), mixes[0])[usual, 1] for mix in mixes)
    assert few.mean() == pytest.approx(many.mean(), abs=0.15)
    for evidence in (few, many):
        slope = np.polyfit(misfit[usual], evidence, 1)[0]
        assert slope == pytest.approx(-OTHERS_MISFIT / np.log(10.0), rel=0.2)


def test_a_wrong_pose_on_the_own_bone_says_nothing_of_the_bone():
    answers = made_answers(3000, others=0.3)
    wrong = ~answers.right & (answers.what == "own")
    features = answers.features.copy()
    features[wrong, FEATURES_OF[BONE].index("smooth_misfit")] = 9.0
    found, expected = (fits.fit(each).bone for each in (replace(answers, features=features), answers))
    value = dict.fromkeys(FEATURES_OF[BONE], 0.5)
    assert found.value(value) == pytest.approx(expected.value(value))


def test_confidences_are_those_of_the_classifier(answers):
    found = fits.of_unseen_people(answers)
    expected = [joint(Judgement(pose, bone), 0.07) for pose, bone in found]
    np.testing.assert_allclose(fits.confidences(found, 0.07), expected)


def test_no_model_judges_a_subject_whose_bone_is_in_any_pair_that_it_was_fitted_on(answers):
    judged = np.zeros(len(answers), dtype=int)
    for fitted, held_out in answers.people_folds():
        known = {person for group, is_in in zip(answers.people, fitted, strict=True) if is_in for person in group}
        own = {group[0] for group, is_in in zip(answers.people, held_out, strict=True) if is_in}
        assert fitted.any() and not known & own
        judged += held_out
    assert (judged == 1).all()


def test_nobody_is_judged_by_a_model_that_learned_from_a_twin(answers):
    twins = sorted(TWINS[0])
    people = tuple((twins[i % len(twins)] if i % 5 == 0 else f"p{i % 30}",) for i in range(len(answers)))
    for fitted, held_out in replace(answers, people=people).people_folds():
        judged = {group[0] for group, is_in in zip(people, held_out, strict=True) if is_in}
        known = {group[0] for group, is_in in zip(people, fitted, strict=True) if is_in}
        assert not (judged & set(twins) and known & set(twins))


@pytest.mark.parametrize("judged_by", [fits.of_unseen_people, fits.of_unseen_families])
def test_the_families_that_are_held_out_are_in_no_fit(answers, monkeypatch, judged_by):
    seen, every_fifth = set(), np.arange(len(answers)) % 5 == 0
    answers = replace(answers, family=np.where(every_fifth, "structured-light", answers.family))
    monkeypatch.setattr(fits, "fit", lambda known: seen.update(known.family))
    monkeypatch.setattr(fits, "numbers", lambda model, judged: np.zeros((len(judged), 2)))
    judged_by(answers)
    assert set(HELD_OUT) <= set(answers.family) and seen == set(answers.family) - set(HELD_OUT)


def test_the_rounds_together_keep_what_each_record_is(answers):
    some, names = answers.of(np.arange(len(answers)) < 5), ("extent", "log_sigma")
    other = replace(some, rounds=np.full(5, "track"), tre_mm=some.tre_mm + 1.0)
    both = together([some.with_features(names), other.with_features(names)])
    assert both.rounds.tolist() == ["search"] * 5 + ["track"] * 5 and both.people == some.people * 2
    assert both.features[:5, 0] == pytest.approx(some.features[:, FEATURES_OF[BONE].index("extent")])
    assert both.tre_mm[5:] == pytest.approx(some.tre_mm + 1.0)


def test_no_model_judges_a_family_that_it_was_fitted_on(answers, monkeypatch):
    seen = []

    def fit_nothing(known):
        seen.append(set(known.family))
        return len(seen)

    monkeypatch.setattr(fits, "fit", fit_nothing)
    monkeypatch.setattr(fits, "numbers", lambda model, judged: np.full((len(judged), 2), float(model)))
    for family, model in zip(answers.family, fits.of_unseen_families(answers)[:, 0].astype(int), strict=True):
        assert family not in seen[model - 1]


def test_a_wrong_pose_counts_where_it_is_accepted_and_no_finding_refuses_it(answers):
    four = answers.of(np.arange(len(answers)) >= len(answers) - 4)
    four = replace(four, right=np.array([True, False, False, False]), refused=np.array([False, False, True, False]))
    row = fits.quality(four, np.array([[3.0, 3.0], [2.5, 3.0], [4.0, 3.0], [0.5, 3.0]]))
    assert (row["wrong"], row["wrong_sure"], row["right_accepted"], row["right_sure"]) == (2, 1, 1.0, 1.0)
    assert row["auroc"] == pytest.approx(2 / 3, abs=1e-4)


def test_numbers_end_where_so_few_records_say_nothing(answers):
    certain = Models(Additive(50.0, ()), Additive(-50.0, ()))
    none = replace(answers, feature_names=(), features=answers.features[:, :0])
    assert fits.numbers(certain, none)[0].tolist() == [LARGEST_LOG_ODDS, -LARGEST_EVIDENCE]


def test_records_become_the_answers_of_a_kind():
    features = {name: float(number) for number, name in enumerate(FEATURES_OF[BONE])}
    record = {"name": "0-1", "family": "L2", "seen_as": "L2", "what": "person", "bone": "tibia", "people": ["a", "b"]}
    wrong = {"features": features, "refusal": "equal rival", "right": False}
    right = wrong | {"refusal": None, "right": True, "nees": 5.0, "true_mm": 1.0, "tre_mm": 2.0, "tre95_mm": 3.0}
    scene = right | {"features": dict.fromkeys(FEATURES_OF[SCENE], 0.5)}
    shape = record | {"name": "0-2", "people": [], "answers": {"search": right, "scene 0": scene, "scene 1": scene}}
    records = [record | {"answers": {"network": wrong, "track": right}}, shape]
    answers = answers_of(records, BONE)
    assert answers.rounds.tolist() == ["network", "track", "search"]
    assert answers.right.tolist() == [False, True, True] and answers.refused.tolist() == [True, False, False]
    assert answers.people == (("a", "b"), ("a", "b"), ("0-2",))
    assert np.isnan(answers.true_mm[0]) and answers.tre95_mm[1] == 3.0
    assert answers.features[0].tolist() == list(range(len(FEATURES_OF[BONE])))
    assert len(answers_of(records, SCENE)) == 2 and len(answers_of(records[:1], SCENE)) == 0


@pytest.mark.parametrize("judged_by", [fits.of_unseen_people, fits.of_unseen_families])
def test_too_few_pairs_for_a_fit_are_one_sentence(answers, judged_by):
    of_one = answers.of(np.arange(len(answers)) == 0)
    with pytest.raises(ConfigError, match="answers of other subjects and sensors.*--count"):
        judged_by(of_one)


@pytest.mark.parametrize("line", ["--count 0", "--count -3"])
def test_a_calibration_without_pairs_is_one_sentence(tmp_path, line):
    with pytest.raises(ConfigError, match="pairs, scenes or streams"):
        calibration.main(["--anatomy", str(tmp_path), "--out", str(tmp_path / "out"), *line.split()])


@pytest.mark.parametrize("split", ["test", "all", "trian"])
def test_nothing_is_fitted_to_test_subjects(tmp_path, capsys, split):
    with pytest.raises(SystemExit):
        calibration.main(["--anatomy", str(tmp_path), "--out", str(tmp_path / "out"), "--split", split])
    assert "train" in capsys.readouterr().err and not (tmp_path / "out").exists()
