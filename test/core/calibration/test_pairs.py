"""What the models learn from."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from gapr_core.calibration import collect, pairs
from gapr_core.calibration.other_side import on_own_side
from gapr_core.calibration.pairs import Task
from gapr_core.calibration.shapes import SHAPES, turned_pair
from gapr_core.calibration.views import thinned_view
from gapr_core.config import SENSOR_KINDS
from gapr_core.data import anatomy, protocols
from gapr_core.data.pool import parametric_specimen
from gapr_core.errors import ConfigError
from gapr_core.geometry import se3
from gapr_core.surface import Surface

FOLDER = "folder"


def draw(monkeypatch, seen_as, what, target="own", number=5):
    monkeypatch.setattr(pairs, "SEEN_AS", {"family": {seen_as: 1.0}})
    monkeypatch.setattr(pairs, "WHAT", {what: 1.0})
    monkeypatch.setattr(pairs, "TARGETS", {target: 1.0})
    pairs.setting_of.cache_clear()
    return pairs.draw(Task(FOLDER, "train", 0, number))


@pytest.mark.parametrize("seen_as", [name for views in pairs.SEEN_AS.values() for name in views])
def test_every_view_is_a_function_of_its_task_and_its_truth_lays_the_source_on_the_bone(people, monkeypatch, seen_as):
    drawn, again = draw(monkeypatch, seen_as, "own"), draw(monkeypatch, seen_as, "own")
    np.testing.assert_array_equal(drawn.pair.source, again.pair.source)
    np.testing.assert_array_equal(drawn.pair.target, again.pair.target)
    assert drawn.pair.has_truth and drawn.what == "own" and drawn.people == (drawn.pair.person,)
    bone = next(s for s in people["tibia"] if s.person == drawn.pair.person)
    placed = se3.apply(drawn.pair.T_target_source, drawn.pair.source) + drawn.pair.metadata["origin_mm"]
    on_bone = drawn.pair.metadata.get("is_bone", np.full(len(placed), True))
    assert np.median(bone.distance(placed[on_bone])) < 3.0
    other = draw(monkeypatch, seen_as, "own", number=6).pair
    assert len(other.source) != len(drawn.pair.source) or not np.array_equal(other.source, drawn.pair.source)


def test_pairs_in_a_row_share_a_target(people, monkeypatch):
    first, second, next_row = (draw(monkeypatch, "L2", "own", number=n).pair for n in (4, 7, 8))
    np.testing.assert_array_equal(first.target, second.target)
    assert first.person == second.person and not np.array_equal(first.source, second.source)
    assert not np.array_equal(first.target, next_row.target)


@pytest.mark.parametrize("what", ["person", "bone", "mirrored", "scaled"])
@pytest.mark.parametrize("target", ["own", "short"])
def test_of_another_bone_no_pose_is_right(people, monkeypatch, what, target):
    drawn = draw(monkeypatch, "L2", what, target)
    assert not drawn.pair.has_truth and drawn.what == what and drawn.pair.bone == "tibia"
    assert len(drawn.people) == (2 if what in ("person", "bone") else 1), "the other bone is another subject's, too"
    right = draw(monkeypatch, "L2", "own", target)
    np.testing.assert_array_equal(drawn.pair.target, right.pair.target)


@pytest.mark.parametrize("what", ["person", "bone"])
def test_of_another_bone_the_same_end_is_seen_where_the_target_is_short(people, monkeypatch, what):
    monkeypatch.setattr(pairs, "TARGETS", {"short": 1.0})
    task = Task(FOLDER, "train", 0, 5, what=what)
    setting = pairs.setting_of(FOLDER, "train", 0, 1)
    _, source = pairs.source_of(task, setting, np.random.default_rng(0))
    (whole,) = (bone for bone in people[source.bone] if bone.person == source.person)
    assert (source.bone, source.person) != (setting.whole.bone, setting.whole.person)
    np.testing.assert_array_equal(source.surface.points, whole.end(*setting.end).surface.points)
    assert np.ptp(source.surface.points, axis=0).max() < 0.7 * np.ptp(whole.surface.points, axis=0).max()


@pytest.mark.parametrize("seen_as", pairs.OWN_TARGET)
def test_a_piece_of_another_subject_is_put_before_the_target_and_not_before_the_bone_that_it_was_cut_out_of(
    people, monkeypatch, seen_as
):
    target = draw(monkeypatch, "L2", "own").pair.target
    of_another, own = (draw(monkeypatch, seen_as, what).pair for what in ("person", "own"))
    np.testing.assert_array_equal(of_another.target, target)
    assert not of_another.has_truth
    assert own.has_truth and (len(own.target) != len(target) or not np.array_equal(own.target, target))


def test_a_bone_of_a_wrong_scale_is_four_to_seven_percent_larger_or_smaller(people):
    rng, bone = np.random.default_rng(0), people["femur"][0]
    sizes = [np.ptp(pairs._scaled(bone, (), rng).surface.points, axis=0) / np.ptp(bone.surface.points, axis=0)
             for _ in range(40)]  # fmt: skip
    off = np.abs(np.array(sizes) - 1.0)
    assert np.ptp(sizes, axis=1).max() < 1e-9
    assert off.min() >= pairs.SCALES[0] - 1e-9 and off.max() <= pairs.SCALES[1] + 1e-9
    assert {bool(size[0] > 1.0) for size in sizes} == {True, False}


def test_a_mirrored_pelvis_is_judged_against_the_pose_of_its_other_side(people, monkeypatch):
    monkeypatch.setattr(pairs, "SYMMETRIC", ("tibia",))
    monkeypatch.setattr(
        pairs, "on_own_side", lambda mirrored, bone: se3.from_rotation_translation(np.eye(3), [9, 8, 7])
    )
    drawn = draw(monkeypatch, "L2", "mirrored")
    placed = se3.apply(drawn.pair.T_target_source, drawn.pair.source) + drawn.pair.metadata["origin_mm"]
    bone = next(s for s in people["tibia"] if s.person == drawn.pair.person)
    assert np.median(anatomy.mirrored(bone).distance(placed - [9.0, 8.0, 7.0])) < 2.0


def test_a_rib_cage_and_half_a_pelvis_are_not_mirrored(people, monkeypatch):
    monkeypatch.setattr(pairs, "SYMMETRIC", ("tibia",))
    assert draw(monkeypatch, "L2", "mirrored", "short").what == "own"
    assert draw(monkeypatch, "L2", "mirrored").what == "mirrored"


def test_the_other_side_of_a_bone_that_is_its_own_image_lies_on_the_bone():
    rng = np.random.default_rng(0)
    bone = parametric_specimen("pelvis", 0)
    mirrored = anatomy.mirrored(bone)
    T = on_own_side(mirrored, bone)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    assert np.median(bone.distance(se3.apply(T, mirrored.sample(500, rng)[0]))) < 3.0


def test_what_only_the_mirrored_bone_has_does_not_move_its_pose():
    bone = parametric_specimen("femur", 0)
    surface, more = bone.surface, bone.end(0.06, upper=True).surface  # 9 % of the area
    faces = np.vstack([surface.triangles, more.triangles + len(surface.points)])
    grown = replace(bone, surface=Surface(np.vstack([surface.points, more.points + [60.0, 0.0, 0.0]]), faces))
    moved = se3.apply(on_own_side(grown, bone), surface.points)
    assert np.sqrt(((moved - surface.points) ** 2).sum(axis=1).mean()) < 4.0  # 10 if all distances counted


def test_a_scanned_target_is_of_the_bone_but_not_on_its_surface(people, monkeypatch):
    own, scanned = (draw(monkeypatch, "L2", "own", target).pair for target in ("own", "scanned"))
    bone = next(s for s in people["tibia"] if s.person == scanned.person)
    off = [np.median(bone.distance(pair.target + pair.metadata["origin_mm"])) for pair in (own, scanned)]
    assert off[0] < 1e-3 < 0.05 < off[1] < 2.0
    placed = se3.apply(scanned.T_target_source, scanned.source) + scanned.metadata["origin_mm"]
    assert np.median(bone.distance(placed)) < 3.0


def test_twins_are_no_wrong_answer_to_each_other():
    femur = parametric_specimen("femur", 0)
    own, twin, stranger = (replace(femur, person=who) for who in ("jhu_15", "jhu_25", "jhu_1"))
    assert pairs.without_twins(own, [own, twin, stranger]) == [own, stranger]
    assert pairs.without_twins(stranger, [own, twin, stranger]) == [own, twin, stranger]


def test_no_pair_of_different_subjects_is_of_twins(monkeypatch):
    femur = parametric_specimen("femur", 0)
    everybody = [replace(femur, person=who) for who in ("jhu_15", "jhu_25", "jhu_1", "jhu_2")]
    monkeypatch.setattr(pairs, "_KEPT", {(FOLDER, "train"): {"femur": everybody}})
    setting = pairs.Setting(everybody[0], everybody[0], None, np.zeros((1, 3)), np.zeros(3))
    task, rng = Task(FOLDER, "train", 0, 0, what="person"), np.random.default_rng(0)
    assert {pairs.source_of(task, setting, rng)[1].person for _ in range(40)} == {"jhu_1", "jhu_2"}


@pytest.mark.parametrize("shape", SHAPES)
def test_of_a_shape_no_pose_can_be_known(shape):
    assert not SHAPES[shape](5).has_truth


def test_a_solid_of_revolution_is_one():
    pair = turned_pair(5)
    radii = np.linalg.norm(pair.target[:, :2], axis=1)
    order = np.argsort(pair.target[:, 2])
    assert np.abs(np.diff(radii[order])).mean() < 0.2  # the radius depends on the height alone


def test_the_shares_hold(people, monkeypatch):
    monkeypatch.setattr(pairs, "view", lambda seen_as, specimen, seed, around: _NoView(seen_as))
    monkeypatch.setattr(pairs, "before", lambda setting, stranger, what, pair: pair)
    monkeypatch.setattr(pairs, "setting_of", lambda *_: _NoView("none"))
    monkeypatch.setattr(pairs, "STRANGERS", dict.fromkeys(pairs.WHAT, lambda specimen, others, rng: specimen))
    monkeypatch.setattr(pairs, "without_twins", lambda specimen, others: others)
    drawn = [pairs.draw(Task(FOLDER, "train", 3, number)) for number in range(400)]
    what = [each.what for each in drawn]
    assert what.count("own") / 400 == pytest.approx(0.66, abs=0.07)
    assert set(what) == set(pairs.WHAT)
    assert len({each.family for each in drawn}) == len(pairs.SEEN_AS)
    kinds = {name: name.replace("-", "_") for name in pairs.SEEN_AS if name.replace("-", "_") in SENSOR_KINDS}
    assert all(each.sensor in ("unknown", kinds.get(each.family, "unknown")) for each in drawn)
    sensors = [each.sensor for each in drawn if each.family in kinds]
    assert len(sensors) > 80 and sensors.count("unknown") / len(sensors) == pytest.approx(0.5, abs=0.12)


def test_a_thinned_view_is_of_means_or_of_points_of_the_dense_one_each_in_half_of_the_cases(people, monkeypatch):
    one_sided, dense = protocols.one_sided, []
    monkeypatch.setattr(protocols, "one_sided", lambda *args: dense.append(one_sided(*args)) or dense[-1])
    thinned = [thinned_view(people["femur"][0], np.random.default_rng(seed)) for seed in range(30)]
    shares = []
    for before, after in zip(dense, thinned, strict=True):
        points = {tuple(point) for point in before.source}
        shares.append(np.mean([tuple(point) in points for point in after.source]))
        assert len(after.source) < 0.5 * len(before.source)
    assert all(share == 1.0 or share < 0.5 for share in shares)
    assert 8 <= shares.count(1.0) <= 22


def test_a_list_of_one_family_holds_nothing_else_and_is_a_list_of_its_own(people, monkeypatch):
    monkeypatch.setattr(pairs, "SHAPE_SHARE", 1.0)
    monkeypatch.setattr(pairs, "view", lambda seen_as, specimen, seed, around: _NoView(seen_as))
    monkeypatch.setattr(pairs, "before", lambda setting, stranger, what, pair: pair)
    drawn = [pairs.draw(Task(FOLDER, "train", 3, number, "scene")) for number in range(40)]
    assert {each.seen_as for each in drawn} == set(pairs.SEEN_AS["scene"])
    drawn = [pairs.draw(Task(FOLDER, "train", 3, number, "scene-stereo")) for number in range(3)]
    assert {(each.seen_as, each.family) for each in drawn} == {("scene-stereo", "scene-stereo")}
    names = {collect._name(Task(FOLDER, "train", 3, 1, family)) for family in ("", "scene", "laser")}
    assert names == {"3-1", "3-scene-1", "3-laser-1"}


def test_look_alikes_are_long_bones_of_all_families_and_rib_cages_every_other_one_of_another_subject(monkeypatch):
    monkeypatch.setattr(pairs, "view", lambda seen_as, specimen, seed, around: _NoView(seen_as))
    monkeypatch.setattr(pairs, "before", lambda setting, stranger, what, pair: pair)
    bones = {bone: [parametric_specimen(bone, number) for number in (0, 1)] for bone in ("femur", "tibia")}
    monkeypatch.setattr(pairs, "_KEPT", {(FOLDER, "train"): bones | {bone: [] for bone in ("pelvis", "thoracic")}})
    pairs.setting_of.cache_clear()
    both = pairs.look_alikes(FOLDER, "train", 3, 36)
    tasks, others, thinned, cameras, ribs = both[:36], both[36:72], both[72:90], both[90:100], both[100:]
    assert [(task.family, task.what) for task in ribs] == [("L3", "own"), ("L3", "person")] * 3 + [("L3", "own")]
    assert {pairs.BONES[task.number // pairs.IN_A_ROW % 4] for task in ribs} == {"thoracic"}
    others = [pairs.draw(task) for task in others]
    drawn = [pairs.draw(task) for task in tasks]
    assert [each.what for each in drawn + others] == ["own", "person"] * 36
    assert [(task.family, task.what) for task in thinned] == [("thinned", "own"), ("thinned", "person")] * 9
    assert len(cameras) == 10 and {task.family for task in cameras} == set(pairs.SCENES) - {pairs.AT_A_JOINT}
    assert [task.what for task in cameras] == ["own", "person"] * 5
    assert {each.seen_as for each in drawn} <= set(pairs.SEEN_AS["L3"])
    known = set(pairs.SEEN_AS) - {"L3", "scene", *pairs.HELD_OUT}
    assert {each.family for each in others[::2]} == {each.family for each in others[1::2]} == known
    kinds = {pairs.setting_of(FOLDER, "train", task.seed, task.number // pairs.IN_A_ROW).whole.bone for task in tasks}
    assert kinds == {"femur", "tibia"} and {task.seed for task in tasks} == {503}
    assert len(set(both)) == 107 and not {task.number for task in thinned + cameras} & {task.number for task in tasks}
    assert all(len(each.people) == 2 for each in drawn[1::2])
    assert collect._name(tasks[1]) == "503-L3-person-1"


def test_look_alikes_are_of_subjects_where_there_are_any(monkeypatch):
    monkeypatch.setattr(pairs, "view", lambda seen_as, specimen, seed, around: _NoView(seen_as))
    monkeypatch.setattr(pairs, "before", lambda setting, stranger, what, pair: pair)
    cohorts = ("ct", "drawn", "ct", "parametric", "ct")
    bones = {bone: [replace(parametric_specimen(bone, number), cohort=cohort) for number, cohort in enumerate(cohorts)]
             for bone in ("femur", "tibia")}  # fmt: skip
    monkeypatch.setattr(pairs, "_KEPT", {(FOLDER, "train"): bones | {bone: [] for bone in ("pelvis", "thoracic")}})
    pairs.setting_of.cache_clear()
    subjects = {f"parametric_{number}" for number in (0, 2, 4)}
    alike = [pairs.draw(task).people for task in pairs.look_alikes(FOLDER, "train", 3, 40)[:112]]
    assert {person for people in alike for person in people} == subjects
    any_bone = [pairs.draw(Task(FOLDER, "train", 3, number, "L3", "person")).people for number in range(8)]
    assert {person for people in any_bone for person in people} > subjects


class _NoView:
    def __init__(self, seen_as):
        self.seen_as, self.whole, self.specimen, self.person = seen_as, self, self, "nobody"
        self.bone, self.end = "femur", None


def test_another_bone_needs_its_name_and_meshes_only(tmp_path, monkeypatch):
    """It has no parametric subjects."""
    tibia = parametric_specimen("tibia", 0).surface
    people = [f"subject_{number}" for number in range(4)]
    points = np.stack([tibia.points * size for size in (1.0, 1.02, 0.98, 1.05)])
    np.savez(tmp_path / "fibula_mine.npz", points=points, faces=tibia.faces, person=people)
    (tmp_path / "splits.json").write_text(json.dumps({"train": people, "val": [], "test": []}))
    monkeypatch.setattr(pairs, "BONES", ("fibula",))
    monkeypatch.setattr(pairs, "DRAWN_PEOPLE", dict.fromkeys(pairs.DRAWN_PEOPLE, 2))
    monkeypatch.setattr(pairs, "_KEPT", {})
    found = pairs.bones_of(str(tmp_path), "train")["fibula"]
    assert [each.cohort for each in found] == ["mine"] * 4 + ["drawn"] * 2


def test_a_folder_that_is_none_is_one_line(tmp_path):
    command = [sys.executable, "-m", "gapr_core.calibration", "--anatomy", "nowhere", "--out", "out", "--count", "1"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=120)
    assert done.returncode == 1
    assert done.stderr.startswith("python -m gapr_core.calibration: expected a folder with anatomy; got nowhere")
    assert done.stderr.count("\n") == 1


def test_scenes_are_so_many_of_each_family_and_those_at_a_joint_are_of_subjects(monkeypatch):
    tasks = pairs.scenes(FOLDER, "train", 3, 5)
    assert [task.family for task in tasks] == [family for family in pairs.SCENES for _ in range(5)]
    assert [task.number for task in tasks] == list(range(5)) * len(pairs.SCENES)
    assert {task.family for task in tasks if task.real} == {"scene-joint"}


def test_a_bone_without_a_neighbour_is_seen_alone_and_one_with_gets_it(people, monkeypatch):
    monkeypatch.setattr(pairs, "SHAPE_SHARE", 1.0)
    monkeypatch.setattr(pairs, "before", lambda setting, stranger, what, pair: pair)
    seen = []

    def view(seen_as, specimen, seed, around=()):
        seen.append((seen_as, len(around)))
        if seen_as == "scene-joint" and len(seen) == 1:
            raise ConfigError("a neighbour", "none", "name one")
        return _NoView(seen_as)

    monkeypatch.setattr(pairs, "view", view)
    everybody = sum(len(group) for group in pairs.bones_of(FOLDER, "train").values())
    task = Task(FOLDER, "train", 3, 1, "scene-joint")
    assert [pairs.draw(task).seen_as for _ in range(2)] == ["scene-C2", "scene-joint"]
    assert seen == [("scene-joint", everybody), ("scene-C2", 0), ("scene-joint", everybody)]
