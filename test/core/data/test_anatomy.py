from __future__ import annotations

import json

import numpy as np
import pytest
from shapes import ball_specimen

from gapr_core.data import anatomy
from gapr_core.data.protocols import make_pair
from gapr_core.errors import ConfigError
from gapr_core.geometry import se3


def write_splits(folder, **people):
    (folder / "splits.json").write_text(json.dumps({"train": [], "val": [], "test": [], **people}))


def write_set(folder, bone, cohort, people):
    specimen = ball_specimen()
    points = np.stack([specimen.surface.points * (1.0 + 0.01 * i) for i in range(len(people))]).astype(np.float32)
    np.savez(folder / f"{bone}_{cohort}.npz", points=points, faces=specimen.surface.faces, person=np.array(people))


def test_people_are_read_by_split_over_all_cohorts(tmp_path):
    write_set(tmp_path, "femur", "one", ["a", "b"])
    write_set(tmp_path, "femur", "two", ["c", "d"])
    write_splits(tmp_path, train=["a", "c"], test=["b"], val=["d"])
    assert [(s.person, s.cohort) for s in anatomy.surfaces(tmp_path, "femur", "train")] == [("a", "one"), ("c", "two")]
    assert [s.person for s in anatomy.surfaces(tmp_path, "femur", "test", cohort="one")] == ["b"]
    assert len(anatomy.surfaces(tmp_path, "femur")) == 4
    assert anatomy.surfaces(tmp_path, "tibia") == []


def test_a_person_in_two_splits_is_refused(tmp_path):
    write_splits(tmp_path, train=["a", "b"], test=["b"])
    with pytest.raises(ConfigError, match="b more than once"):
        anatomy.splits(tmp_path)


@pytest.mark.parametrize("split", ["trian", ""])
def test_an_unknown_split_is_refused(tmp_path, split):
    write_set(tmp_path, "femur", "one", ["a"])
    write_splits(tmp_path, train=["a"])
    with pytest.raises(ConfigError, match="train, val, test"):
        anatomy.surfaces(tmp_path, "femur", split)


def test_a_missing_folder_and_a_missing_splits_file_say_what_to_do(tmp_path):
    with pytest.raises(ConfigError, match="--anatomy"):
        anatomy.surfaces(tmp_path / "nowhere", "femur")
    with pytest.raises(ConfigError, match="splits.json"):
        anatomy.splits(tmp_path)


def test_the_mirrored_bone_is_the_other_side_with_normals_outward():
    specimen = ball_specimen()
    other = anatomy.mirrored(specimen)
    centre = other.surface.points.mean(axis=0)
    points, normals = other.sample(200, np.random.default_rng(0))
    assert centre[0] == pytest.approx(-specimen.surface.points[:, 0].mean())
    assert ((points - centre) * normals).sum(axis=1).min() > 0.0
    np.testing.assert_array_equal(anatomy.mirrored(other).surface.points, specimen.surface.points)


def test_a_pair_of_a_mirrored_bone_has_both_clouds_mirrored():
    other = anatomy.mirrored(ball_specimen(60.0))
    pair = make_pair("paper", other, 0)
    on_surface = se3.apply(pair.T_target_source, pair.source) + pair.metadata["origin_mm"]
    assert np.median(other.distance(on_surface)) < 1.5


def test_real_people_are_split_over_all_bones_and_none_twice(anatomy_folder):
    people = anatomy.splits(anatomy_folder)
    for bone in ("femur", "tibia", "pelvis"):
        sets = {split: {s.person for s in anatomy.surfaces(anatomy_folder, bone, split)} for split in anatomy.SPLITS}
        assert all(sets[split] and sets[split] <= set(people[split]) for split in anatomy.SPLITS)
        assert set.union(*sets.values()) == {s.person for s in anatomy.surfaces(anatomy_folder, bone)}


def test_a_ct_femur_is_of_the_same_person_as_the_fitted_one(anatomy_folder):
    ct = anatomy.surfaces(anatomy_folder, "femur", cohort="gias2")
    fitted = {s.person: s for s in anatomy.surfaces(anatomy_folder, "femur")}
    assert len(ct) == 10
    for specimen in ct:
        twin = fitted[specimen.person].surface.points
        assert np.ptp(specimen.surface.points, axis=0)[2] == pytest.approx(np.ptp(twin, axis=0)[2], abs=12.0)
