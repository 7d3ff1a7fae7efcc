"""`benchmarks/trust.py`: its numbers, on records made by hand."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import trust
from benchmark_cases import make_pair, ok, record, shifted
from scipy.stats import chi2

from gapr_core.benchmark import records
from gapr_core.errors import ConfigError
from gapr_core.results import Hypothesis, RegistrationResult, RegistrationStatus


def answered(seed, off_mm, confidence, bound_mm, accepted=True, protocol="L1", settings=""):
    """A pose that is off by so much, with a bound; refused, it is only the best hypothesis."""
    pair = make_pair(seed, protocol)
    T = shifted(pair, off_mm) if pair.has_truth else np.eye(4)
    answer = ok(T, confidence, np.diag([1.0] * 3 + [1e-4] * 3))
    if not accepted:
        hypotheses = (Hypothesis(T, confidence),)
        answer = RegistrationResult(RegistrationStatus.AMBIGUOUS, confidence=confidence, hypotheses=hypotheses)
    made = record(pair, answer, "gapr")
    return replace(made, predicted_tre95_mm=bound_mm if accepted else None, settings=settings)


@pytest.fixture
def mix():
    """L1: right at .9 and .8, of which one bound holds, and a right pose refused at .3; L2: a slide; one wrong pair."""
    return [
        answered(0, 1.0, 0.9, 2.0),
        answered(1, 3.0, 0.8, 2.0),
        answered(2, 1.0, 0.3, 0.0, accepted=False),
        answered(3, 30.0, 0.95, 3.0, protocol="L2"),
        answered(4, 0.0, 0.2, 5.0, accepted=False, protocol="wrong"),
        answered(5, 0.0, 0.6, 5.0, protocol="wrong"),
    ]


def cells(table):
    """Name of the row to the other cells."""
    rows = [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in table.splitlines()[2:]]
    return {first: rest for first, *rest in rows}


def test_the_confidence_is_judged_by_the_best_pose_of_every_pair_and_what_was_accepted_is_counted(mix):
    found = cells(trust.of_confidence(trust.by_family(mix)))
    auroc = (2 + 2 + 1) / 9  # of .9, .8 and .3 against .95, .2 and .6
    ece = (0.1 + 0.2 + 0.7 + 0.2 + 0.6 + 0.95 - 2 * 0.1) / 6  # .9 and .95 share a bin, in which one of two is right
    assert found["all"] == ["6", "3", f"{auroc:.4f}", f"{ece:.4f}", "2", "2", "1"]
    assert found["L1"] == ["3", "3", "-", f"{(0.1 + 0.2 + 0.7) / 3:.4f}", "2", "0", "0"]
    assert found["wrong"] == ["2", "0", "-", f"{(0.2 + 0.6) / 2:.4f}", "0", "1", "0"]
    assert list(found) == ["L1", "L2", "wrong", "all"]


def test_the_bound_and_the_covariance_are_judged_by_every_accepted_answer_that_has_a_truth(mix):
    groups = trust.by_family(mix)
    bound, covariance = cells(trust.of_bound(groups)), cells(trust.of_covariance(groups))
    assert bound["L1"][:2] == ["2", "1"] and bound["L1"][2].startswith("50.0 (") and bound["L1"][3] == "1.33"
    assert bound["all"][:2] == ["3", "1"] and bound["all"][2].startswith("33.3 (") and bound["all"][3] == "0.67"
    assert covariance["L1"] == ["2", f"{(1.0 + 9.0) / 2 / chi2.median(6):.2f}"]
    assert covariance["L2"] == ["1", f"{900.0 / chi2.median(6):.2f}"]
    assert "wrong" not in bound and "wrong" not in covariance


def test_pairs_with_another_setting_are_a_family_of_their_own():
    described = "sensor.kind=laser"
    made = [answered(0, 1.0, 0.9, 2.0), answered(1, 1.0, 0.9, 2.0, settings=described)]
    assert list(trust.by_family(made)) == ["L1", f"L1, {described}", "all"]


def test_folders_are_read_together_each_pair_once_and_one_without_the_method_is_named(tmp_path, mix):
    first, second = tmp_path / "first", tmp_path / "second"
    for folder, part in ((first, [*mix[:3], mix[0]]), (second, [*mix[3:], replace(mix[0], method="icp")])):
        folder.mkdir()
        records.write(folder / records.FILE, part)
    assert sorted(r.pair for r in trust.read([first, second], "gapr")) == sorted(r.pair for r in mix)
    with pytest.raises(ConfigError, match="records of icp; got none in .*first"):
        trust.read([second, first], "icp")


def test_the_command_prints_three_tables(tmp_path, mix, monkeypatch, capsys):
    records.write(tmp_path / records.FILE, mix)
    monkeypatch.setattr(sys, "argv", ["trust.py", str(tmp_path)])
    assert trust.main() == 0
    assert capsys.readouterr().out.count("| --- |\n") == 3
