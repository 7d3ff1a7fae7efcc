from __future__ import annotations

import json

import numpy as np
import pytest
from shapes import ball_specimen

from gapr_core.data import anatomy
from gapr_core.data.protocols import make_pair
from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_core.formats.reading import FORMATS
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


@pytest.mark.parametrize(("text", "said"), [
    ("{", "Expecting"), ("[1]", "list"), ("3", "int"), ('{"train": 1, "val": [], "test": []}', "without a list"),
    ('{"train": [1], "val": [], "test": []}', "without a list"),
    ('{"train": ["a", "b"], "val": [], "test": ["b"]}', "b more than once"), (None, "none in .*; write one"),
])  # fmt: skip
def test_splits_that_cannot_be_are_refused(tmp_path, text, said):
    if text is not None:
        (tmp_path / "splits.json").write_text(text)
    with pytest.raises(ConfigError, match=said):
        anatomy.splits(tmp_path)


@pytest.mark.parametrize(("folder", "split", "said"), [
    (".", "trian", "train, val, test"), (".", "", "train, val, test"), ("nowhere", "all", "--anatomy"),
])  # fmt: skip
def test_an_unknown_split_or_folder_is_refused(tmp_path, folder, split, said):
    write_set(tmp_path, "femur", "one", ["a"])
    write_splits(tmp_path, train=["a"])
    with pytest.raises(ConfigError, match=said):
        anatomy.surfaces(tmp_path / folder, "femur", split)


def test_damaged_meshes_are_named(tmp_path):
    write_set(tmp_path, "femur", "one", ["a", "b"])
    path = tmp_path / "femur_one.npz"
    with np.load(path) as data:
        arrays = {name: data[name] for name in data.files}
    content = path.read_bytes()
    damaged = {"cut": content[:-200], "text": b"no mesh", "empty": b""}
    for name, less in (("points", arrays["points"][0]), ("faces", arrays["faces"][:, :2]), ("person", ["a"])):
        np.savez(path, **{**arrays, name: less})
        damaged[f"other {name}"] = path.read_bytes()
        np.savez(path, **{key: array for key, array in arrays.items() if key != name})
        damaged[f"no {name}"] = path.read_bytes()
    for broken in damaged.values():
        path.write_bytes(broken)
        with pytest.raises(InvalidPointCloudError, match=r"an .npz with points .*; got .*femur_one.npz \(.+\)"):
            anatomy.surfaces(tmp_path, "femur")


def test_a_mesh_that_is_no_bone_in_mm_is_refused_where_it_is_used_and_nowhere_else(tmp_path):
    write_set(tmp_path, "femur", "one", ["a", "b"])
    write_splits(tmp_path, train=["a"], test=["b"])
    with np.load(tmp_path / "femur_one.npz") as data:
        points, faces, person = (data[name] for name in ("points", "faces", "person"))
    damaged = {
        "finite points; got NaN or infinity in the femur of b": (points * [[[1.0]], [[np.nan]]], faces),
        "the femur of b .one. of .* it looks like m: convert it to mm": (points * [[[1.0]], [[1e-3]]], faces),
        "faces of its [0-9]+ vertices; got some that point beyond them in the femur of b": (points, faces + 1),
    }
    for message, (bones, corners) in damaged.items():
        np.savez(tmp_path / "femur_one.npz", points=bones, faces=corners, person=person)
        with pytest.raises(InvalidPointCloudError, match=message):
            anatomy.surfaces(tmp_path, "femur", "test")
        if corners is faces:
            assert [s.person for s in anatomy.surfaces(tmp_path, "femur", "train")] == ["a"]


def test_a_subject_that_stands_twice_in_one_set_is_refused(tmp_path):
    write_set(tmp_path, "femur", "one", ["a", "b", "a"])
    with pytest.raises(InvalidPointCloudError, match="femur_one.npz .a more than once in `person`"):
        anatomy.corresponded(tmp_path, "femur")


def test_label_maps_are_meshes_named_by_all_that_stands_before_their_ending_and_other_files_are_left_alone(tmp_path):
    nibabel = pytest.importorskip("nibabel", reason="it writes the label maps to read: pip install nibabel")
    voxels = np.zeros((40, 40, 60), dtype=np.uint8)
    voxels[5:35, 5:35, 5:55] = 1
    for name in ("p.1.nii.gz", "P2.NII.GZ"):
        nibabel.save(nibabel.Nifti1Image(voxels, np.diag([2.0, 2.0, 2.0, 1.0])), tmp_path / name)
    for name in ("README.txt", "landmarks.mrk.json", "cloud.xyz", "sweep.igs.mha", "notes"):
        (tmp_path / name).write_text("no mesh")
    assert sorted(s.person for s in anatomy.meshes(tmp_path, "femur")) == ["P2", "p.1"]
    hashed = anatomy.meshes_hash(tmp_path, ["femur"])
    (tmp_path / "README.txt").write_text("other words")
    assert anatomy.meshes_hash(tmp_path, ["femur"]) == hashed


def test_every_ending_of_a_mesh_can_be_read():
    assert set(anatomy.MESHES) < set(FORMATS)


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


def test_meshes_of_one_bone_lie_in_a_folder_and_those_of_several_in_folders_of_it(tmp_path):
    for name in ("tibia/a", "tibia/b", "femur"):
        path = tmp_path / f"{name}.npz"
        path.parent.mkdir(exist_ok=True)
        surface = ball_specimen().surface
        np.savez(path, points=surface.points, faces=surface.faces)
    with pytest.raises(ConfigError, match=r"a folder for each bone; got both \(femur.npz, tibia\)"):
        anatomy.meshes(tmp_path)
    assert anatomy.is_flat(tmp_path) and not anatomy.is_flat(tmp_path.parent / "none")
    (tmp_path / "femur.npz").unlink()
    assert [s.person for s in anatomy.meshes(tmp_path, "tibia")] == ["a", "b"] and not anatomy.is_flat(tmp_path)


def test_the_hash_of_an_anatomy_changes_with_any_bone_and_with_the_splits(tmp_path):
    write_set(tmp_path, "femur", "one", ["a", "b"])
    (tmp_path / "splits.json").write_text("{}")
    found = [anatomy.corresponded_hash(tmp_path)]
    (tmp_path / "README.md").write_text("words")
    assert anatomy.corresponded_hash(tmp_path) == found[0]
    write_splits(tmp_path)
    found.append(anatomy.corresponded_hash(tmp_path))
    write_set(tmp_path, "tibia", "one", ["a"])
    found.append(anatomy.corresponded_hash(tmp_path))
    (tmp_path / "tibia_one.npz").rename(tmp_path / "tibia_two.npz")
    found.append(anatomy.corresponded_hash(tmp_path))
    assert len(set(found)) == 4
