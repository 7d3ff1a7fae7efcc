"""What the frames of a stream say together."""

import numpy as np
import pytest
from scipy.special import expit, logit

from gapr_core.config import EvidenceConfig
from gapr_core.registration.streams.evidence import Evidence


def test_a_single_frame_keeps_its_probability():
    for probability in (1e-6, 0.2, 0.7, 0.999):
        assert Evidence().add(probability, agrees=False) == pytest.approx(probability, rel=1e-6)


def test_frames_that_agree_raise_the_confidence_up_to_what_their_correlation_allows():
    evidence = Evidence(EvidenceConfig(correlation=0.5, memory=1e6))
    answers = [evidence.add(0.8, agrees=True) for _ in range(200)]
    assert all(a <= b for a, b in zip(answers, answers[1:], strict=False))
    part = np.sqrt(0.8)
    assert answers[1] == pytest.approx(expit(2 / 1.5 * logit(part)) * part)  # n / (1 + (n - 1) rho)
    assert answers[-1] == pytest.approx(expit(2.0 * logit(part)) * part, rel=1e-2)  # 1 / rho
    repeated = Evidence(EvidenceConfig(correlation=1.0))
    assert [repeated.add(0.8, agrees=True) for _ in range(9)] == pytest.approx([0.8] * 9)


def test_the_frames_that_ship_count_as_little_more_than_one():
    evidence = Evidence()
    assert max(evidence.add(0.47, agrees=True) for _ in range(100)) < 0.5


def test_a_frame_that_comes_again_counts_once_and_as_it_is_now():
    once, again = Evidence(EvidenceConfig(correlation=0.0)), Evidence(EvidenceConfig(correlation=0.0))
    for evidence in (once, again):
        evidence.add(0.7, agrees=True)
    for probability in (0.9, 0.6, 0.8):
        found = again.add(probability, agrees=True, again=True) if probability != 0.9 else again.add(0.9, agrees=True)
    assert found == pytest.approx(once.add(0.8, agrees=True))
    assert again.add(0.8, agrees=True) == pytest.approx(once.add(0.8, agrees=True))


def test_nothing_is_raised_beyond_its_square_root():
    evidence = Evidence(EvidenceConfig(correlation=0.0))
    for _ in range(100):
        evidence.add(0.999, agrees=True)
    assert evidence.add(0.25, agrees=True) == pytest.approx(0.5, abs=1e-2)
    assert evidence.add(0.24, agrees=True) < 0.5


def test_after_a_jump_what_spoke_for_the_bone_is_forgotten_and_what_spoke_against_it_is_not():
    good, bad = Evidence(), Evidence()
    for _ in range(20):
        good.add(0.97, agrees=True)
        bad.add(0.02, agrees=True)
    assert good.add(0.28, agrees=False) == pytest.approx(0.28)
    assert bad.add(0.9, agrees=False) < 0.5


def test_after_a_jump_a_frame_is_no_surer_than_alone_although_those_before_spoke_less_against_the_bone():
    evidence = Evidence()
    evidence.add(0.2, agrees=True)
    assert evidence.add(0.01, agrees=False) == 0.01


def test_after_a_jump_a_frame_that_spoke_for_the_bone_is_as_if_it_had_not_been():
    seen, fresh = Evidence(), Evidence()
    seen.add(0.36, agrees=True)  # sqrt(0.36) = 0.6: a little more than even
    seen.add(0.5, agrees=False)
    fresh.add(0.5, agrees=False)
    assert seen.add(0.5, agrees=True) == fresh.add(0.5, agrees=True)


@pytest.mark.parametrize("before", [0.16, 0.25])
def test_after_a_jump_a_frame_that_did_not_speak_for_the_bone_still_weighs(before):
    """sqrt(0.16) = 0.4 speaks against it, sqrt(0.25) = 0.5 neither for nor against."""
    evidence = Evidence(EvidenceConfig(memory=4.0))
    evidence.add(before, agrees=True)
    part = np.sqrt(0.9)
    mean = (0.75 * logit(np.sqrt(before)) + logit(part)) / 1.75
    assert evidence.add(0.9, agrees=False) == pytest.approx(expit(mean) * part)


def test_a_stream_without_frames_counts_as_one():
    assert Evidence().effective_frames == 1.0


def test_a_probability_that_is_no_number_is_not_counted():
    evidence = Evidence()
    assert np.isnan(evidence.add(np.nan, agrees=True))
    assert evidence.add(0.7, agrees=False) == pytest.approx(0.7)


def test_a_wrong_bone_is_detected_by_the_other_frames():
    """One frame in five fits by chance."""
    evidence = Evidence()
    answers = [evidence.add(0.7 if i % 5 == 4 else 0.05, agrees=True) for i in range(50)]
    assert max(answers) < 0.5


def test_a_jump_makes_the_frames_count_for_one():
    evidence = Evidence(EvidenceConfig(correlation=0.5, memory=1e6))
    for _ in range(20):
        before = evidence.add(0.8, agrees=True)
    assert evidence.add(0.8, agrees=False) == pytest.approx(0.8) and before > 0.85
    assert evidence.effective_frames == 1.0
    evidence.add(0.8, agrees=True)
    assert evidence.effective_frames == pytest.approx(2 / 1.5)


def test_old_frames_are_forgotten():
    evidence = Evidence(EvidenceConfig(memory=5.0))
    for _ in range(30):
        evidence.add(0.02, agrees=True)
    answers = [evidence.add(0.95, agrees=True) for _ in range(30)]
    assert answers[0] < 0.5 < 0.95 < answers[-1]
    evidence.reset()
    assert evidence.add(0.7, agrees=True) == pytest.approx(0.7)
