"""Records: each pair registered in every way, judged against the truth, and kept."""

import json
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gapr_core.calibration import collect, pairs
from gapr_core.calibration import shapes as odd_shapes
from gapr_core.calibration.answers import answers_of
from gapr_core.calibration.pairs import Drawn, Task
from gapr_core.data.pool import parametric_specimen
from gapr_core.data.protocols import make_pair
from gapr_core.geometry import se3
from gapr_core.registration.confidence.features import BONE, FEATURES_OF, SCENE
from gapr_core.registration.scenes import clutter
from gapr_core.registration.streams.memory import PreviousPoses
from gapr_core.results import Hypothesis, Refusal, RegistrationStatus
from gapr_core.runtime import origin

TASK = Task("folder", "train", 0, 1)
NAMES = ("network", "search", "search alone", "first round")


class Truth:
    """Proposes the pose that it was made with, and counts how often it is asked."""

    def __init__(self, pose, name="network"):
        self.pose, self.name, self.asked = pose, name, 0

    def prepare(self, target):
        """Nothing is needed."""

    def propose(self, source, target, rng):
        self.asked += 1
        return self.pose[None]


@pytest.fixture(scope="module")
def pair():
    return make_pair("L1", parametric_specimen("femur", 0), 1)


@pytest.fixture
def truth(pair, monkeypatch):
    """Both rounds know the truth; the pair is drawn as the subject's own bone, seen by a pointer."""
    proposer = collect.AskedOnce(Truth(pair.T_target_source))
    monkeypatch.setattr(collect, "_proposers", lambda: (proposer, Truth(pair.T_target_source, "search")))
    drawn = Drawn(pair, "pointer", "pointer", "own", ("p0",), "pointer")
    monkeypatch.setattr(pairs, "draw", lambda task: drawn)
    monkeypatch.setattr(collect, "FOLLOWED", 1.0)
    collect._registrars.cache_clear()
    yield proposer.proposer
    collect._registrars.cache_clear()


def test_a_record_holds_every_round_with_its_features_and_its_true_error(truth, pair):
    record = collect.record_of(TASK)
    assert json.loads(json.dumps(record)) == record
    assert {"network", "search"} <= set(record["answers"]) <= {"network", "search", "track"}
    assert (record["family"], record["what"], record["sensor"], record["people"]) == (
        "pointer",
        "own",
        "pointer",
        ["p0"],
    )
    answer = record["answers"]["search"]
    assert answer["right"] and tuple(answer["features"]) == FEATURES_OF[BONE]
    assert 0.0 < answer["true_mm"] < 2.0 and answer["rte_mm"] < 2.0 and 0.0 < answer["nees"] < 1000.0
    assert 0.0 < answer["tre_mm"] < answer["tre95_mm"]
    assert answers_of([record], BONE).right.all()


def test_a_pose_without_a_truth_is_wrong_and_has_no_error(truth, monkeypatch):
    shape = odd_shapes.box_pair(3)
    truth.pose = np.eye(4)
    monkeypatch.setattr(pairs, "draw", lambda task: Drawn(shape, "shape", "box", "shape", ()))
    answers = collect.record_of(TASK)["answers"]
    assert answers and all(not answer["right"] and "true_mm" not in answer for answer in answers.values())


def test_the_network_is_asked_once_for_both_rounds(truth):
    collect.record_of(TASK)
    assert truth.asked == 1


def test_a_proposer_that_is_asked_once_is_asked_again_for_another_target_or_source():
    proposer, points = Truth(np.eye(4)), np.zeros((5, 3))
    asked_once = collect.AskedOnce(proposer)
    first, other = SimpleNamespace(points=points), SimpleNamespace(points=points.copy())
    for source, target, count in ((first, first, 1), (other, first, 1), (first, other, 2), (first, first, 3)):
        asked_once.propose(source, target, np.random.default_rng(0))
        assert proposer.asked == count
    asked_once.propose(SimpleNamespace(points=points + 1.0), first, np.random.default_rng(0))
    assert proposer.asked == 4


def test_the_true_error_is_over_the_whole_bone_and_its_nees_is_about_the_points_that_were_fitted(pair):
    registrar = collect.accepting([Truth(pair.T_target_source, "search")], "unknown")
    seen = replace(pair, source=np.vstack([pair.source, pair.source[:40] + [0.0, 0.0, 600.0]]))
    found = registrar.assess(seen.source, registrar.prepare(pair.target))
    truth = se3.exp([3.0, -2.0, 1.0, 0.05, -0.04, 0.03]) @ pair.T_target_source
    answer = collect.judged_answer(found, replace(seen, T_target_source=truth))
    pose, points = found.fit.T, found.source.points
    on_bone = se3.apply(np.linalg.inv(truth), pair.target)
    apart = se3.apply(pose, on_bone) - pair.target
    assert answer["true_mm"] == pytest.approx(np.sqrt((apart**2).sum(axis=1).mean()))
    shift = (se3.apply(pose, points) - se3.apply(truth, points)).mean(axis=0)
    turn = Rotation.from_matrix(pose[:3, :3] @ truth[:3, :3].T).as_rotvec()
    error = np.concatenate([shift, turn])
    assert answer["nees"] == pytest.approx(error @ np.linalg.inv(found.uncertainty.covariance) @ error, rel=1e-6)


def test_the_search_answers_though_the_first_round_would_be_accepted(truth, pair):
    registrar = collect._registrars("pointer")["search"]
    found = registrar.assess(pair.source, registrar.prepare(pair.target))
    assert found.reaches(0.85) and (found.proposer, found.rounds) == ("search", 2)


def test_records_know_nothing_of_the_models_that_ship(truth, monkeypatch):
    for model in (
        "gapr_core.registration.registrar.Classifier.load",
        "gapr_core.registration.registrar.Precision.load",
    ):
        monkeypatch.setattr(model, lambda *_: pytest.fail("a model that ships was asked for"))
    assert collect.record_of(TASK)["answers"]["search"]["right"]


@pytest.mark.parametrize("given", [True, False])
def test_a_scene_is_registered_from_its_camera_or_from_both_ends_of_its_line_of_sight(monkeypatch, pair, given):
    eye, ends = np.array([0.0, 0.0, 500.0]), np.array([[0.0, 0.0, 450.0], [0.0, 0.0, -450.0]])
    asked: list[list[float]] = []

    class Registrar:
        """Keeps from where it was asked to look."""

        def assess(self, source, target, viewpoint=None):
            if viewpoint is not None:
                asked.append(viewpoint.tolist())
            return Refusal(RegistrationStatus.LOW_CONFIDENCE, "none")

    seen = replace(pair, metadata={"viewpoint": eye.tolist()} if given else {})
    drawn = Drawn(seen, "depth-camera", "depth-camera", "own", ("p0",), "")
    monkeypatch.setattr(pairs, "draw", lambda task: drawn)
    monkeypatch.setattr(collect, "_prepared", lambda cloud: None)
    monkeypatch.setattr(collect, "_registrars", lambda sensor: dict.fromkeys(NAMES, Registrar()))
    monkeypatch.setattr(clutter, "inferred_places", lambda *_: [(end, 1) for end in ends])
    collect.record_of(replace(TASK, number=collect.LOOKED_AT))
    assert asked == ([eye.tolist()] if given else ends.tolist())


def test_both_places_of_a_record_are_answers_of_the_round_of_scenes():
    answer = {"features": dict.fromkeys(FEATURES_OF[SCENE], 0.5), "refusal": None}
    answers = {"scene 0": answer | {"right": True}, "scene 1": answer | {"right": False}}
    facts = dict.fromkeys(("name", "family", "seen_as", "what", "bone"), "a") | {"people": ["p0"], "answers": answers}
    found = answers_of([facts], SCENE)
    assert found.right.tolist() == [True, False] and found.people == (("p0",), ("p0",))


def test_the_next_source_of_a_stream_is_a_part_of_the_view_and_the_memory_is_off_by_a_small_motion(pair):
    rng = np.random.default_rng(3)
    truth = pair.T_target_source
    rival = se3.exp(rng.normal(size=6) * 30.0) @ truth
    hypotheses = [Hypothesis(pose, 0.3) for pose in (truth, rival, rival @ rival)]
    forgotten = 0
    for seed in range(40):
        moved, memory = collect.moved_on(pair, hypotheses, np.random.default_rng(seed))
        assert isinstance(memory, PreviousPoses) and 0.45 * len(pair.source) < len(moved.source) <= len(pair.source)
        kept = {tuple(point) for point in pair.source}
        assert all(tuple(point) in kept for point in moved.source)
        forgotten += len(memory.poses) == 2
        best = truth if len(memory.poses) == 3 else rival
        error = se3.pose_error(memory.poses[0], best, moved.source)
        assert error.rte_mm <= collect.STEP_MM + 1e-6 and error.rre_deg <= collect.STEP_DEG + 1e-6
    assert 3 <= forgotten <= 18


def test_the_memory_of_a_stream_is_off_by_motions_of_all_sizes_and_its_rivals_by_the_same_motion(pair):
    truth = pair.T_target_source
    rival = se3.exp([30.0, 0.0, 10.0, 0.5, 0.0, 1.0]) @ truth
    shifts, turns = [], []
    for seed in range(60):
        moved, memory = collect.moved_on(pair, [Hypothesis(truth, 0.5), Hypothesis(rival, 0.4)],
                                         np.random.default_rng(seed))  # fmt: skip
        motion, of_rival = (np.linalg.inv(pose) @ kept for pose, kept in zip((truth, rival), memory.poses, strict=True))
        np.testing.assert_allclose(motion, of_rival, atol=1e-9)
        centre = moved.source.mean(axis=0, keepdims=True)
        shifts.append((se3.apply(motion, centre) - centre)[0])
        turns.append(np.degrees(Rotation.from_matrix(motion[:3, :3]).as_rotvec()))
    for motions, most in ((np.array(shifts), collect.STEP_MM), (np.array(turns), collect.STEP_DEG)):
        sizes = np.linalg.norm(motions, axis=1) / most
        assert sizes.mean() == pytest.approx(0.5, abs=0.12)
        assert sizes.min() < 0.15 and 0.85 < sizes.max() <= 1.0 + 1e-6
        assert np.abs(motions.mean(axis=0)).max() < 0.25 * most  # to all sides


def test_finished_records_are_kept_and_those_of_other_features_are_made_again(tmp_path, monkeypatch):
    features = dict.fromkeys(FEATURES_OF[BONE], 0.5)
    old = {name: value for name, value in features.items() if name != "mirror_margin"}
    answer = {"refusal": None, "right": True}
    path = tmp_path / "records.jsonl"
    bones = {"anatomy": "folder", "split": "train", "settings": origin.settings(collect.SETTINGS)}
    bones["made_of"] = collect._made_of("folder")[False]
    lines = [json.dumps(bones | {"name": f"0-{number}", "answers": {"search": answer | {"features": values}}}) + "\n"
             for number, values in enumerate((features, old, features))]  # fmt: skip
    path.write_text("".join(lines) + '{"name": "0-3", "answ')
    asked = []
    monkeypatch.setattr(pairs, "bones_of", lambda folder, split: {})
    monkeypatch.setattr(collect, "ProcessPoolExecutor", lambda *_: nullcontext(_Pool(asked)))
    tasks = [Task("folder", "train", 0, number) for number in (1, 2, 3)]
    found = collect.collect(tasks, path, 1)
    assert [record["name"] for record in found] == ["0-2", "0-1", "0-3"]
    assert [task.number for task in asked] == [1, 3]
    assert collect.collect(tasks, path, 1) and len(asked) == 2


@pytest.mark.parametrize("other", [{"split": "val"}, {"anatomy": "others"}, {"split": None}, {"settings": "others"},
                                   {"made_of": "others"}])  # fmt: skip
def test_records_of_other_bones_or_settings_are_made_again(tmp_path, monkeypatch, other):
    path, asked = tmp_path / "records.jsonl", []
    record = {"name": "0-1", "anatomy": "folder", "split": "train", "answers": {}}
    record["settings"] = origin.settings(collect.SETTINGS)
    record["made_of"] = collect._made_of(str(tmp_path / "folder"))[False]
    monkeypatch.setattr(pairs, "bones_of", lambda folder, split: {})
    monkeypatch.setattr(collect, "ProcessPoolExecutor", lambda *_: nullcontext(_Pool(asked)))
    task = Task(str(tmp_path / "folder"), "train", 0, 1)
    path.write_text(json.dumps(record) + "\n")
    assert collect.collect([task], path, 1) == [record] and not asked
    path.write_text(json.dumps(record | other) + "\n")
    assert collect.collect([task], path, 1) and asked == [task]


def test_records_change_with_bones_and_network_and_those_of_streams_with_every_model(tmp_path, monkeypatch):
    weights = tmp_path / "weights"
    weights.mkdir()
    bones = tmp_path / "bones"
    bones.mkdir()
    for path in (bones / "femur_a.npz", bones / "splits.json", weights / "net", weights / "precision.json"):
        path.write_bytes(b"1")
    monkeypatch.setattr(origin, "WEIGHTS", weights)
    monkeypatch.setattr(collect, "SHIPPED", weights / "net")
    found = [collect._made_of(str(bones))]
    changes = {bones / "femur_a.npz": True, bones / "splits.json": True, weights / "net": True,
               weights / "precision.json": False, bones / "notes.txt": None}  # fmt: skip
    for path, of_single_answers in changes.items():
        path.write_bytes(b"2")
        found.append(collect._made_of(str(bones)))
        before, after = found[-2:]
        assert (before[False] != after[False]) == bool(of_single_answers), path
        assert (before[True] != after[True]) == (of_single_answers is not None), path


class _Pool:
    """A pool that registers nothing."""

    def __init__(self, asked):
        self.asked = asked

    def map(self, _, tasks, chunksize):
        for task in tasks:
            self.asked.append(task)
            named = {"name": f"{task.seed}-{task.number}", "anatomy": "folder", "split": task.split}
            yield named | {"settings": origin.settings(collect.SETTINGS), "answers": {}}
