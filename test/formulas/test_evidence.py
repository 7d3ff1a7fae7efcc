"""What the frames of a stream say together: log odds m / (rho + (1 - rho) / n) of n frames of mean m."""

import numpy as np
import pytest

from gapr_core.registration.confidence.classifier import LARGEST_EVIDENCE, LARGEST_LOG_ODDS, Judgement
from gapr_core.registration.streams.evidence import MEMORY, Evidence

JUMP = {"agrees": False}
AGAIN = {"agrees": True, "again": True}


def said(evidence, *frames, bone=0.5, agrees=True, again=False):
    """The pose's log odds after each of these frames."""
    return [evidence.observe(Judgement(pose, bone), agrees, again).pose_log_odds for pose in frames]


@pytest.mark.parametrize("rho", [0.2, 0.5, 0.8, 1.0])
def test_frames_that_agree_count_as_many_as_their_correlation_leaves(rho):
    found, n = said(Evidence(rho, rho), *[0.7] * 200), np.arange(1, 201)
    assert found == pytest.approx(0.7 * n / (1.0 + (n - 1) * rho))
    assert (np.diff(found) >= -1e-12).all() and found[-1] <= 0.7 / rho + 1e-9


def test_each_number_has_its_own_correlation_and_its_own_end():
    evidence = Evidence(rho_pose=0.5, rho_bone=0.25)
    for _ in range(3):
        found = evidence.observe(Judgement(1.0, 0.2, {"margin": 1.0}), True)
    assert (found.pose_log_odds, found.bone_evidence) == pytest.approx((3.0 / 2.0, 0.2 * 3.0 / 1.5))
    assert found.contributions == {"margin": 1.0}
    for sign in (1.0, -1.0):
        free = Evidence(0.0, 0.0)
        for _ in range(99):
            found = free.observe(Judgement(sign, sign), True)
        assert (found.pose_log_odds, found.bone_evidence) == (sign * LARGEST_LOG_ODDS, sign * LARGEST_EVIDENCE)


def test_older_frames_weigh_less():
    kept = 1.0 - 1.0 / MEMORY
    found = said(Evidence(1.0, 1.0), 3.0, -1.0, 2.0)
    assert found[1:] == pytest.approx(
        [(3.0 * kept - 1.0) / (1.0 + kept), (3.0 * kept**2 - kept + 2.0) / (1.0 + kept + kept**2)]
    )
    late = said(Evidence(0.8, 0.8), *[-4.0] * 30, *[4.0] * 60)
    assert late[30] < 0.0 < 4.0 < late[-1]


def test_a_frame_that_comes_again_counts_once_and_as_it_is_now():
    once, again = Evidence(0.3, 0.3), Evidence(0.3, 0.3)
    assert said(once, 1.0, 0.8)[-1] == (said(again, 1.0, 2.0) + said(again, 0.1, 0.8, **AGAIN))[-1]
    assert said(again, 0.5) == said(once, 0.5)


def test_a_jump_forgets_what_spoke_for_the_pose_and_keeps_what_spoke_against_it():
    good, bad, fresh = Evidence(0.5, 0.5), Evidence(0.5, 0.5), Evidence(0.5, 0.5)
    said(good, *[4.0] * 20)
    said(bad, *[-4.0] * 20)
    assert said(fresh, 2.0, **JUMP) == [2.0]
    assert said(good, 2.0, **JUMP) == pytest.approx([2.0])
    assert said(good, 2.0) == pytest.approx(said(fresh, 2.0)), "what follows is a stream of two frames"
    assert said(bad, 2.0, **JUMP)[0] < 0.0


def test_after_a_jump_a_frame_is_no_surer_than_alone():
    evidence = Evidence(0.5, 0.5)
    said(evidence, -1.0)
    assert said(evidence, -5.0, **JUMP) == [-5.0]


def test_a_jump_of_the_pose_forgets_each_number_by_its_own_sign():
    evidence, kept = Evidence(1.0, 1.0), 1.0 - 1.0 / MEMORY
    said(evidence, 3.0, bone=-1.0)
    found = evidence.observe(Judgement(2.0, 0.5), agrees=False)
    assert found.pose_log_odds == pytest.approx(2.0)
    assert found.bone_evidence == pytest.approx((0.5 - kept) / (1.0 + kept))


def test_a_frame_that_is_no_number_comes_back_and_is_not_counted():
    evidence = Evidence(0.5, 0.5)
    assert np.isnan(said(evidence, np.nan)).all()
    assert said(evidence, 1.0, 1.0) == said(Evidence(0.5, 0.5), 1.0, 1.0)
    evidence.reset()
    assert said(evidence, 1.0) == [1.0]


def test_a_wrong_bone_is_detected_by_the_other_frames():
    """One frame in five fits by chance."""
    assert max(said(Evidence(0.8, 0.8), *[2.0 if k % 5 == 4 else -4.0 for k in range(50)])) < 0.0
