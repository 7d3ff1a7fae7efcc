"""What the confidence models learn from."""

from dataclasses import replace

import numpy as np
import pytest

from gapr_core.data import anatomy
from gapr_core.data.pool import parametric_specimen
from gapr_core.geometry import se3
from gapr_core.training import calibration_pairs as pairs


@pytest.fixture(scope="module")
def bones():
    return {bone: [parametric_specimen(bone, number) for number in (0, 1, 2)] for bone in ("femur", "tibia")}


@pytest.fixture
def people(bones, monkeypatch):
    monkeypatch.setattr(pairs, "_bones", lambda folder, split: bones)
    return bones


@pytest.mark.parametrize("protocol", pairs.PROTOCOLS)
def test_every_kind_of_pair_is_a_function_of_its_task_and_has_a_truth_unless_it_is_wrong(people, protocol):
    task = ("folder", "train", protocol, "femur", 7)
    pair, again = pairs.pair_of(task), pairs.pair_of(task)
    np.testing.assert_array_equal(pair.source, again.source)
    np.testing.assert_array_equal(pair.target, again.target)
    assert pair.has_truth == ("wrong" not in protocol and protocol not in ("turned", "box"))
    assert not np.array_equal(pair.source, pairs.pair_of((*task[:-1], 8)).source)
    if pair.has_truth:
        placed = se3.apply(pair.T_target_source, pair.source) + pair.metadata.get("origin_mm", 0.0)
        whole = people["femur"][7 % 3]
        assert protocol == "mixed" or np.median(whole.distance(placed)) < 3.0


def test_a_scanned_pair_has_another_target_and_the_same_source_and_truth(people):
    own, scanned = (pairs.pair_of(("folder", "train", protocol, "tibia", 4)) for protocol in ("L2", "scanned-L2"))
    np.testing.assert_array_equal(own.source, scanned.source)
    np.testing.assert_array_equal(own.T_target_source, scanned.T_target_source)
    bone = people["tibia"][4 % 3]
    off = [np.median(bone.distance(pair.target + pair.metadata["origin_mm"])) for pair in (own, scanned)]
    assert off[0] < 1e-3 < 0.05 < off[1] < 2.0


def test_twins_are_no_wrong_answer_to_each_other():
    femur = parametric_specimen("femur", 0)
    own, twin, stranger = (replace(femur, person=who) for who in ("jhu_15", "jhu_25", "jhu_1"))
    assert pairs.without_twins(own, [own, twin, stranger]) == [own, stranger]
    assert pairs.without_twins(stranger, [own, twin, stranger]) == [own, twin, stranger]


def test_the_bones_are_of_the_people_of_the_split_and_of_new_ones_from_their_shape_models(anatomy_folder, monkeypatch):
    monkeypatch.setattr(pairs, "PARAMETRIC_PEOPLE", 1)
    monkeypatch.setattr(pairs, "DRAWN_PEOPLE", 2)
    monkeypatch.setattr(pairs, "BONES", ("femur", "pelvis"))
    bones = pairs._bones.__wrapped__(str(anatomy_folder), "train")
    known = set(anatomy.splits(anatomy_folder)["train"])
    for bone, specimens in bones.items():
        assert {s.bone for s in specimens} == {bone}
        drawn = [s for s in specimens if s.cohort == "drawn"]
        assert len(drawn) == 2 and not np.array_equal(drawn[0].surface.points, drawn[1].surface.points)
        assert {s.person for s in specimens if s.cohort not in ("drawn", "parametric")} <= known
