"""Ranking and calibration against scipy, simulation and hand-made cases."""

import numpy as np
import pytest
from scipy.stats import mannwhitneyu

from gapr_core.metrics import confidence as c


def test_auroc_is_the_mann_whitney_statistic_with_ties():
    rng = np.random.default_rng(0)
    correct = rng.random(300) < 0.6
    score = np.round(rng.random(300) * 0.7 + 0.3 * correct, 1)
    u = mannwhitneyu(score[correct], score[~correct]).statistic
    assert c.auroc(score, correct) == pytest.approx(u / (correct.sum() * (~correct).sum()))


def test_auroc_of_a_perfect_an_inverted_and_an_uninformed_score():
    correct = [True, True, False]
    assert c.auroc([0.9, 0.8, 0.1], correct) == 1.0
    assert c.auroc([0.1, 0.2, 0.9], correct) == 0.0
    assert c.auroc([np.nan, 0.5, 0.7], [True, False, True]) == 0.5  # no confidence is the lowest
    assert c.auroc([0.5, 0.5, 0.5], correct) == 0.5
    assert c.auroc([0.9, 0.8, 0.85], [True, False, False]) == 1.0
    with np.errstate(all="raise"):
        assert np.isnan(c.auroc([0.5, 0.6], [True, True])) and np.isnan(c.auroc([0.5, 0.6], [False, False]))


def test_a_calibrated_score_has_no_calibration_error_and_an_overconfident_one_has_its_excess():
    rng = np.random.default_rng(1)
    p = rng.random(200_000)
    assert c.expected_calibration_error(p, rng.random(len(p)) < p) < 0.005
    assert c.expected_calibration_error(np.full(1000, 0.95), np.arange(1000) < 700) == pytest.approx(0.25)


def test_reliability_bins_keep_everything_and_include_full_confidence():
    rows = c.reliability([0.0, 0.05, 0.999, 1.0], [0, 1, 1, 1])
    assert rows.pairs.tolist() == [2, 2]
    assert rows.accuracy.tolist() == [0.5, 1.0]
    assert rows.confidence == pytest.approx([0.025, 0.9995])


def test_each_bin_of_reliability_is_as_wide_as_the_others():
    confidence = [0.01, 0.11, 0.12, 0.21, 0.85, 0.95, 1.0]
    rows = c.reliability(confidence, [0, 1, 0, 1, 1, 0, 1])
    assert rows.pairs.tolist() == [1, 2, 1, 1, 2]
    assert rows.confidence == pytest.approx([0.01, 0.115, 0.21, 0.85, 0.975])
    assert rows.accuracy.tolist() == [0.0, 0.5, 1.0, 1.0, 0.5]


def test_risk_grows_with_coverage_when_the_wrong_ones_come_last():
    coverage, risk = c.risk_coverage([0.9, 0.8, 0.7, 0.2], [1, 1, 0, 0], total=8)
    assert coverage == pytest.approx([0.125, 0.25, 0.375, 0.5])
    assert risk == pytest.approx([0, 0, 1 / 3, 0.5])


def test_answers_of_equal_confidence_are_taken_together():
    for correct in ([1, 0, 1], [0, 1, 1], [1, 1, 0]):
        coverage, risk = c.risk_coverage([0.5, 0.5, 0.5], correct)
        assert coverage.tolist() == [1.0] and risk == pytest.approx([1 / 3])
    assert c.risk_coverage([0.5], [0])[0].tolist() == [1.0]
    empty = c.risk_coverage([], [], total=4)
    assert len(empty[0]) == 0 and len(empty[1]) == 0


def test_false_accepts_are_accepted_wrong_answers_and_refusals_are_not():
    accepted, correct = [True, True, True, False], [True, False, False, False]
    assert c.false_accepts(accepted, correct, [0.99, 0.95, 0.3, 0.0]) == 2
    assert c.false_accepts(accepted, correct, [0.99, 0.95, 0.3, 0.0], least=c.SURE) == 1
    assert c.false_accepts(accepted, correct, [0.99, 0.95, 0.3, 0.0], least=0.95) == 1
    assert c.false_accept_rate(accepted, correct) == 0.5
    assert np.isnan(c.false_accept_rate([], []))
