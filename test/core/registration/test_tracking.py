"""A stream of sources: near the last pose first, in full if that is not sure."""

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

from gapr_core import Registrar, RegistrarConfig, RegistrationStatus, Tracker
from gapr_core.data.stream import Motion, simulate
from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_core.geometry import se3
from gapr_core.registration.streams import tracker as trackers
from gapr_core.registration.streams.evidence import fingerprint, is_repeated
from gapr_core.registration.streams.memory import PreviousPoses
from gapr_core.registration.uncertainty.error_calibration import Precision
from gapr_core.surface import Surface

MOTION = Motion(frames=4, share=0.35, points=2000)


@pytest.fixture(scope="module")
def frames(specimen):
    return simulate(specimen, 1, MOTION)


@pytest.fixture(scope="module")
def prepared(registrar, frames):
    return registrar.prepare(frames[0].target)


@pytest.fixture
def tracker(registrar):
    return Tracker(registrar)


def is_right(result, pair):
    shift_mm, turn_deg = se3.pose_error(result.T_target_source, pair.T_target_source, pair.source)
    return shift_mm < 4.0 and turn_deg < 5.0


def test_after_the_first_source_only_what_is_remembered_is_asked(tracker, frames, prepared):
    results = [tracker.register(pair.source, prepared) for pair in frames]
    assert [r.proposer == "track" for r in results] == [False, True, True, True]
    assert all(is_right(r, pair) for r, pair in zip(results, frames, strict=True))
    assert all(r.confidence >= tracker.registrar.config.sure for r in results[1:])


def test_a_stream_of_meshes_is_tracked_too_until_a_reset(tracker, frames, prepared):
    meshes = [Surface(pair.source, np.array([[0, 1, 2]])) for pair in frames]
    results = [tracker.register(mesh, prepared) for mesh in meshes]
    assert [r.proposer == "track" for r in results] == [False, True, True, True]
    tracker.reset()
    assert tracker.register(meshes[0], prepared).proposer != "track"


@pytest.fixture
def unsure(registrar, believing):
    """Makes a tracker to which every tracked answer has one probability, which is not sure."""

    def made(probability=0.9):
        tracker = Tracker(Registrar(registrar.config, registrar.proposers, believing(0.99)))
        tracker._tracking.classifier = believing(probability)
        return tracker

    return made


@pytest.mark.parametrize(("probability", "stands"), [(0.9, True), (0.81, True), (0.79, False)])
def test_a_tracked_answer_that_is_not_sure_stands_in_a_sure_stream(unsure, frames, prepared, probability, stands):
    tracker = unsure(probability)
    tracker.register(frames[0].source, prepared)
    assert (tracker.register(frames[1].source, prepared).proposer == "track") is stands


def test_it_does_not_stand_where_the_pose_has_jumped(unsure, frames, prepared, monkeypatch):
    monkeypatch.setattr(trackers, "AGREE_MM", 0.0)
    tracker = unsure()
    tracker.register(frames[0].source, prepared)
    assert tracker.register(frames[1].source, prepared).proposer != "track"


@pytest.mark.parametrize("change", [
    {"confidence": 0.94}, {"status": RegistrationStatus.AMBIGUOUS, "T_target_source": None},
])  # fmt: skip
def test_it_does_not_stand_after_a_source_that_was_not_sure_or_refused(unsure, frames, prepared, change):
    tracker = unsure()
    first = tracker.register(frames[0].source, prepared)
    tracker._remember(replace(first, **change), frames[0].source)
    assert tracker.register(frames[1].source, prepared).proposer != "track"


@pytest.mark.parametrize("what", ["nothing", "a line", "metres"])
def test_nor_after_a_source_that_was_refused_before_any_pose_of_it_was_looked_at(unsure, frames, prepared, what):
    line = np.linspace(0.0, 60.0, 300)[:, None] * [[1.0, 0.0, 0.0]]
    refused = {"nothing": np.zeros((2, 3)), "a line": line, "metres": line * 1000.0}[what]
    tracker = unsure()
    tracker.register(frames[0].source, prepared)
    with suppress(InvalidPointCloudError):
        assert not tracker.register(refused, prepared).ok
    assert tracker.register(frames[1].source, prepared).proposer != "track"


def test_the_mirror_image_of_a_tracked_source_is_sought_without_the_memory(unsure, frames, prepared, monkeypatch):
    """What is remembered are poses of the source itself."""
    tracker, asked = unsure(), []
    tracker.register(frames[0].source, prepared)
    propose = PreviousPoses.propose
    monkeypatch.setattr(PreviousPoses, "propose", lambda *given: asked.append(given[1]) or propose(*given))
    second = tracker.register(frames[1].source[:350], prepared)
    assert second.proposer == "track" and len(asked) == 1


def test_what_corrects_the_errors_of_the_registrar_corrects_those_of_the_tracker(registrar, frames, prepared):
    tre_mm = []
    for learned in (Precision.unscaled(), registrar.precision):
        given = Registrar(registrar.config, registrar.proposers, registrar.classifier, precision=learned)
        tracker = Tracker(given)
        tracker.register(frames[0].source, prepared)
        tracked = tracker.register(frames[1].source, prepared)
        assert tracked.proposer == "track"
        tre_mm.append(tracked.tre_mm)
    assert tre_mm[0] != tre_mm[1]


def test_a_jump_is_found_by_a_full_registration(tracker, frames, prepared):
    tracker.register(frames[0].source, prepared)
    elsewhere = se3.exp([90.0, -60.0, 40.0, 1.2, -0.8, 2.0])
    result = tracker.register(se3.apply(elsewhere, frames[1].source), prepared)
    assert result.proposer != "track"
    assert result.ok
    shift_mm, turn_deg = se3.pose_error(result.T_target_source @ elsewhere, frames[1].T_target_source, frames[1].source)
    assert shift_mm < 4.0 and turn_deg < 5.0


def test_a_wrong_track_is_left(tracker, frames, prepared):
    """Every remembered pose is wrong: none may be followed."""
    first = tracker.register(frames[0].source, prepared)
    rivals = [hypothesis.T_target_source for hypothesis in first.hypotheses[1:]]
    tracker._memory.poses = np.stack([*rivals[-1:], *rivals[:-1]])
    result = tracker.register(frames[1].source, prepared)
    assert result.ok and is_right(result, frames[1])


def test_another_target_and_a_given_pose_start_a_new_track(tracker, frames, prepared, registrar):
    tracker.register(frames[0].source, prepared)
    given = tracker.register(frames[1].source, prepared, initial=frames[1].T_target_source)
    assert given.ok and given.proposer != "track"
    other = tracker.register(frames[2].source, registrar.prepare(frames[0].target))
    assert other.ok and other.proposer != "track"


def test_after_a_reset_nothing_is_remembered(tracker, frames, prepared):
    tracker.register(frames[0].source, prepared)
    tracker.reset()
    assert tracker.register(frames[1].source, prepared).proposer != "track"


def test_every_so_many_sources_one_is_registered_in_full(registrar, frames, prepared):
    tracker = Tracker(registrar, recheck=2)
    tracked = [tracker.register(pair.source, prepared).proposer == "track" for pair in frames]
    assert tracked == [False, True, False, True]
    with pytest.raises(ConfigError, match="at least 1"):
        Tracker(registrar, recheck=0)


def test_a_full_registration_weighs_the_last_pose_and_its_rivals(registrar, frames, prepared, monkeypatch):
    tracker, begun, assess = Tracker(registrar, recheck=2), [], Registrar.assess

    def recorded(self, source, target, start, *rest):
        begun.append(start)
        return assess(self, source, target, start, *rest)

    monkeypatch.setattr(Registrar, "assess", recorded)
    for pair in frames[:2]:
        tracker.register(pair.source, prepared)
    remembered = tracker._memory.poses
    tracker.register(frames[2].source, prepared)
    assert len(remembered) > 1 and not len(begun[0])
    np.testing.assert_array_equal(begun[-1], remembered)


def test_a_refused_source_does_not_end_the_track(tracker, frames, prepared):
    tracker.register(frames[0].source, prepared)
    noise = np.random.default_rng(0).uniform(-60.0, 60.0, (500, 3))
    assert not tracker.register(noise, prepared).ok
    assert not tracker.register(np.zeros((5, 3)), prepared).ok
    assert tracker.register(frames[1].source, prepared).proposer == "track"


def test_after_a_refused_full_registration_the_next_one_is_full_as_well(registrar, frames, prepared):
    tracker = Tracker(registrar, recheck=2)
    noise = np.random.default_rng(0).uniform(-60.0, 60.0, (500, 3))
    sources = [frames[0].source, frames[1].source, noise, frames[2].source, frames[3].source]
    results = [tracker.register(source, prepared) for source in sources]
    assert [r.proposer == "track" for r in results] == [False, True, False, False, True]
    assert [r.ok for r in results] == [True, True, False, True, True]


def test_a_pose_without_rivals_is_not_followed(frames, prepared, believing):
    """One pose looked at alone has nothing to be weighed against."""

    class Truth:
        name = "truth"

        def prepare(self, target):
            pass

        def propose(self, source, target, rng):
            return frames[0].T_target_source[None]

    tracker = Tracker(Registrar(RegistrarConfig(num_threads=1), [Truth()], believing(0.9)))
    assert tracker.register(frames[0].source, prepared).ok
    assert tracker.register(frames[0].source, prepared).proposer == "truth"


@pytest.mark.parametrize("answer", [0, 1, 2])
def test_the_rivals_move_with_the_source_whichever_of_them_is_followed(answer):
    memory, rng = PreviousPoses(), np.random.default_rng(2)
    poses = [se3.exp(rng.normal(size=6) * [30, 30, 30, 1, 1, 1]) for _ in range(3)]
    memory.poses = np.stack(poses)
    moved = se3.exp([2.0, -1.0, 0.5, 0.02, 0.01, -0.03])
    memory.follow(poses[answer] @ moved, rng.normal(size=(50, 3)) * 20.0)
    others = [pose for k, pose in enumerate(poses) if k != answer]
    np.testing.assert_allclose(memory.poses, [pose @ moved for pose in (poses[answer], *others)], atol=1e-9)


def test_sources_that_cannot_be_registered_do_not_put_off_the_next_full_registration(registrar, frames, prepared):
    tracker = Tracker(registrar, recheck=2)
    found = []
    for pair in frames[:3]:
        found.append(tracker.register(pair.source, prepared).proposer)
        assert not tracker.register(np.zeros((5, 3)), prepared).ok
    assert [name == "track" for name in found] == [False, True, False]


def test_a_stream_is_seeded_and_its_frames_lie_on_the_bone(specimen, frames):
    again = simulate(specimen, 1, MOTION)
    for pair, same in zip(frames, again, strict=True):
        assert np.array_equal(pair.source, same.source) and np.array_equal(pair.target, frames[0].target)
        on_bone = se3.apply(pair.T_target_source, pair.source)
        gaps = np.linalg.norm(on_bone[:, None] - pair.target[None, ::8], axis=2).min(axis=1)
        assert np.median(gaps) < 6.0
    steps = [se3.rotation_angle_deg(se3.inverse(a.T_target_source) @ b.T_target_source)
             for a, b in zip(frames, frames[1:], strict=False)]  # fmt: skip
    assert max(steps) <= MOTION.step_deg + 1e-6


def test_a_bone_that_jumps_is_elsewhere(specimen):
    first, second = simulate(specimen, 1, Motion(frames=2, jump_every=1))
    away = first.T_target_source @ se3.inverse(second.T_target_source)
    assert se3.rotation_angle_deg(away) > 10.0


def test_what_a_stream_says_decides_with_the_frame(registrar, believing, frames, prepared, monkeypatch):
    """A frame that would be accepted alone is refused after many that did not fit."""
    tracker = Tracker(Registrar(registrar.config, registrar.proposers, believing(0.7)))
    assert tracker.register(frames[0].source, prepared).ok and tracker.register(frames[1].source, prepared).ok
    with monkeypatch.context() as doubting:
        for each in (tracker.registrar, tracker._tracking):
            doubting.setattr(each, "classifier", believing(0.1))
        for pair in frames:
            tracker.register(pair.source, prepared)
    late = tracker.register(frames[2].source, prepared)
    assert late.status is RegistrationStatus.LOW_CONFIDENCE and late.confidence < 0.5
    tracker.reset()
    assert tracker.register(frames[2].source, prepared).ok


def test_agreeing_frames_raise_both_numbers_to_what_their_correlation_allows(registrar, believing, frames, prepared):
    by_rho = []
    for rho in (1.0, 0.5):
        classifier = replace(believing(0.7), rho_pose=rho, rho_bone=rho)
        tracker = Tracker(Registrar(registrar.config, registrar.proposers, classifier))
        by_rho.append([tracker.register(pair.source, prepared).pose_probability for pair in frames])
    repeated, growing = by_rho
    assert repeated == pytest.approx([0.7] * 4)
    odds = (0.7 / 0.3) ** (4.0 / (1.0 + 3.0 * 0.5))
    assert growing[0] == pytest.approx(0.7) and growing[3] == pytest.approx(odds / (1.0 + odds))


def test_a_call_that_cannot_be_answered_changes_nothing(registrar, frames, prepared):
    tracker = Tracker(registrar)
    tracker.register(frames[0].source, prepared)
    for target, initial in ((frames[0].target, None), (prepared, np.zeros((4, 4)))):
        with pytest.raises(InvalidPointCloudError):
            tracker.register(frames[1].source, target, initial)
    assert tracker.register(frames[1].source, prepared).proposer == PreviousPoses.name


def test_sources_that_share_their_points_count_as_one(registrar, believing, frames, prepared):
    tracker = Tracker(Registrar(registrar.config, registrar.proposers, believing(0.7))).sharing_points()
    found = [tracker.register(pair.source, prepared).confidence for pair in frames[:3]]
    assert found == pytest.approx([found[0]] * 3)


@pytest.mark.parametrize("jumped", [False, True])
@pytest.mark.parametrize("jitter_mm", [0.0, 1e-5])
def test_a_source_that_is_sent_again_is_no_surer(registrar, frames, prepared, jumped, jitter_mm):
    """Or a refusal became a pose by asking again; also where its points are rounded otherwise, or in another order."""
    rng = np.random.default_rng(0)
    tracker = Tracker(registrar)
    tracker.register(frames[0].source, prepared)
    source = se3.apply(se3.exp([60.0, 0.0, 0.0, 0.0, 0.0, 0.3]), frames[1].source) if jumped else frames[1].source
    first = tracker.register(source, prepared)
    assert first.ok
    for _ in range(6):
        again = rng.permutation(source) + rng.normal(0.0, 1.0, source.shape) * jitter_mm
        assert tracker.register(again, prepared).confidence <= first.confidence + (1e-4 if jitter_mm else 1e-5)


def test_a_source_that_jumped_counts_once_however_often_it_is_sent_again(registrar, believing, frames, prepared):
    """Sent again, it does not continue the frames before the jump, and so brings nothing of them back."""
    elsewhere = se3.exp([60.0, 0.0, 0.0, 0.0, 0.0, 0.3])
    before, jumped = [pair.source for pair in frames[:2]], [se3.apply(elsewhere, pair.source) for pair in frames[2:]]
    classifier = replace(believing(0.8), rho_pose=0.5)

    def said_last(*sources):
        tracker = Tracker(Registrar(registrar.config, registrar.proposers, classifier))
        return [tracker.register(source, prepared).confidence for source in sources][-1]

    once = said_last(*before, *jumped)
    assert said_last(*before, jumped[0], *jumped) == pytest.approx(once)
    assert once < said_last(*before, *(pair.source for pair in frames[2:]))


@pytest.mark.parametrize("count", [12, 2000, 120_000])
def test_a_cloud_is_the_same_in_any_order_and_rounding_and_another_one_with_noise_of_its_own(count):
    rng = np.random.default_rng(0)
    points = rng.normal(0.0, 30.0, (count, 3)) + [900.0, -40.0, 300.0]

    def same(other):
        return is_repeated(fingerprint(other), fingerprint(points))

    assert same(rng.permutation(points)) and same(points.astype(np.float32).astype(float))
    assert not same(points + rng.normal(0.0, 0.1, points.shape)) and not same(points[1:]) and not same(points[:0])
    for there in np.eye(3):
        assert not same(points + 1.1e-4 * there), "one mean is another"
        assert not same(points + (points - points.mean(axis=0)) * there * 2e-5), "one spread is another"


def test_a_tracker_of_bone_alone_has_a_stream_of_its_own(registrar, frames, prepared):
    tracker = Tracker(registrar)
    tracker.register(frames[0].source, prepared)
    alone = tracker.of_bone_alone()
    assert not len(alone._memory.poses) and not alone._has_track
    alone.register(frames[3].source, prepared)
    alone.reset()
    assert tracker._has_track and len(tracker._memory.poses) and tracker._evidence is not alone._evidence


def test_a_tracker_of_bone_alone_infers_no_viewpoint_and_the_other_stays_as_it_is(tracker):
    alone = tracker.of_bone_alone()
    for each, is_inferred in ((alone, False), (tracker, True)):
        assert each.registrar.config.clutter.infer_viewpoint is is_inferred
        assert each._tracking.config.clutter.infer_viewpoint is is_inferred
