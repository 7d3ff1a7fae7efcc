"""Poses between two assessments: near what an assessment says, without a confidence, and none where in doubt."""

from dataclasses import fields, replace

import numpy as np
import pytest

from gapr_core import Registrar, RegistrationResult, RegistrationStatus, Tracker
from gapr_core.data.parametric import make_bone
from gapr_core.data.specimen import Specimen
from gapr_core.data.stream import Motion, simulate
from gapr_core.errors import InvalidPointCloudError
from gapr_core.geometry import se3
from gapr_core.registration.fit.refinement import refine_fully
from gapr_core.registration.streams.following import FollowedPose, Follower, PartialFit

MOTION = Motion(frames=6, share=0.35, points=2000, swing_deg=10.0)
ELSEWHERE = se3.exp([90.0, -60.0, 40.0, 1.2, -0.8, 2.0])


@pytest.fixture(scope="module")
def frames(specimen):
    return simulate(specimen, 1, MOTION)


@pytest.fixture(scope="module")
def prepared(registrar, frames):
    return registrar.prepare(frames[0].target)


@pytest.fixture
def sure(registrar, frames, prepared):
    """A tracker whose last source was accepted and sure."""
    tracker = Tracker(registrar)
    result = tracker.register(frames[0].source, prepared)
    assert result.ok and result.confidence >= registrar.config.sure
    return tracker


@pytest.fixture(scope="module")
def assessed(registrar, frames, prepared):
    found = registrar.assess(frames[0].source, prepared)
    assert found.reaches(registrar.config.sure)
    return found


def follower(registrar, frames, assessed, **following):
    """Of the first frame, with other settings."""
    config = replace(registrar.config, following=replace(registrar.config.following, **following))
    return Follower(assessed, frames[0].source, config)


def seen(of, pair):
    """How the next frame looks to a follower."""
    return of._fit_part(pair.source, of._T)


def is_right(T, pair):
    shift_mm, turn_deg = se3.pose_error(T, pair.T_target_source, pair.source)
    return shift_mm < 4.0 and turn_deg < 5.0


def apart_mm(T, other, pair):
    return se3.rms_apart_mm(T, other, pair.source)


def test_a_followed_pose_is_within_a_millimetre_of_what_an_assessment_says(sure, registrar, frames, prepared):
    all_assessed = Tracker(registrar)
    all_assessed.register(frames[0].source, prepared)
    for number, pair in enumerate(frames[1:], 1):
        found, result = sure.follow(pair.source, prepared), all_assessed.register(pair.source, prepared)
        assert result.ok and found is not None and found.since_assessed == number
        assert apart_mm(found.T_target_source, result.T_target_source, pair) < 1.0
        assert is_right(found.T_target_source, pair)
        assert 0.8 < found.inlier_ratio <= 1.0 and 0.5 < found.residual_mm < 2.0
    assert number == registrar.config.following.most_sources


def test_a_followed_pose_has_no_confidence_and_is_no_result():
    names = {field.name for field in fields(FollowedPose)}
    assert names == {"T_target_source", "inlier_ratio", "residual_mm", "since_assessed"}
    assert not issubclass(FollowedPose, RegistrationResult)
    found = FollowedPose(np.eye(4), 1.0, 0.5, 1)
    assert not any(hasattr(found, name) for name in ("confidence", "ok", "status", "tre95_mm"))


def test_a_source_of_many_points_is_refined_on_a_part_of_it(sure, frames, prepared, monkeypatch):
    counts = []

    def counted(T, points, *given):
        counts.append(len(points))
        return refine_fully(T, points, *given)

    monkeypatch.setattr("gapr_core.registration.streams.following.refine_fully", counted)
    many = np.concatenate([frames[1].source + 0.01 * k for k in range(15)])
    assert sure.follow(many, prepared) is not None
    most = sure.registrar.config.following.points
    assert len(counts) == 2 and all(0.9 * most < count <= most for count in counts)


# --- each rule refuses alone ---


@pytest.fixture(scope="module")
def look(registrar, frames, assessed):
    """How the second frame looks, which may be followed."""
    of = follower(registrar, frames, assessed)
    found = seen(of, frames[1])
    assert isinstance(found, PartialFit) and of.why_not(found) == ""
    return found


def test_a_bone_that_moved_too_far_is_not_followed(registrar, frames, assessed, look):
    of, most_mm = follower(registrar, frames, assessed), registrar.config.evidence.agree_mm
    assert of.why_not(replace(look, moved_mm=0.99 * most_mm)) == ""
    assert of.why_not(replace(look, moved_mm=1.01 * most_mm)) == "the bone moved too far"


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"moved_mm": 0.99}, ""),
        ({"moved_mm": 1.01}, "the assessed pose is left"),
        ({"inlier_ratio": 0.0}, "the assessed pose is left"),
    ],
)
def test_nothing_is_followed_where_a_look_at_the_assessed_source_leaves_its_pose(
    registrar, frames, assessed, look, change, why
):
    """What is followed is compared with that look: it must be of the pose that was assessed."""
    of = follower(registrar, frames, assessed)
    limit_mm = of._tre95_mm
    of.__dict__["_assessed"] = replace(
        of._assessed, **{name: value * (limit_mm if name == "moved_mm" else 1.0) for name, value in change.items()}
    )
    assert of.why_not(look) == why


def test_a_source_with_fewer_inliers_is_not_followed(registrar, frames, assessed, look):
    of = follower(registrar, frames, assessed, least_inliers=0.8)
    then = of._assessed.inlier_ratio
    assert of.why_not(replace(look, inlier_ratio=0.81 * then)) == ""
    assert of.why_not(replace(look, inlier_ratio=0.79 * then)) == "less of the source lies on the bone"


def test_a_source_with_larger_residuals_is_not_followed(registrar, frames, assessed, look):
    of = follower(registrar, frames, assessed, largest_residual=1.5)
    then = of._assessed.residual_mm
    assert of.why_not(replace(look, residual_mm=1.49 * then)) == ""
    assert of.why_not(replace(look, residual_mm=1.51 * then)) == "the residuals are larger"


def test_residuals_below_the_least_noise_are_no_larger_ones(registrar, frames, assessed, look):
    of, least_mm = follower(registrar, frames, assessed), registrar.config.refinement.smallest_sigma_mm
    of._assessed = replace(of._assessed, residual_mm=0.01 * least_mm)
    assert of.why_not(replace(look, residual_mm=1.09 * least_mm)) == ""
    assert of.why_not(replace(look, residual_mm=1.11 * least_mm)) == "the residuals are larger"


def test_a_pose_whose_error_is_not_bounded_is_not_followed(registrar, frames, assessed, look):
    looser = look.spread_mm / follower(registrar, frames, assessed)._assessed.spread_mm
    bound_mm = looser * assessed.tre95_mm
    for limit_mm, why in ((1.01 * bound_mm, ""), (0.99 * bound_mm, "the error over the bone is not bounded")):
        assert follower(registrar, frames, assessed, largest_tre95_mm=limit_mm).why_not(look) == why
        config = replace(registrar.config, max_tre_mm=limit_mm)
        assert Follower(assessed, frames[0].source, config).why_not(look) == why


def test_a_turn_that_is_not_observed_is_not_followed(registrar, frames, assessed, look):
    looser = look.spread_mm / follower(registrar, frames, assessed)._assessed.spread_mm
    turn_deg = looser * assessed.uncertainty.largest_turn_deg
    assert follower(registrar, frames, assessed, largest_turn_deg=1.01 * turn_deg).why_not(look) == ""
    refuses = follower(registrar, frames, assessed, largest_turn_deg=0.99 * turn_deg)
    assert refuses.why_not(look) == "a turn is not observed"


def test_a_weaker_view_counts_for_a_larger_error(registrar, frames, assessed, look):
    of = follower(registrar, frames, assessed, largest_turn_deg=1e6)
    weaker = replace(look, spread_mm=of._assessed.spread_mm * 1.01 * 4.0 / assessed.tre95_mm)
    assert of.why_not(weaker) == "the error over the bone is not bounded"
    source = frames[1].source
    piece = source[((source - source[0]) ** 2).sum(axis=1).argsort()[:300]]
    assert of.why_not(of._fit_part(piece, of._T)) == "the error over the bone is not bounded"


def test_a_weaker_view_counts_for_a_larger_turn(registrar, frames, assessed, look):
    limit_deg = 1.5 * assessed.uncertainty.largest_turn_deg
    of = follower(registrar, frames, assessed, largest_tre95_mm=1e6, largest_turn_deg=limit_deg)
    for times, why in ((1.4, ""), (1.6, "a turn is not observed")):
        assert of.why_not(replace(look, spread_mm=times * of._assessed.spread_mm)) == why


def test_only_so_many_sources_in_a_row_are_followed(registrar, frames, prepared):
    config = replace(registrar.config, following=replace(registrar.config.following, most_sources=2))
    tracker = Tracker(Registrar(config, registrar.proposers, registrar.calibrations))
    tracker.register(frames[0].source, prepared)
    found = [tracker.follow(frames[1].source, prepared) for _ in range(4)]
    assert [f and f.since_assessed for f in found] == [1, 2, None, None]
    tracker.register(frames[1].source, prepared)
    assert tracker.follow(frames[2].source, prepared).since_assessed == 1


def test_the_spread_is_what_noise_does_to_the_pose(registrar, frames, assessed, prepared):
    of, rng = follower(registrar, frames, assessed), np.random.default_rng(0)
    fit = replace(assessed.fit, weights=np.ones(len(assessed.fit.weights)))
    gain = np.linalg.pinv(fit.jacobian)
    arms = prepared.points - fit.moved.mean(axis=0)
    squares = []
    for _ in range(400):
        shift, turn = np.split(gain @ rng.normal(0.0, fit.sigma_mm, len(fit.weights)), 2)
        squares.append(((shift + np.cross(turn, arms)) ** 2).sum(axis=1).mean())
    assert of._spread_mm(fit) == pytest.approx(np.sqrt(np.mean(squares)), rel=0.08)
    half = replace(fit, weights=0.5 * fit.weights)
    assert of._spread_mm(half) == pytest.approx(np.sqrt(2.0) * of._spread_mm(fit), rel=1e-3)
    noisier = replace(assessed, fit=replace(assessed.fit, sigma_mm=3.0 * assessed.fit.sigma_mm))
    assert follower(registrar, frames, noisier)._spread_mm(fit) == pytest.approx(3.0 * of._spread_mm(fit))


def test_points_of_which_none_lies_on_the_bone_fit_infinitely_badly(registrar, frames, assessed):
    far = follower(registrar, frames, assessed)._described(assessed.fit, 0.0, frames[0].source + 1e4)
    assert (far.inlier_ratio, far.residual_mm) == (0.0, np.inf)


# --- nothing leads away ---


def test_nothing_is_followed_before_the_first_answer_and_after_a_reset(registrar, sure, frames, prepared):
    assert Tracker(registrar).follow(frames[0].source, prepared) is None
    sure.reset()
    assert sure.follow(frames[1].source, prepared) is None


def test_nothing_is_followed_on_another_target(sure, registrar, frames, prepared):
    assert sure.follow(frames[1].source, registrar.prepare(frames[0].target)) is None


def test_nothing_is_followed_after_a_source_that_was_refused(sure, frames, prepared):
    noise = np.random.default_rng(0).uniform(-60.0, 60.0, (500, 3))
    for bad in (noise, np.zeros((5, 3))):
        assert not sure.register(bad, prepared).ok
        assert sure.follow(frames[1].source, prepared) is None
        sure.register(frames[0].source, prepared)
        assert sure.follow(frames[1].source, prepared) is not None


def test_nothing_is_followed_after_a_source_that_could_not_be_registered(sure, frames, prepared):
    with pytest.raises(InvalidPointCloudError):
        sure.register(np.zeros((5, 2)), prepared)
    assert sure.follow(frames[1].source, prepared) is None


def test_nothing_is_followed_after_an_answer_that_is_not_sure(registrar, frames, prepared):
    config = replace(registrar.config, sure=1.1)
    tracker = Tracker(Registrar(config, registrar.proposers, registrar.calibrations))
    assert tracker.register(frames[0].source, prepared).ok
    assert tracker.follow(frames[1].source, prepared) is None


def test_nothing_is_followed_after_a_cloud_with_a_viewpoint(sure, frames, prepared, monkeypatch):
    """Which part of the next one is bone is not known without an assessment."""
    assess = Registrar.assess

    def in_a_scene(*given, **named):
        found = assess(*given, **named)
        return replace(found, seen=found.source, members=np.ones(len(found.source.points), dtype=bool))

    monkeypatch.setattr(Registrar, "assess", in_a_scene)
    result = sure.register(frames[1].source, prepared)
    assert result.ok and result.confidence >= sure.registrar.config.sure
    assert sure.follow(frames[2].source, prepared) is None


@pytest.mark.parametrize("bad", [np.zeros((0, 3)), np.full((50, 3), np.nan), np.zeros((5, 3)), np.zeros((500, 3))])
def test_a_source_that_shows_nothing_is_not_followed(sure, frames, prepared, bad):
    assert sure.follow(bad, prepared) is None
    assert sure.follow(frames[1].source, prepared) is None, "nor is any source after it"


def test_a_source_of_a_wrong_shape_is_an_error_and_ends_the_following(sure, frames, prepared):
    with pytest.raises(InvalidPointCloudError):
        sure.follow(np.zeros((5, 2)), prepared)
    assert sure.follow(frames[1].source, prepared) is None


def test_a_bone_that_jumps_is_not_followed_and_the_next_assessment_finds_it(sure, frames, prepared):
    jumped = se3.apply(ELSEWHERE, frames[1].source)
    assert sure.follow(frames[1].source, prepared) is not None
    assert sure.follow(jumped, prepared) is None
    assert sure.follow(frames[2].source, prepared) is None
    result = sure.register(jumped, prepared)
    assert result.ok and result.proposer != "track" and is_right(result.T_target_source @ ELSEWHERE, frames[1])


@pytest.mark.parametrize("turn_deg", [20.0, 60.0, 180.0])
@pytest.mark.parametrize("slide_mm", [0.0, 25.0])
def test_a_bone_that_turns_or_slides_away_is_not_followed_to_a_wrong_pose(sure, frames, prepared, turn_deg, slide_mm):
    """About and along its own axis, where the surface changes least."""
    T, centre = frames[1].T_target_source, prepared.points.mean(axis=0)
    axis = np.linalg.svd(prepared.points - centre, full_matrices=False)[2][0]
    away = se3.exp(np.concatenate([slide_mm * axis, np.radians(turn_deg) * axis]), centre)
    source = se3.apply(se3.inverse(T) @ away @ T, frames[1].source)
    found = sure.follow(source, prepared)
    truth = T @ se3.inverse(se3.inverse(T) @ away @ T)
    assert found is None or apart_mm(found.T_target_source, truth, replace(frames[1], source=source)) < 4.0


@pytest.mark.parametrize("kind, number", [("tibia", 4), ("pelvis", 4), ("femur", 9)])
def test_another_bone_in_the_same_place_is_not_followed(sure, frames, prepared, kind, number):
    other = simulate(Specimen(make_bone(kind, number), kind, "other", "parametric"), 1, MOTION)[1]
    source = se3.apply(se3.inverse(frames[1].T_target_source) @ other.T_target_source, other.source)
    assert sure.follow(source, prepared) is None


# --- what the tracker knows does not change ---


def test_following_changes_nothing_that_the_tracker_knows(sure, frames, prepared):
    def known():
        misfit = sure._misfit
        arrays = {"poses": sure._memory.poses, "seen": misfit._seen.mean}
        flags = sure._since_full, sure._is_sure, sure._has_track, misfit._speaks_for, misfit._shared_mm
        return {name: array.tolist() for name, array in arrays.items()} | vars(sure._evidence) | {"flags": flags}

    before = known()
    for pair in frames[1:4]:
        assert sure.follow(pair.source, prepared) is not None
    assert known() == before


def test_a_bone_that_was_followed_far_continues_its_track(sure, frames, prepared):
    """Four steps of 5 mm are more than `evidence.agree_mm` from the last assessed source, and not from the followed."""
    at = [frames[0].source + [5.0 * number, 0.0, 0.0] for number in range(6)]
    for source in at[1:5]:
        assert sure.follow(source, prepared) is not None
    assert sure.register(at[5], prepared).ok and sure._last.agreed


def test_the_next_assessment_begins_where_the_bone_was_followed_to_with_its_rivals(sure, frames, prepared):
    poses = sure._memory.poses
    for pair in frames[1:4]:
        found = sure.follow(pair.source, prepared)
    motion = se3.inverse(poses[0]) @ found.T_target_source
    assert len(poses) > 1 and apart_mm(motion, np.eye(4), frames[0]) > 1.0
    np.testing.assert_allclose(sure._memory.now, poses @ motion, atol=1e-9)
    np.testing.assert_allclose(sure._memory.propose(None, prepared, None).poses, poses @ motion, atol=1e-9)
    result = sure.register(frames[4].source, prepared)
    assert result.ok and result.proposer == "track" and is_right(result.T_target_source, frames[4])
    np.testing.assert_allclose(sure._memory.now[0], result.T_target_source, atol=1e-9)
    step = se3.inverse(found.T_target_source) @ result.T_target_source
    np.testing.assert_allclose(sure._memory.now[1:], poses[1:] @ motion @ step, atol=1e-6)


def test_a_full_registration_is_not_put_off_by_following(registrar, frames, prepared):
    tracker = Tracker(registrar, recheck=2)
    found = []
    for pair in frames[:3]:
        found.append(tracker.register(pair.source, prepared).proposer)
        tracker.follow(pair.source, prepared)
    assert [name == "track" for name in found] == [False, True, False]


def test_a_refused_source_leaves_the_track_where_it_was_followed_to(sure, frames, prepared):
    for pair in frames[1:3]:
        sure.follow(pair.source, prepared)
    before = sure._memory.now
    noise = np.random.default_rng(0).uniform(-60.0, 60.0, (500, 3))
    assert sure.register(noise, prepared).status is not RegistrationStatus.OK
    np.testing.assert_array_equal(sure._memory.now, before)
    assert sure.register(frames[3].source, prepared).proposer == "track"


def test_a_followed_pose_is_the_callers_own(sure, frames, prepared):
    """In metres at once, it ended following: the tracker's own pose was in metres then."""
    for pair in frames[1:4]:
        found = sure.follow(pair.source, prepared)
        assert found is not None and is_right(found.T_target_source, pair)
        found.T_target_source[:3, 3] /= 1000.0
    after = sure.register(frames[4].source, prepared)
    assert after.ok and is_right(after.T_target_source, frames[4])
