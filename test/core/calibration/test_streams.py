"""Streams to learn from: drawn by their number, judged frame by frame."""

from dataclasses import replace

import numpy as np
import pytest

from gapr_core.calibration import collect, pairs, streams
from gapr_core.calibration.answers import STREAM
from gapr_core.calibration.pairs import Task
from gapr_core.data.smooth_bias import SMOOTH_BIASES
from gapr_core.data.stream import Motion, simulate
from gapr_core.geometry import se3
from gapr_core.registration.confidence.classifier import Judgement, joint

TASK = Task("folder", "train", 0, 5, STREAM)


@pytest.fixture
def own(monkeypatch):
    monkeypatch.setattr(pairs, "WHAT", {"own": 1.0})
    monkeypatch.setattr(pairs, "TARGETS", {"own": 1.0})


def test_a_stream_is_a_function_of_its_task_and_its_truth_lays_every_frame_on_the_bone(people, own):
    (family, what, names, frames), (*_, again) = streams.draw_stream(TASK), streams.draw_stream(TASK)
    assert family in streams.BIASES and what == "own" and len(names) == 1 and len(frames) == streams.FRAMES
    bone = next(s for s in people["tibia"] if s.person == names[0])
    for frame, same in zip(frames, again, strict=True):
        np.testing.assert_array_equal(frame.source, same.source)
        np.testing.assert_array_equal(frame.target, frames[0].target)
        placed = se3.apply(frame.T_target_source, frame.source) + frame.metadata["origin_mm"]
        assert np.median(bone.distance(placed)) < 3.0
    other = streams.draw_stream(replace(TASK, number=7))[-1]
    assert not np.array_equal(other[0].source, frames[0].source)


def test_no_pose_of_another_subjects_stream_is_right(people, monkeypatch):
    monkeypatch.setattr(pairs, "WHAT", {"person": 1.0})
    _, what, names, frames = streams.draw_stream(TASK)
    assert what == "person" and len(names) == 2 and not any(frame.has_truth for frame in frames)


def test_every_other_stream_is_of_another_subjects_long_bone():
    tasks = streams.tasks("folder", "train", 3, 17)
    usual, alike = tasks[:9], tasks[9:]
    assert len(set(tasks)) == 17 and all(task.family == STREAM and task.seed == 3 for task in tasks)
    assert [task.number for task in usual] == list(range(9)) and not any(task.what for task in usual)
    found = [(pairs.BONES[task.number % len(pairs.BONES)], task.what) for task in alike]
    assert found == [(bone, "person") for bone in ("femur", "tibia")] * 4
    assert len({collect._name(task) for task in tasks}) == 17


def test_streams_have_targets_of_their_own(people, own):
    alone = pairs.setting_of("folder", "train", 0, TASK.number).cloud
    assert not np.array_equal(streams.draw_stream(TASK)[-1][0].target, alone)


def test_one_of_five_streams_jumps_halfway_and_biases_reach_the_largest_of_their_kind(people, own, monkeypatch):
    motions = []
    monkeypatch.setattr(streams, "simulate", lambda source, seed, motion: motions.append(motion) or [])
    setting = pairs.setting_of("folder", "train", 0, 0)
    monkeypatch.setattr(pairs, "setting_of", lambda *_: setting)
    families = [streams.draw_stream(replace(TASK, number=number))[0] for number in range(300)]
    jumps = [motion.jump_every for motion in motions]
    assert set(jumps) == {0, 6} and jumps.count(6) / 300 == pytest.approx(0.2, abs=0.07)
    largest_mm = {"wave": 1.5, "waves-peak": 1.5, "waves-rms": 1.06, "gp-peak": 1.5, "gp-rms": 1.06}
    assert {motion.smooth_bias for motion in motions} == set(largest_mm)
    for family, motion in zip(families, motions, strict=True):
        assert motion.smooth_bias.split("-")[0] == family
    for kind, most_mm in largest_mm.items():
        sizes = np.array([motion.bias_mm for motion in motions if motion.smooth_bias == kind]) / most_mm
        assert 0.0 <= sizes.min() < 0.15 and 0.85 < sizes.max() <= 1.0
        assert sizes.mean() == pytest.approx(0.5, abs=0.12)


@pytest.mark.parametrize("stays", [True, False])
def test_a_bias_is_that_of_the_bone_or_of_the_frame(people, monkeypatch, stays):
    drawn = []

    def bias(points, size_mm, rng):
        drawn.append(len(points))
        return np.full(len(points), size_mm)

    monkeypatch.setitem(SMOOTH_BIASES, "waves-peak", bias)
    frames = simulate(people["femur"][0], 3, Motion(frames=3, noise_mm=0.0, outlier_share=0.0, bias_stays=stays))
    assert len(drawn) == (1 if stays else 3)
    for frame in frames:
        placed = se3.apply(frame.T_target_source, frame.source) + frame.metadata["origin_mm"]
        assert np.median(people["femur"][0].distance(placed)) == pytest.approx(0.7, abs=0.05)


def test_every_frame_is_an_answer_with_its_numbers_alone(specimen, quick, monkeypatch):
    frames = simulate(specimen, 1, Motion(frames=3, share=0.7, points=1500, noise_mm=0.3, bias_mm=0.0))
    monkeypatch.setattr(streams, "draw_stream", lambda task: ("waves", "own", ("p0",), frames))
    monkeypatch.setattr(streams, "_registrar", lambda: quick)
    record = collect.record_of(TASK)
    assert record["family"] == "stream-waves" and list(record["answers"]) == [f"{STREAM} {k}" for k in range(3)]
    target = quick.prepare(frames[0].target)
    for number, frame in enumerate(frames[:1]):
        alone, answer = quick.register(frame.source, target), record["answers"][f"{STREAM} {number}"]
        numbers = Judgement(answer["features"]["pose"], answer["features"]["bone"])
        assert joint(numbers, quick.config.other_bone_prior) == pytest.approx(alone.confidence, abs=1e-4)
        assert answer["right"] and answer["refusal"] is None
    made_of = {False: "of single answers", True: "of streams"}
    assert collect._is_current(record | {"made_of": "of streams"}, made_of)
    assert not collect._is_current(record | {"made_of": "of single answers"}, made_of)


def records_of(frames, what="own", right=True):
    """Streams (S, N, 2) of numbers of the pose and of the bone."""
    return [
        {"name": f"0-{STREAM}-{number}", "what": what, "answers": {
            f"{STREAM} {k}": {"features": {"pose": pose, "bone": bone}, "right": right, "refusal": None}
            for k, (pose, bone) in enumerate(stream)}}
        for number, stream in enumerate(frames)
    ]  # fmt: skip


def simulated(rng, count, between, within, mean=0.0):
    """Streams of 2 to 12 frames with effects of the stream and of the frame of these deviations, each (2,)."""
    return [
        mean + rng.normal(0.0, between, 2) + rng.normal(0.0, within, (rng.integers(2, 13), 2)) for _ in range(count)
    ]


@pytest.mark.parametrize(("between", "within"), [((1.5, 0.5), (0.8, 1.0)), ((0.3, 2.0), (1.0, 0.4))])
def test_the_correlations_are_the_shares_of_variance_that_frames_have_in_common(between, within):
    rng = np.random.default_rng(0)
    own, others = (simulated(rng, 600, between, within, mean) for mean in ((4.0, 2.0), (-3.0, -1.0)))
    expected = [b**2 / (b**2 + w**2) for b, w in zip(between, within, strict=True)]
    found = streams.correlations(records_of(own) + records_of(others, "person", False))
    assert found == pytest.approx(expected, abs=0.04), "the classes' own means are no common effect"
    assert streams.correlations(records_of(own)) == pytest.approx(expected, abs=0.05)


def test_what_is_no_right_pose_of_the_own_bone_says_nothing_of_the_correlation_of_poses():
    rng = np.random.default_rng(1)
    own = records_of(simulated(rng, 300, (1.0, 1.0), (1.0, 1.0)))
    wrong = records_of(simulated(rng, 300, (9.0, 9.0), (1.0, 1.0)), right=False)
    others = records_of(simulated(rng, 300, (9.0, 1.0), (1.0, 1.0)), "person", False)
    single = [{"name": "0-5", "what": "own", "answers": {}}]
    assert streams.correlations(own + wrong + others + single) == pytest.approx((0.5, 0.5), abs=0.06)


def test_without_streams_or_of_numbers_that_are_all_alike_a_usual_correlation_is_taken():
    assert streams.correlations([]) == (streams.UNKNOWN_RHO,) * 2
    assert streams.correlations(records_of(np.ones((5, 4, 2)))) == (streams.UNKNOWN_RHO,) * 2
