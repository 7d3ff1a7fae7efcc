from __future__ import annotations

import json
import pickle
from argparse import ArgumentParser
from dataclasses import replace

import numpy as np
import open3d as o3d
import pytest
from shapes import ball_specimen, knob_specimen

from gapr_core.cli import main
from gapr_core.data import anatomy, make_pairs, pool
from gapr_core.data.make_pairs import Recipe, read_manifest, write_pairs
from gapr_core.data.pair_files import load_pair, pair_hash, save_pair
from gapr_core.data.protocols import make_pair
from gapr_core.data.specimen import Specimen
from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_core.surface import Surface

BONES = {"ball": [ball_specimen(person="a"), ball_specimen(50.0, person="b")], "knob": [knob_specimen(person="a")]}
RECIPE = Recipe(("L3", "wrong"), ("ball", "knob"), count=3, seed=7)


def parse(*words):
    parser = ArgumentParser()
    make_pairs.add_arguments(parser)
    return parser.parse_args(words)


def write_meshes(folder, count):
    folder.mkdir(parents=True)
    for i in range(count):
        mesh = o3d.geometry.TriangleMesh.create_cone(30.0 + i, 120.0, resolution=24, split=4)
        o3d.io.write_triangle_mesh(str(folder / f"person{i}.stl"), mesh.compute_triangle_normals())


def test_names_in_a_list_may_have_spaces_and_count_once(tmp_path):
    write_meshes(tmp_path / "cone", 2)
    words = ["make-pairs", "--split", "all", "--count", "1", "--meshes", str(tmp_path / "cone")]
    assert main([*words, "--protocol", "L3, L2,L3,", "--bones", "cone, cone", "--out", str(tmp_path / "out")]) == 0
    assert [pair["name"] for pair in read_manifest(tmp_path / "out")["pairs"]] == ["L3_cone_0000", "L2_cone_0000"]


def test_a_pair_survives_the_way_through_a_file(tmp_path):
    pair = make_pair("L2", ball_specimen(), 4)
    save_pair(tmp_path / "pair.npz", pair)
    read = load_pair(tmp_path / "pair.npz")
    np.testing.assert_allclose(read.source, pair.source, atol=1e-4)
    np.testing.assert_array_equal(read.T_target_source, pair.T_target_source)
    assert (read.name, read.bone, read.person, read.protocol) == (pair.name, pair.bone, pair.person, "L2")
    assert read.metadata["noise_mm"] == 1.5
    assert pair_hash(read) == pair_hash(pair)


def test_the_file_has_the_arrays_that_others_read(tmp_path):
    save_pair(tmp_path / "pair.npz", make_pair("wrong", ball_specimen(person="a"), 0, BONES["knob"]))
    with np.load(tmp_path / "pair.npz", allow_pickle=False) as data:
        assert data["source"].shape[1] == data["target"].shape[1] == 3
        assert np.isnan(data["transform"]).all() and not data["has_truth"]
        assert str(data["wrong_kind"]) in ("other_bone", "other_person")


def test_files_that_hold_no_pair_are_refused(tmp_path):
    (tmp_path / "text.npz").write_text("no pair")
    np.savez(tmp_path / "half.npz", source=np.zeros((4, 3)))
    for name in ("text.npz", "half.npz", "missing.npz"):
        with pytest.raises(InvalidPointCloudError, match="source and target"):
            load_pair(tmp_path / name)


def test_the_same_seed_gives_the_same_hash_and_another_seed_another_one(tmp_path):
    first = write_pairs(RECIPE, BONES, tmp_path / "first")
    again = write_pairs(RECIPE, BONES, tmp_path / "again")
    other = write_pairs(Recipe(("L3", "wrong"), ("ball", "knob"), count=3, seed=8), BONES, tmp_path / "other")
    assert first["hash"] == again["hash"] != other["hash"]
    assert len(first["pairs"]) == 2 * 2 * 3 == len(list((tmp_path / "first").glob("*.npz")))


@pytest.mark.parametrize("part", ["source", "target", "T_target_source"])
def test_the_hash_of_a_pair_is_of_both_clouds_and_of_the_pose(part):
    pair = make_pair("L1", BONES["ball"][0], 1)
    changed = getattr(pair, part).copy()
    changed[0, 0] += 1.0
    assert pair_hash(replace(pair, **{part: changed})) != pair_hash(pair)


def test_lists_of_two_seeds_share_no_draw():
    drawn = [{job.seed for job in make_pairs._plan(replace(RECIPE, count=9, seed=seed), BONES)} for seed in (7, 8)]
    assert not drawn[0] & drawn[1]


def test_pairs_drawn_on_a_cluster_have_the_same_hash(tmp_path, dask_address):
    one = write_pairs(RECIPE, BONES, tmp_path / "one")
    assert write_pairs(RECIPE, BONES, tmp_path / "many", dask=dask_address) == one


def test_what_is_sent_for_a_pair_holds_no_mesh(tmp_path, monkeypatch):
    """The meshes go to each worker once, however many pairs are drawn of them."""
    sent = []

    def results(address, call, tasks, shared):
        for task in tasks:
            sent.append(len(pickle.dumps(task)))
            yield call(task, shared)

    monkeypatch.setattr(make_pairs.cluster, "results", results)
    write_pairs(RECIPE, BONES, tmp_path, dask="somewhere")
    assert len(sent) == 12 and max(sent) < 500 < min(len(pickle.dumps(s)) for found in BONES.values() for s in found)


@pytest.mark.parametrize("protocol", ["paper", "L2"])
def test_the_protocols_make_the_same_pairs_from_version_to_version(protocol):
    """Golden: what changes these points changes every frozen list. Then print the new ones and say so in CHANGELOG."""
    pair = make_pair(protocol, octahedron(), 0)
    np.testing.assert_allclose(pair.source[:3], GOLDEN_POINTS[protocol], atol=0.006)


def test_an_interrupted_run_is_taken_up_where_it_stopped(tmp_path):
    whole = write_pairs(RECIPE, BONES, tmp_path)
    kept, lost = tmp_path / f"{whole['pairs'][0]['name']}.npz", tmp_path / f"{whole['pairs'][5]['name']}.npz"
    lost.unlink()
    written = kept.stat().st_mtime_ns
    assert write_pairs(RECIPE, BONES, tmp_path)["hash"] == whole["hash"] == read_manifest(tmp_path)["hash"]
    assert lost.is_file() and kept.stat().st_mtime_ns == written


def test_a_folder_with_other_pairs_is_left_alone(tmp_path):
    write_pairs(RECIPE, BONES, tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(ConfigError, match="other pairs"):
        write_pairs(Recipe(("L1",), ("ball",), count=1), BONES, tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    for path in tmp_path.glob("*.npz"):
        path.unlink()
    with pytest.raises(ConfigError, match="other pairs"):  # a list of pairs that lie elsewhere
        write_pairs(Recipe(("L1",), ("ball",), count=1), BONES, tmp_path)
    (tmp_path / "manifest.json").write_text(json.dumps(json.loads(before["manifest.json"]) | {"pairs": []}))
    (tmp_path / "L3_ball_0000.npz").write_bytes(before["L3_ball_0000.npz"])  # as a run leaves it that was stopped
    with pytest.raises(ConfigError, match="other pairs"):
        write_pairs(Recipe(("L1",), ("ball",), count=1), BONES, tmp_path)


def test_a_misspelt_bone_does_not_block_the_folder(tmp_path, capsys):
    write_meshes(tmp_path / "bones" / "ulna", 1)
    write_meshes(tmp_path / "flat", 2)
    words = ["make-pairs", "--split", "all", "--protocol", "L1", "--count", "1", "--out", str(tmp_path / "pairs")]
    flat = "one bone for meshes in one folder; got femur, tibia"
    for meshes, bones, said in (("bones", "unla", "none for unla"), ("flat", "femur,tibia", flat)):
        assert main([*words, "--meshes", str(tmp_path / meshes), "--bones", bones]) == 1
        assert said in capsys.readouterr().err
    assert main([*words, "--meshes", str(tmp_path / "bones"), "--bones", "ulna"]) == 0
    assert [pair["name"] for pair in read_manifest(tmp_path / "pairs")["pairs"]] == ["L1_ulna_0000"]


def test_everybody_has_a_turn(tmp_path):
    manifest = write_pairs(Recipe(("L3",), ("ball",), count=4), BONES, tmp_path)
    assert [p["person"] for p in manifest["pairs"]] == ["a", "b", "a", "b"]


@pytest.mark.parametrize("bad", [{"protocols": ("L9",)}, {"count": 0}, {"bones": ()}, {"seed": -1}])
def test_a_recipe_that_makes_no_sense_is_refused(bad):
    with pytest.raises(ConfigError):
        Recipe(**{"protocols": ("L1",), "bones": ("femur",), "count": 1, **bad})


def test_a_folder_of_five_stl_files_becomes_pairs_with_one_command(tmp_path, capsys):
    write_meshes(tmp_path / "humerus", 5)
    words = ["--split", "all", "--protocol", "L2,wrong", "--meshes", str(tmp_path / "humerus"), "--count", "5", "--out"]
    assert make_pairs.run(parse(*words, str(tmp_path / "pairs"))) == 0
    manifest = read_manifest(tmp_path / "pairs")
    assert {p["person"] for p in manifest["pairs"]} == {f"person{i}" for i in range(5)}
    assert {p["bone"] for p in manifest["pairs"]} == {"humerus"}
    assert "10 pairs" in capsys.readouterr().out
    assert str(tmp_path) not in json.dumps(manifest)


def test_folders_in_the_folder_are_bones_and_no_person_is_in_two_splits(tmp_path):
    for bone in ("radius", "ulna"):
        write_meshes(tmp_path / bone, 6)
    assert pool.bones_in(tmp_path) == ["radius", "ulna"]
    people = {s: {x.person for x in anatomy.meshes(tmp_path, split=s)} for s in anatomy.SPLITS}
    assert sum(map(len, people.values())) == 6 == len(set.union(*people.values()))
    assert min(map(len, people.values())) >= 1


@pytest.mark.parametrize(("other", "size"), [("cm", 0.1), ("m", 0.001)])
def test_meshes_in_other_units_give_the_pairs_of_the_same_meshes_in_millimetres(tmp_path, other, size):
    write_meshes(tmp_path / "mm" / "humerus", 1)
    (tmp_path / other / "humerus").mkdir(parents=True)
    mesh = o3d.io.read_triangle_mesh(str(tmp_path / "mm" / "humerus" / "person0.stl")).scale(size, np.zeros(3))
    o3d.io.write_triangle_mesh(str(tmp_path / other / "humerus" / "person0.stl"), mesh.compute_triangle_normals())
    pairs = {}
    for unit in ("mm", other):
        words = ["make-pairs", "--split", "all", "--protocol", "L1", "--count", "1", "--units", unit]
        assert main([*words, "--meshes", str(tmp_path / unit), "--out", str(tmp_path / f"pairs_{unit}")]) == 0
        pairs[unit] = load_pair(next((tmp_path / f"pairs_{unit}").glob("*.npz")))
    sizes = [np.ptp(pair.target, axis=0) for pair in pairs.values()]
    np.testing.assert_allclose(sizes[0], sizes[1], rtol=0.02)


def test_pairs_of_an_anatomy_that_has_changed_are_not_taken_up(tmp_path, capsys):
    specimen = ball_specimen()
    points, faces = specimen.surface.points[None].astype(np.float32), specimen.surface.faces
    (tmp_path / "anatomy").mkdir()
    (tmp_path / "anatomy" / "splits.json").write_text(json.dumps({"train": ["a"], "val": [], "test": []}))
    np.savez(tmp_path / "anatomy" / "femur_one.npz", points=points, faces=faces, person=np.array(["a"]))
    words = ["make-pairs", "--split", "train", "--protocol", "L1", "--count", "1", "--bones", "femur"]
    words += ["--anatomy", str(tmp_path / "anatomy"), "--out", str(tmp_path / "pairs")]
    assert main(words) == 0 and main(words) == 0
    manifest = read_manifest(tmp_path / "pairs")
    older = manifest | {"recipe": {k: v for k, v in manifest["recipe"].items() if k not in ("meshes", "units")}}
    np.savez(tmp_path / "anatomy" / "femur_one.npz", points=0.9 * points, faces=faces, person=np.array(["a"]))
    capsys.readouterr()
    assert main(words) == 1 and "same meshes and unit" in capsys.readouterr().err
    (tmp_path / "pairs" / "manifest.json").write_text(json.dumps(older))
    assert main(words) == 0, "it does not say of which anatomy its pairs are"


def test_pairs_of_meshes_that_have_changed_are_not_taken_up(tmp_path, capsys):
    write_meshes(tmp_path / "bones" / "humerus", 3)
    write_meshes(tmp_path / "bones" / "ulna", 1)
    words = ["make-pairs", "--split", "all", "--protocol", "L1", "--count", "2", "--bones", "humerus"]
    words += ["--meshes", str(tmp_path / "bones"), "--out", str(tmp_path / "pairs")]
    assert main(words) == 0 and main(words) == 0
    (tmp_path / "bones" / "ulna" / "person0.stl").unlink()  # of another bone
    assert main(words) == 0
    before = (tmp_path / "pairs" / "manifest.json").read_bytes()
    capsys.readouterr()
    assert main([*words, "--units", "m"]) == 1 and "same meshes and unit" in capsys.readouterr().err
    mesh = tmp_path / "bones" / "humerus" / "person1.stl"
    content = mesh.read_bytes()
    mesh.write_bytes((tmp_path / "bones" / "humerus" / "person0.stl").read_bytes())
    assert main(words) == 1 and "same meshes and unit" in capsys.readouterr().err
    assert (tmp_path / "pairs" / "manifest.json").read_bytes() == before
    mesh.write_bytes(content)
    assert main(words) == 0


def test_a_recipe_without_meshes_is_listed_as_before():
    assert "meshes" not in RECIPE.listed() and "units" not in RECIPE.listed()
    assert RECIPE.listed()["protocols"] == ["L3", "wrong"]


def test_hidden_files_of_macos_are_no_meshes_and_two_files_of_one_subject_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="one mesh per subject"):
        anatomy.meshes(tmp_path)
    write_meshes(tmp_path / "humerus", 2)
    (tmp_path / "humerus" / "._person0.stl").write_bytes(b"\x00\x05\x16\x07")
    assert [specimen.person for specimen in anatomy.meshes(tmp_path)] == ["person0", "person1"]
    mesh = o3d.io.read_triangle_mesh(str(tmp_path / "humerus" / "person1.stl"))
    o3d.io.write_triangle_mesh(str(tmp_path / "humerus" / "person1.ply"), mesh)
    with pytest.raises(ConfigError, match=r"one mesh for each subject and bone; got person1.ply and person1.stl"):
        anatomy.meshes(tmp_path)


def test_a_bone_that_the_anatomy_lacks_is_a_parametric_one_and_says_so(tmp_path):
    specimen = ball_specimen(person="a", bone="femur")
    arrays = {"points": specimen.surface.points[None], "faces": specimen.surface.faces, "person": np.array(["a"])}
    np.savez(tmp_path / "femur_made.npz", **arrays)
    (tmp_path / "splits.json").write_text(json.dumps({"train": [], "val": [], "test": ["a"]}))
    (found,) = pool.specimens("femur", "test", anatomy_folder=tmp_path)
    assert (found.person, found.cohort) == ("a", "made")
    (lacking,) = pool.specimens("tibia", "test", people=1, anatomy_folder=tmp_path)
    assert (lacking.person, lacking.cohort) == ("parametric_4", "parametric")
    with pytest.raises(ConfigError, match="train, val, test"):
        pool.specimens("tibia", "exam", anatomy_folder=tmp_path)


def octahedron():
    """Corners and faces written out: meshes of a library change with its version."""
    corners = np.array([[60, 0, 0], [-60, 0, 0], [0, 50, 0], [0, -50, 0], [0, 0, 70], [0, 0, -70]]) + [
        300.0,
        -200.0,
        900.0,
    ]
    faces = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
    return Specimen(Surface(corners, np.array(faces)), "ball", "p0", "hand-made")


GOLDEN_POINTS = {
    "paper": [[28.87, 115.43, -87.58], [44.43, 97.72, -51.10], [24.47, 127.45, -102.36]],
    "L2": [[-4.15, -48.02, 58.96], [-58.42, -27.72, 51.82], [-30.27, -25.81, 28.71]],
}


def test_meshes_in_a_folder_that_does_not_exist_are_named_as_such(tmp_path):
    with pytest.raises(ConfigError, match="expected a folder with meshes; got .*nowhere, which does not exist"):
        anatomy.meshes(tmp_path / "nowhere")
