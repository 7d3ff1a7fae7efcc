"""Records and rows from hand-made answers."""

import csv
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from benchmark_cases import make_pair, ok, record, shifted, some_records

from gapr_core.benchmark import table
from gapr_core.benchmark.judge import judge, pair_facts
from gapr_core.benchmark.record import Verdict
from gapr_core.benchmark.records import Plan
from gapr_core.geometry import se3
from gapr_core.pages import sections, writers
from gapr_core.results import Hypothesis, RegistrationResult, RegistrationStatus


def test_a_shift_is_measured_in_every_error_and_limit():
    pair = make_pair(0)
    facts = judge(pair, ok(shifted(pair, 3.0)))
    for key in ("rte_mm", "rmse_mm", "whole_bone_mm"):
        assert getattr(facts, key) == pytest.approx(3.0)
    assert all(value == pytest.approx(3.0) for value in facts.tre_mm.values())
    assert (facts.within_1_1, facts.within_2_2, facts.within_4_5) == (False, False, True)
    assert facts.right and not facts.false_accept and not facts.stand_in
    assert facts.within_extent == (3.0 < 0.02 * pair_facts(pair).half_extent_mm)
    assert facts.within_paper == (3.0 < 0.01 * np.ptp(pair.target, axis=0).max())
    assert judge(pair, ok(shifted(pair, 4.1))).false_accept


def test_a_refusal_is_never_within_a_limit_even_where_its_stand_in_would_be():
    pair = make_pair(0)
    on_centroid = pair.source - pair.source.mean(axis=0) + pair.target.mean(axis=0)
    aligned = type(pair)(on_centroid, pair.target, np.eye(4), "a", "femur", "p", "L1")
    facts = judge(aligned, RegistrationResult(RegistrationStatus.LOW_CONFIDENCE))
    assert facts.rmse_mm == pytest.approx(0.0, abs=1e-9) and facts.stand_in
    assert not any(
        getattr(facts, key) for key in ("within_paper", "within_extent", "within_4_5", "right", "false_accept")
    )
    assert facts.best_right is None


def test_the_pose_behind_a_refusal_is_judged_for_calibration():
    pair = make_pair(0)
    for T, right in ((shifted(pair, 1.0), True), (shifted(pair, 50.0), False)):
        refusal = RegistrationResult(RegistrationStatus.AMBIGUOUS, confidence=0.4, hypotheses=(Hypothesis(T, 0.4),))
        assert judge(pair, refusal).best_right is right


def test_any_pose_for_a_wrong_pair_is_a_false_accept_and_a_refusal_is_not():
    pair = make_pair(0, "wrong")
    assert judge(pair, ok(np.eye(4))) == Verdict(right=False, false_accept=True, best_right=False)
    refusal = RegistrationResult(RegistrationStatus.LOW_CONFIDENCE)
    assert judge(pair, refusal) == Verdict(right=False, false_accept=False)


def test_nees_is_about_the_point_that_the_covariance_turns_about():
    """A turn about the centre of the points that were used moves the centroid of all; the covariance knows the turn."""
    pair = make_pair(0)
    centre = se3.apply(pair.T_target_source, pair.source.mean(axis=0)[None])[0] + [20.0, 0.0, 0.0]
    answer = ok(about_point(pair, centre), covariance=np.diag([0.01] * 3 + [1e-4] * 3))
    assert judge(pair, replace(answer, centre_mm=centre)).nees == pytest.approx(0.02**2 / 1e-4, rel=1e-6)
    assert judge(pair, answer).nees > 10.0  # about the centroid the turn is a shift of 0.4 mm as well


def about_point(pair, centre):
    """The true pose, then a turn of 0.02 rad about z and the centre."""
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(0.02), -np.sin(0.02)], [np.sin(0.02), np.cos(0.02)]]
    turn[:3, 3] = centre - turn[:3, :3] @ centre
    return turn @ pair.T_target_source


def test_nees_and_the_ratio_to_the_bound_come_with_a_covariance_and_a_noise():
    pair = make_pair(0)
    covariance = np.diag([1.0] * 3 + [1e-4] * 3)
    facts = judge(pair, ok(shifted(pair, 2.0), covariance=covariance))
    assert facts.nees == pytest.approx(4.0)
    assert facts.bound_ratio == pytest.approx(2.0 / facts.bound_rmse_mm)
    assert judge(pair, ok(shifted(pair, 2.0))).nees is None


def test_targets_named_in_the_pair_take_the_place_of_the_extreme_points():
    pair = make_pair(0)
    assert set(judge(pair, ok(shifted(pair, 1.0))).tre_mm) == {f"axis{k}{s}" for k in (1, 2, 3) for s in "+-"}
    pair.metadata["landmark_hip_centre"] = np.array([1.0, 2.0, 3.0])
    assert set(judge(pair, ok(shifted(pair, 1.0))).tre_mm) == {"hip_centre"}


def test_records_are_plain_json_without_nan():
    pair = make_pair(0)
    pair.metadata["overlap"] = np.float64("nan")
    text = json.dumps(record(pair, ok(shifted(pair, 1.0), covariance=np.eye(6))).to_json(), allow_nan=False)
    assert json.loads(text)["overlap"] is None


def test_a_row_counts_what_happened():
    rows = {(r["protocol"], r["method"]): r for r in table.rows(some_records(), ["a", "b"])}
    a, b = rows["L1", "a"], rows["L1", "b"]
    assert a["rr_4_5"] == pytest.approx(1 / 3, rel=1e-5) and b["rr_4_5"] == 1.0
    assert (a["rr_1_1"] > 0, b["rr_1_1"], b["rr_2_2"]) == (True, 0.0, 1.0)
    assert (a["accepted"], a["refused"], a["false_accepts"], a["false_accepts_sure"]) == (2, 1, 1, 1)
    assert a["auroc"] == 0.0 and b["auroc"] is None  # the wrong one had the higher confidence
    assert b["rmse_mm"] == pytest.approx(1.5) and a["rmse_median_mm"] == pytest.approx(30.0)
    assert rows["wrong", "b"]["false_accepts"] == 1 and rows["wrong", "a"]["false_accepts"] == 0
    assert rows["all", "a"]["pairs"] == 4 and rows["all", "a"]["pairs_with_truth"] == 3
    assert rows["all", "b"]["seconds"] == 0.5


def test_rows_do_not_depend_on_the_order_of_the_pairs_within_a_group():
    found = some_records()
    assert table.rows(found, ["a", "b"]) == table.rows(sorted(found, key=lambda r: r.pair), ["a", "b"])


def test_methods_are_compared_on_the_pairs_that_both_have_and_subjects_are_drawn_whole():
    pairs = [replace(make_pair(number), person=f"p{number // 2}") for number in range(6)]
    a = [ok(shifted(pair, 1.0 if number < 5 else 9.0)) for number, pair in enumerate(pairs)]
    b = [ok(shifted(pair, 9.0 if number < 2 else 1.0)) for number, pair in enumerate(pairs[:4])]
    refused = RegistrationResult(RegistrationStatus.LOW_CONFIDENCE)
    found = [record(pair, answer, "a") for pair, answer in zip(pairs, a, strict=True)]
    found += [record(pair, answer, "b") for pair, answer in zip(pairs, [*b, refused], strict=False)]
    found += [record(make_pair(9, "wrong"), refused, name) for name in "ab"]
    (row,) = table.differences(found, ["b", "a"], "a")
    assert (row["protocol"], row["method"]) == ("L1", "b")
    assert (row["pairs"], row["ours_alone"], row["other_alone"], row["difference"]) == (5, 3, 0, 0.6)
    assert (row["difference_low"], row["difference_high"]) == (0.0, 1.0)
    (other,) = table.differences(found, ["b", "a"], "b")
    assert (other["ours_alone"], other["other_alone"], other["difference"]) == (0, 3, -0.6)
    assert table.differences(found[:6], ["a"], "a") == []
    (section,) = sections.compared([row], "a")
    assert section.cells == [["L1", "b", "5", "3", "0", "+60.0 [+0 to +100]"]]
    assert sections.compared([], "a") == []


def test_the_table_says_where_another_method_is_better_and_only_there():
    lines = sections.where_beaten(table.rows(some_records(), ["a", "b"]), "a")
    assert any(line.startswith("L1, right %: b 100.0") and line.endswith("a 33.3 [0–100]") for line in lines)
    assert any(line.startswith("L1, wrong and accepted: b 0; a 1") for line in lines)
    assert not any("RR % 1 mm" in line for line in lines)
    assert not any(line.startswith("wrong") for line in lines)
    assert sections.where_beaten(table.rows(some_records()[:3], ["a"]), "a") == ["nowhere in these pairs"]


def test_every_table_begins_with_right_beside_wrong_and_one_pair_has_an_interval():
    (accuracy, safety) = sections.sections(
        table.rows([record(make_pair(0), ok(shifted(make_pair(0), 1.0)), "a")], "a")
    )[1:]
    six = ["method", "pairs", "right %", "wrong and accepted %", "refused %", "median error mm"]
    for section in (accuracy, safety):
        assert section.header[1:7] == six
        assert section.cells[0][1:6] == ["a", "1", "100.0 [21–100]", "0.0 [0–79]", "0.0"]


def test_the_numbers_of_the_paper_stand_below_ours_and_are_marked():
    pair = make_pair(0, "paper")
    found = sections.sections(table.rows([record(pair, ok(shifted(pair, 1.0)), "a")], ["a"]))
    accuracy = next(s for s in found if s.title == "Protocol paper: accuracy")
    marked = {line[1]: line for line in accuracy.cells if "the paper's number, on the paper's data" in line[1]}
    assert len(marked) == 6
    recall = accuracy.header.index("RR % (paper)")
    name = "GAPR-Net (the paper's number, on the paper's data)"
    assert marked[name][recall] == "95.6" and accuracy.cells[0][recall].startswith("100.0")


def test_the_best_cell_of_a_column_is_marked_unless_all_are_equal():
    rows = table.rows(some_records(), ["a", "b"])
    accuracy = next(s for s in sections.sections(rows) if s.title == "Protocol L1: accuracy")
    column = accuracy.header.index("right %")
    assert (1, column) in accuracy.best and (0, column) not in accuracy.best
    same = [{**row, "rr_4_5": 0.5} for row in rows if row["protocol"] == "L1"]
    accuracy = next(s for s in sections.sections(same) if s.title == "Protocol L1: accuracy")
    assert not {(0, column), (1, column)} & accuracy.best


def test_the_error_bound_is_judged_on_every_accepted_pose_right_or_wrong():
    pair = make_pair(0)
    answers = [replace(ok(shifted(pair, mm)), tre95_mm=bound) for mm, bound in ((1.0, 2.0), (3.0, 2.4), (9.0, 27.0))]
    refused = RegistrationResult(RegistrationStatus.AMBIGUOUS)
    row = table.summary([record(pair, answer) for answer in (*answers, refused)])
    assert row["tre95_covers"] == pytest.approx(2 / 3, abs=1e-5)
    assert row["tre95_ratio"] == pytest.approx(2.0)  # of 2, 0.8 and 3
    assert row["nees_median"] is None
    covariance = np.diag([1.0] * 3 + [1e-4] * 3)
    exact = table.summary([record(pair, ok(shifted(pair, mm), covariance=covariance)) for mm in (1.0, 2.0, 5.0)])
    assert exact["nees_median"] == pytest.approx(4.0 / 5.348, rel=1e-3)


def test_the_covariance_is_judged_on_right_answers_alone():
    """1 and 3 mm at a standard deviation of 1 mm; the accepted one at 30 mm is in another basin."""
    pair, covariance = make_pair(0), np.diag([1.0] * 3 + [1e-4] * 3)
    found = [record(pair, ok(shifted(pair, mm), covariance=covariance)) for mm in (1.0, 3.0, 30.0)]
    row = table.summary(found)
    assert row["nees_6"] == pytest.approx((1.0 + 9.0) / 2.0 / 6.0, rel=1e-4)
    bound = found[0].bound_rmse_mm
    assert row["bound_rmse_mm"] == pytest.approx(bound, rel=1e-4)
    assert row["bound_ratio"] == pytest.approx(np.sqrt((1.0 + 9.0) / 2.0) / bound, rel=1e-4)  # the root of mean squares
    assert row["bound_ratio_median"] == pytest.approx(2.0 / bound, rel=1e-4)


def test_a_false_accept_at_the_limit_itself_is_a_sure_one():
    pair = make_pair(0)
    for confidence, sure in ((0.9, 1), (0.8999, 0)):
        row = table.summary([record(pair, ok(shifted(pair, 30.0), confidence))])
        assert (row["false_accepts"], row["false_accepts_sure"]) == (1, sure)


def test_the_time_that_nine_in_ten_stay_below_stands_beside_the_median():
    pair = make_pair(0)
    row = table.summary([record(pair, ok(shifted(pair, 1.0)), seconds=float(k)) for k in range(11)])
    assert (row["seconds"], row["seconds_p90"]) == (5.0, 9.0)


def test_the_confidence_is_judged_on_every_best_pose_behind_refusals_too():
    """Accepted, right, 0.8; refused, wrong, 0.3; refused without a pose, 0.9: that one says nothing."""
    pair = make_pair(0)
    behind = (Hypothesis(shifted(pair, 50.0), 0.3),)
    refused = RegistrationResult(RegistrationStatus.AMBIGUOUS, confidence=0.3, hypotheses=behind)
    without = RegistrationResult(RegistrationStatus.LOW_CONFIDENCE, confidence=0.9)
    row = table.summary([record(pair, answer) for answer in (ok(shifted(pair, 1.0)), refused, without)])
    assert row["auroc"] == 1.0
    assert row["ece"] == pytest.approx((0.2 + 0.3) / 2.0)  # each in a bin of its own


def test_pairs_count_one_by_one_in_the_interval_where_a_subject_is_not_known():
    """Six pairs of two subjects, all right of one and all wrong of the other; without one of the names they are six."""
    pairs = [make_pair(k) for k in range(6)]
    named = [replace(pair, person=f"person {k % 2}") for k, pair in enumerate(pairs)]
    ends = {}
    for name, given in {"known": named, "not all": [*named[:5], replace(named[5], person="")]}.items():
        found = [record(pair, ok(shifted(pair, 30.0 * (k % 2)))) for k, pair in enumerate(given)]
        row = table.summary(found)
        ends[name] = (row["rr_4_5_low"], row["rr_4_5_high"])
    assert ends["known"] == (0.0, 1.0)  # the same subject twice is as likely as both
    # of six throws of a coin none comes up with 1.6 %, at most one with 10.9 %
    assert ends["not all"] == pytest.approx((1.0 / 6.0, 5.0 / 6.0), abs=1e-5)


def test_pairs_of_nobody_known_are_no_subject():
    found = some_records()
    assert table.summary(found)["persons"] == 3
    assert table.summary([replace(r, person="") for r in found])["persons"] == 0


def test_names_from_files_are_no_formula_no_html_and_no_escape_in_a_table(tmp_path):
    pair = make_pair(1, "\x1b[31m<script>a", "=1+2")
    found = [record(pair, ok(shifted(pair, 1.0)), method) for method in ("@a<b", "-b")]
    rows, ran = table.rows(found, ["@a<b", "-b"]), {"commit": "1", "threads": "1", "machine": "m"}
    apart = table.differences(found, ["@a<b", "-b"], "@a<b")
    writers.write_csv(tmp_path / "table.csv", rows)
    writers.write_markdown(tmp_path / "table.md", rows, apart, Plan("c", "", "@a<b", [], "", {}), ran, ["<i>\x1b"])
    with (tmp_path / "table.csv").open(newline="") as file:
        (first, second) = csv.DictReader(file)
    assert (first["protocol"], first["bone"], first["method"]) == (r"\x1b[31m<script>a", "'=1+2", "'@a<b")
    assert second["method"] == "'-b" and second["pairs"] == "1"
    text = (tmp_path / "table.md").read_text()
    assert "\x1b" not in text and not re.search(r"(?<!\\)<", text) and r"\<script>" in text
