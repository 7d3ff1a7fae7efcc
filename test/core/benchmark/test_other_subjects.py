"""`benchmarks/other_subjects.py`: which pairs it makes, and how it counts."""

from collections import Counter
from dataclasses import replace

import numpy as np
import other_subjects
import pytest
from benchmark_cases import ok, record
from other_subjects import MIRRORED, SIDE, SIMILAR, SUBJECT, Case

from gapr_core.benchmark import records
from gapr_core.data import anatomy
from gapr_core.data.pool import parametric_specimen
from gapr_core.geometry import se3
from gapr_core.results import RegistrationResult, RegistrationStatus


@pytest.fixture(scope="module")
def bones():
    """Three subjects of each bone, all parametric."""
    made = [parametric_specimen(bone, number) for bone in anatomy.BONES for number in (0, 1, 2)]
    return {(bone.bone, bone.person): bone for bone in made}


def placed(pair):
    """The source where the truth says, in the frame of the surface."""
    return se3.apply(pair.T_target_source, pair.source) + pair.metadata["origin_mm"]


def test_sources_are_of_every_other_subject_in_turn_and_have_no_true_pose(bones):
    cases = [case for case in other_subjects.cases_of(bones, 48, 0, 0) if case.kind == SUBJECT]
    assert Counter(case.bone for case in cases) == dict.fromkeys(anatomy.BONES, 12)
    of_two = Counter((case.target, case.source) for case in cases if case.bone == "tibia")
    assert len(of_two) == 6 and set(of_two.values()) == {2} and all(target != source for target, source in of_two)
    assert len({case.name for case in cases}) == 48
    tibiae = {key: bone for key, bone in bones.items() if key[0] == "tibia"}
    assert other_subjects.cases_of(tibiae, 12, 0, 0) == [case for case in cases if case.bone == "tibia"]
    case = next(case for case in cases if case.bone == "tibia")
    pair = other_subjects.pair_of(case, bones)
    assert not pair.has_truth and pair.person == case.target and pair.metadata["source_person"] == case.source
    assert np.median(bones["tibia", case.target].distance(pair.target + pair.metadata["origin_mm"])) < 1e-3
    np.testing.assert_array_equal(pair.source, other_subjects.pair_of(case, bones).source)


def test_a_source_is_the_same_as_its_own_subjects_protocol_gives(bones):
    pair = other_subjects.pair_of(Case("tibia", "parametric_0", SUBJECT, "parametric_1", "L3", 4), bones)
    own = other_subjects.make_pair("L3", bones["tibia", "parametric_1"], 4)
    np.testing.assert_array_equal(pair.source, own.source)


def test_targets_that_are_most_similar_are_of_others_and_have_no_true_pose(bones, monkeypatch):
    tibiae = {key: bone for key, bone in bones.items() if key[0] == "tibia"}
    monkeypatch.setattr(other_subjects, "specimens", lambda *_: list(tibiae.values()))
    grown = other_subjects.similar_to(tibiae, None)
    assert len(grown) == 6 and all(grown[key].person != key[1] for key in grown)
    cases = other_subjects.cases_of_similar(grown, 18)
    assert Counter(case.level for case in cases) == dict.fromkeys(other_subjects.LEVELS, 6)
    case = cases[0]
    pair = other_subjects.pair_of(case, tibiae | {(bone, target): one for (bone, _, target), one in grown.items()})
    assert case.kind == SIMILAR and not pair.has_truth and case.source in case.target
    np.testing.assert_array_equal(pair.source, other_subjects.make_pair("L1", tibiae["tibia", case.source], 0).source)
    grown_to = grown["tibia", case.source, case.target].surface.points
    assert np.ptp(grown_to, axis=0).max() == pytest.approx(
        np.ptp(tibiae["tibia", case.source].surface.points, axis=0).max(), rel=0.05
    )


def test_real_subjects_are_not_mixed_with_parametric_ones(bones):
    real = {key: replace(bone, cohort="ct") for key, bone in bones.items() if key[1] != "parametric_2"}
    assert other_subjects.others(bones | real, "femur") == [
        ("parametric_0", "parametric_1"), ("parametric_1", "parametric_0")
    ]  # fmt: skip


def test_twins_are_no_other_subject(bones):
    twins = {("femur", who): replace(bones["femur", "parametric_0"], person=who) for who in ("jhu_15", "jhu_25")}
    assert other_subjects.others(twins, "femur") == []


def test_long_bones_are_mirrored_at_every_level_and_have_no_true_pose(bones):
    cases = [case for case in other_subjects.cases_of(bones, 0, 36, 0) if case.kind == MIRRORED]
    assert Counter(case.bone for case in cases) == {"femur": 18, "tibia": 18}
    assert set(Counter((case.bone, case.level) for case in cases).values()) == {6}
    assert all(case.source == case.target for case in cases)
    pair = other_subjects.pair_of(cases[0], bones)
    own = other_subjects.make_pair(
        cases[0].level, anatomy.mirrored(bones[cases[0].bone, cases[0].target]), cases[0].seed
    )
    assert not pair.has_truth
    np.testing.assert_array_equal(pair.source, own.source)


def test_a_mirrored_pelvis_lies_on_the_pelvis(bones):
    cases = [case for case in other_subjects.cases_of(bones, 0, 0, 12) if case.kind == SIDE]
    assert Counter(case.bone for case in cases) == {"pelvis": 6, "thoracic": 6}
    pair = other_subjects.pair_of(Case("pelvis", "parametric_0", SIDE, "parametric_0", "L1", 0), bones)
    assert pair.has_truth
    assert np.median(bones["pelvis", "parametric_0"].distance(placed(pair))) < 3.0


def test_a_stopped_run_goes_on_where_it_was(bones, tmp_path, monkeypatch):
    cases = other_subjects.cases_of(bones, 8, 0, 0)
    path = tmp_path / records.FILE
    records.write(path, [made(case, RegistrationResult(RegistrationStatus.AMBIGUOUS)) for case in cases])
    monkeypatch.setattr(other_subjects, "record_of", lambda case: pytest.fail("registered again"))
    assert [r.pair for r in other_subjects.run(cases, bones, path, 1)] == [case.name for case in cases]


def test_accepted_answers_are_counted_by_kind_and_bone_and_named_by_subject(bones):
    cases = [Case("tibia", "parametric_0", SUBJECT, "parametric_1", "L3", seed) for seed in range(4)]
    answers = [ok(np.eye(4), 0.95), ok(np.eye(4), 0.6), *[RegistrationResult(RegistrationStatus.CLUTTER)] * 2]
    found = [made(case, answer) for case, answer in zip(cases, answers, strict=True)]
    *_, of_tibia, of_all = other_subjects.table(found).splitlines()
    assert of_tibia == f"| {SUBJECT} | tibia | 1 | 4 | - | 2 | 50.00 (5.46 to 94.54) | 1 |"
    assert of_all == of_tibia.replace("tibia", "all")
    (line,) = other_subjects.alike(found, bones)
    assert line.startswith("tibia of parametric_0, source of parametric_1, ")
    assert line.endswith("2 of 4 accepted, at most at 0.95")


def test_most_similar_bones_are_counted_by_the_subject_whose_size_they_have(bones):
    cases = [Case("tibia", f"{other}-as-large-as-a", SIMILAR, "a", "L1", 0) for other in "bcd"]
    found = [made(case, ok(np.eye(4), 0.6)) for case in cases]
    assert (
        other_subjects.table(found).splitlines()[-2]
        == f"| {SIMILAR} | tibia | 1 | 3 | - | 3 | 100.00 (20.65 to 100.00) | 0 |"
    )


def test_the_distance_between_bones_is_that_of_their_surfaces_wherever_they_lie(bones):
    bone = bones["tibia", "parametric_0"]
    T = se3.exp([30.0, -20.0, 10.0, 0.0, 0.0, 0.3], np.zeros(3))
    moved = replace(bone, surface=replace(bone.surface, points=se3.apply(T, bone.surface.points), normals=None))
    assert other_subjects.distance_mm(bone, moved) < 0.5
    assert other_subjects.distance_mm(bone, bones["tibia", "parametric_1"]) > 1.0


def made(case, answer):
    """A record of a case, without registering it."""
    cloud = np.random.default_rng(0).normal(size=(50, 3)) * 50.0
    metadata = {"source_person": case.source}
    pair = other_subjects.Pair(
        cloud, cloud, np.full((4, 4), np.nan), case.name, case.bone, case.target, case.kind, metadata
    )
    return record(pair, answer, "gapr")
