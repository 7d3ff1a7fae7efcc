"""What residuals of different frames have in common: noise nothing, tissue nothing rough, another bone its ridges."""

import numpy as np
import pytest
from test_roughness import UP, feet_of, field, plane_fit

from gapr_core.registration.confidence import roughness
from gapr_core.registration.streams import shared_misfit
from gapr_core.registration.streams.shared_misfit import SharedMisfit

FOUR = np.array([[0.0, 0, 0], [5.0, 0, 0], [0.0, 15.0, 0], [5.0, 15.0, 0]])
MEMORY = 1e9


@pytest.fixture
def every_pair_counts(monkeypatch):
    monkeypatch.setattr(shared_misfit, "FEWEST_PAIRS", 1)
    monkeypatch.setattr(shared_misfit, "USUAL_PAIRS", 0)
    monkeypatch.setattr(shared_misfit, "LIMITS_MM", roughness.LIMITS_MM)  # from 0 mm: the same four places


def frame(*signed, feet=FOUR):
    return plane_fit(np.array(signed), feet)


def test_it_is_the_difference_of_the_mean_products_over_both_frames(every_pair_counts):
    """By hand: at 0 and 5 mm the products of (1, 2) with (5, 6) and of (3, 4) with (7, 8); at 15 to 20 mm the rest."""
    shared = SharedMisfit(MEMORY)
    assert shared.add(frame(1.0, 2.0, 3.0, 4.0)) is None
    near, far = ((1 + 2) * (5 + 6) + (3 + 4) * (7 + 8)) / 8, ((1 + 2) * (7 + 8) + (3 + 4) * (5 + 6)) / 8
    assert shared.add(frame(5.0, 6.0, 7.0, 8.0)) == pytest.approx((np.sqrt(near - far), np.sqrt(far)))


def test_a_negative_covariance_keeps_its_sign(every_pair_counts):
    shared = SharedMisfit(MEMORY)
    shared.add(frame(1.0, 1.0, -1.0, -1.0))
    assert shared.add(frame(-1.0, -1.0, 1.0, 1.0)) == pytest.approx((-np.sqrt(2.0), 1.0))


def test_few_pairs_say_little_and_too_few_nothing(every_pair_counts, monkeypatch):
    first, second = frame(1.0, 1.0, -1.0, -1.0), frame(1.0, 1.0, -1.0, -1.0)
    both = np.array([np.sqrt(2.0), -1.0])
    for fewest, usual, expected in ((9, 0, None), (8, 0, both), (8, 8, both / np.sqrt(2.0))):  # 8 near pairs, 8 far
        monkeypatch.setattr(shared_misfit, "FEWEST_PAIRS", fewest)
        monkeypatch.setattr(shared_misfit, "USUAL_PAIRS", usual)
        shared = SharedMisfit(MEMORY)
        shared.add(first)
        assert shared.add(second) == (expected if expected is None else pytest.approx(expected))


@pytest.mark.parametrize("moved_mm", [0.0, 0.3])
def test_points_that_come_again_do_not_add_their_own_noise(moved_mm):
    """In a cloud that grows, a point lies where it was, but for the pose: noise times itself is no covariance."""
    rng, found, with_itself = np.random.default_rng(6), [], []
    for _ in range(8):
        shared, feet, noise = SharedMisfit(MEMORY), feet_of(500, int(rng.integers(99))), rng.normal(0.0, 3.0, 500)
        for k in range(3):
            last = shared.add(plane_fit(noise, feet + [k * moved_mm, 0.0, 0.0]))
        found.append(np.sign(last[0]) * last[0] ** 2)
        total, count = roughness.products_mm2(feet, noise, feet, noise, roughness.LIMITS_MM, np.full(500, -1))
        with_itself.append(np.subtract(*(total / count)))
    assert abs(np.mean(found)) < 0.5 < 1.0 < np.mean(with_itself)


def test_frames_that_see_different_places_say_nothing():
    shared = SharedMisfit(MEMORY)
    assert shared.add(plane_fit(np.ones(900), feet_of(900))) is None
    assert shared.add(plane_fit(np.ones(900), feet_of(900) + 500.0)) is None


def test_a_patch_too_small_for_long_range_says_nothing(every_pair_counts):
    shared, patch = SharedMisfit(MEMORY), feet_of(50) / 30.0  # 4 mm across
    assert shared.add(plane_fit(np.ones(50), patch)) is None
    assert shared.add(plane_fit(np.ones(50), patch)) is None


def stream_of(stays, each_frame, seed=4, noise_mm=1.5, frames=5):
    """The last answer for frames of 1000 of 4000 places: fields that stay and that do not, and noise."""
    shared, rng, feet = SharedMisfit(MEMORY), np.random.default_rng(seed), feet_of(4000)
    own = stays(feet, rng)
    for _ in range(frames):
        seen = rng.permutation(len(feet))[:1000]
        signed = own[seen] + each_frame(feet[seen], rng) + rng.normal(0.0, noise_mm, len(seen))
        found = shared.add(plane_fit(signed, feet[seen]))
    return found[0]


def nothing(feet, rng):
    return np.zeros(len(feet))


def test_what_stays_and_is_rough_shows_and_nothing_else_does():
    def rough(feet, rng):
        return field(feet, 6.0, 0.5, rng)

    def tissue(feet, rng):
        return field(feet, 60.0, 1.0, rng)

    assert abs(stream_of(nothing, nothing)) < 0.2
    assert abs(stream_of(tissue, nothing)) < 0.3  # its covariance falls by .05 mm^2 from near to far
    assert abs(stream_of(nothing, rough)) < 0.25
    found = [stream_of(rough, nothing, seed) for seed in range(4)]
    assert np.mean(found) == pytest.approx(0.5 * np.sqrt(0.70), abs=0.05)


def test_tissue_of_one_thickness_is_smooth_alone():
    shared, rng, feet = SharedMisfit(MEMORY), np.random.default_rng(5), feet_of(3000)
    for _ in range(3):
        found = shared.add(plane_fit(0.8 + rng.normal(0.0, 1.0, len(feet)), feet))
    assert abs(found[0]) < 0.25 and found[1] == pytest.approx(0.8, abs=0.05)


def test_old_frames_are_forgotten(every_pair_counts):
    shared = SharedMisfit(2.0)
    signed = 1.0, 1.0, -1.0, -1.0
    for _ in range(2):
        shared.add(frame(*signed))
    elsewhere = frame(*signed, feet=FOUR + [200.0, 0.0, 0.0])
    assert shared.add(elsewhere) == pytest.approx((np.sqrt(2.0), -1.0))  # the means of what there is
    assert shared._count == pytest.approx([4.0, 4.0])  # half of 8
    shared.forget()
    assert shared.add(frame(*signed)) is None


def test_only_the_last_frames_are_compared(every_pair_counts, monkeypatch):
    shared = SharedMisfit(MEMORY)
    for _ in range(shared_misfit.FRAMES + 3):
        shared.add(frame(1.0, 1.0, 1.0, 1.0))
    before = shared._count.copy()
    shared.add(frame(1.0, 1.0, 1.0, 1.0))
    assert shared._count - before == pytest.approx(8.0 * shared_misfit.FRAMES)


def test_outliers_take_no_part(every_pair_counts):
    shared, weights = SharedMisfit(MEMORY), np.array([1.0, 0.0, 1.0, 1.0])
    for _ in range(2):
        shared.add(plane_fit(np.array([1.0, 50.0, -1.0, -1.0]), FOUR, weights))
    near, far = (1 + 4 * 1) / 5, -1.0  # (0, 0) alone, and the two others with each other
    nobody = plane_fit(np.zeros(0), np.zeros((0, 3)))
    assert shared.add(nobody) == pytest.approx((np.sqrt(near - far), far))


def test_foot_points_decide_which_are_near(every_pair_counts):
    shared = SharedMisfit(MEMORY)
    for height in (0.0, 10.0):  # the measured points are 10 mm apart, their feet are the same
        shared.add(plane_fit(np.full(4, height) + 1.0, FOUR))
    assert shared._count[0] == 8.0 and UP[2] == 1.0
