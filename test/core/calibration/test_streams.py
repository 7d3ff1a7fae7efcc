"""Streams to learn from: drawn by their number, judged frame by frame."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from gapr_core import RegistrationStatus
from gapr_core.calibration import collect, pairs, streams
from gapr_core.calibration.answers import answers_of
from gapr_core.calibration.pairs import Task
from gapr_core.data.pair import Pair
from gapr_core.data.smooth_bias import SMOOTH_BIASES
from gapr_core.data.stream import Motion, simulate
from gapr_core.geometry import se3
from gapr_core.registration.confidence.features import STREAM, STREAM_FEATURES
from gapr_core.results import Hypothesis, RegistrationResult

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


class Said:
    """A tracker that says the same of every frame but the first, of which nothing is known."""

    def __init__(self, status, pose):
        accepted = pose if status is RegistrationStatus.OK else None
        self.result = RegistrationResult(status, accepted, hypotheses=(Hypothesis(pose, 0.5),))
        self.asked = 0

    def register(self, source, target):
        self.asked += 1
        features = dict.fromkeys(STREAM_FEATURES, 0.25) if self.asked > 1 else {}
        return replace(self.result, features=features | {"margin": 1.0})


@pytest.mark.parametrize(
    ("status", "off_mm", "right"), [(RegistrationStatus.OK, 0.0, True), (RegistrationStatus.LOW_CONFIDENCE, 9.0, False)]
)
def test_every_frame_of_which_others_say_something_is_an_answer(monkeypatch, status, off_mm, right):
    pose = se3.exp([off_mm, 0.0, 0.0, 0.0, 0.0, 0.0])
    points = np.random.default_rng(0).normal(0.0, 20.0, (50, 3))
    frame = Pair(points, points, np.eye(4), "", "femur", "p0", "stream", {})
    said = Said(status, pose)
    monkeypatch.setattr(streams, "draw_stream", lambda task: ("waves", "own", ("p0",), [frame] * 4))
    monkeypatch.setattr(streams, "tracker_of_frames_alone", lambda: said)
    monkeypatch.setattr(streams, "_registrar", lambda: SimpleNamespace(prepare=lambda target: None))
    record = collect.record_of(TASK)
    assert record["family"] == "stream-waves" and list(record["answers"]) == [f"{STREAM} {k}" for k in (1, 2, 3)]
    made_of = {False: "of single answers", True: "of streams"}
    assert collect._is_current(record | {"made_of": "of streams"}, made_of)
    assert not collect._is_current(record | {"made_of": "of single answers"}, made_of)
    answers = answers_of([record], STREAM)
    assert len(answers) == 3 and answers.right.tolist() == [right] * 3
    assert not answers.refused.any()
    assert answers.features.tolist() == [[0.25] * 3] * 3 and answers.people == (("p0",),) * 3


def test_the_frames_count_one_by_one_whatever_they_share():
    tracker = streams.tracker_of_frames_alone()
    for shared in (-1.0, 0.0, 2.0):
        features = dict(zip(STREAM_FEATURES, (1.5, shared, -shared), strict=True))
        assert tracker._stream.model.value(features) == pytest.approx(1.5)
