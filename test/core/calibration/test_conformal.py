"""The bound of the error: conformal coverage on data whose answer is known."""

import numpy as np
import pytest
from answer_cases import made_answers
from scipy.stats import chi2

from gapr_core.calibration import conformal
from gapr_core.registration.confidence.features import BONE, FEATURES_OF
from gapr_core.registration.uncertainty.error_calibration import SCALE_LIMITS


def test_the_conformal_quantile_covers_the_next_score_as_often_as_it_says():
    rng = np.random.default_rng(0)
    covered = [rng.exponential() <= conformal.conformal_quantile(rng.exponential(size=19), 0.9) for _ in range(4000)]
    assert np.mean(covered) == pytest.approx(0.9, abs=0.015)  # the plain quantile of 19 covers .86


def test_the_conformal_quantile_is_the_next_larger_score():
    scores = np.arange(1.0, 20.0)
    assert conformal.conformal_quantile(scores, 0.9) == 18.0
    assert conformal.conformal_quantile(scores, 0.95) == 19.0
    assert conformal.conformal_quantile(scores[:5], 0.95) == 5.0  # too few: the largest
    assert conformal.conformal_quantile(scores[:10], 0.5) == 6.0  # of the next, too: half of eleven


def test_errors_three_times_the_predicted_ones_triple_the_scale():
    answers = made_answers(3000, error_scale=3.0)
    scale = conformal.scales(conformal.fit_scale(answers), answers)
    assert np.median(scale) == pytest.approx(3.0, rel=0.1)


def test_the_scale_makes_an_error_hardly_smaller():
    answers = made_answers(3000, error_scale=0.3)
    scale = conformal.scales(conformal.fit_scale(answers), answers)
    assert np.median(scale) == SCALE_LIMITS[0] == 0.9


def test_the_scale_follows_a_feature_and_the_bound_covers_new_subjects_and_families():
    def doubled_where_smooth(features, family):
        return np.exp(0.7 * np.abs(features[:, FEATURES_OF[BONE].index("smooth_misfit")]))

    answers = made_answers(3000, error_scale=doubled_where_smooth)
    scale = conformal.scales_of_unseen_families(answers, np.full(len(answers), True))
    factor = conformal.conformal_quantile(answers.true_mm / (scale * answers.tre95_mm), conformal.COVERED)
    rows = conformal.coverage(answers, scale, factor)
    assert 0.945 < rows["all"]["covered"] < 0.975
    assert 0.8 < rows["all"]["nees_over_median"] < 1.2
    assert factor < 1.3  # were the feature not followed, the factor would have to be 2
    new = made_answers(2000, seed=5, error_scale=doubled_where_smooth)
    rows = conformal.coverage(new, conformal.scales(conformal.fit_scale(answers), new), factor)
    assert all(row["covered"] > 0.93 for row in rows.values())


def test_the_table_holds_medians_of_true_errors_over_scaled_ones_for_each_family():
    answers = made_answers(400, error_scale=2.0)
    scale = np.random.default_rng(1).uniform(0.9, 3.0, 400)
    rows = conformal.coverage(answers, scale, 1.5)
    for name in np.unique(answers.family):
        of_it = answers.family == name
        true, nees = answers.true_mm[of_it], answers.nees[of_it]
        bound = 1.5 * scale[of_it] * answers.tre95_mm[of_it]
        assert rows[name] == pytest.approx({
            "accepted": of_it.sum(),
            "covered": (true <= bound).mean(),
            "bound_over_true": np.median(bound / true),
            "true_over_tre": np.median(true / scale[of_it] / answers.tre_mm[of_it]),
            "nees_over_median": np.median(nees / scale[of_it] ** 2) / chi2.median(6),
            "nees_before": np.median(nees) / chi2.median(6),
        }, abs=1e-3)  # fmt: skip


def drawn(count, seed, of_pointers=1.0):
    """Scores that are smaller for surer answers, of three families, of which one may err by more."""
    rng = np.random.default_rng(seed)
    confidence, family = rng.uniform(0.5, 1.0, count), rng.choice(["pointer", "laser", "ultrasound"], count)
    scale = (2.0 - confidence) * np.where(family == "pointer", of_pointers, 1.0)
    return scale * np.abs(rng.normal(size=count)), confidence, family


@pytest.mark.parametrize("of_pointers", [1.0, 2.0])
def test_the_factors_cover_every_bin_and_every_family_and_never_rise_with_the_confidence(of_pointers):
    at, factors = conformal.factors(*drawn(8000, 0, of_pointers))
    assert len(at) == len(conformal.BINS) - 1 and list(at) == sorted(at)
    assert (np.diff(factors) <= 0.0).all() and factors[0] > 1.1 * factors[-1]
    scores, confidence, family = drawn(40_000, 1, of_pointers)
    covered = scores <= np.interp(confidence, at, factors)
    for low, high in zip(conformal.BINS[:-1], conformal.BINS[1:], strict=True):
        in_bin = (confidence >= low) & (confidence < high)
        assert covered[in_bin].mean() > 0.945
        assert all(covered[in_bin & (family == name)].mean() > 0.92 for name in np.unique(family))


def test_a_bin_whose_errors_are_larger_widens_the_bound_of_all_less_sure_ones():
    scores, confidence, family = drawn(8000, 0)
    plain, worse = (
        conformal.factors(np.where(confidence > 0.97, times * scores, scores), confidence, family)[1]
        for times in (1.0, 5.0)
    )
    assert worse[-1] == pytest.approx(5.0 * plain[-1]) and set(worse) == {worse[-1]}


def test_a_bin_or_a_family_of_a_few_answers_decides_nothing():
    scores, confidence, family = drawn(8000, 0)
    few = slice(0, conformal.FEWEST - 1)
    plain = conformal.factors(scores, confidence, family)
    rare = np.r_[np.full(conformal.FEWEST - 1, "camera"), family[conformal.FEWEST - 1 :]]
    gross = scores.copy()
    gross[few] = 99.0
    found = conformal.factors(gross, confidence, rare)[1]
    assert max(found) < 1.3 * max(plain[1])
    sparse = (confidence < 0.9) | (np.cumsum(confidence >= 0.9) < conformal.FEWEST)
    assert len(conformal.factors(scores[sparse], confidence[sparse], family[sparse])[0]) == 2


def test_no_scale_is_from_a_model_that_has_seen_the_family(monkeypatch):
    answers, seen = made_answers(300), []
    held_out = answers.family[0]

    def fit_nothing(fitted):
        seen.append(set(fitted.family))
        return len(seen)

    monkeypatch.setattr(conformal, "fit_scale", fit_nothing)
    monkeypatch.setattr(conformal, "scales", lambda model, judged: np.full(len(judged), float(model)))
    models = conformal.scales_of_unseen_families(answers, answers.family != held_out).astype(int)
    for family, model in zip(answers.family, models, strict=True):
        assert seen[model - 1] == set(answers.family) - {family, held_out}


def test_no_scale_of_an_unseen_subject_is_from_a_model_that_has_seen_him_or_an_unknown_family(monkeypatch):
    answers, seen = made_answers(300), []
    known = answers.family != answers.family[0]

    def fit_nothing(fitted):
        seen.append((set(fitted.family), {person for people in fitted.people for person in people}))
        return len(seen)

    monkeypatch.setattr(conformal, "fit_scale", fit_nothing)
    monkeypatch.setattr(conformal, "scales", lambda model, judged: np.full(len(judged), float(model)))
    found = conformal.scales_of_unseen_people(answers, known).astype(int)
    assert {model - 1 for model in found} == set(range(len(seen)))
    for people, family, model in zip(answers.people, answers.family, found, strict=True):
        families, subjects = seen[model - 1]
        assert people[0] not in subjects and answers.family[0] not in families
        assert family in families or family == answers.family[0]
