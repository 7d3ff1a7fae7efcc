"""Public real data: its forms on data made here, and the data itself where its folder is."""

from pathlib import Path

import numpy as np
import pytest

from gapr_core.cli import main
from gapr_core.data import real
from gapr_core.data.parametric import make_bone
from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_core.geometry import se3
from gapr_ros.demo.act import write_stl

RECORD = Path("ultrasound_records/femur/record01/3D_reconstructions/with_GT_labels")


@pytest.fixture
def dataset(tmp_path):
    """A pair as NPZ, and a specimen in the form of UltraBones100k."""
    bone, rng = make_bone("femur", 1), np.random.default_rng(0)
    points, normals = bone.sample(9000, rng)
    seen = points[normals[:, 1] < -0.2]
    T = se3.exp([30.0, -20.0, 50.0, 0.5, -0.4, 1.0])
    np.savez(tmp_path / "camera.npz", source=se3.apply(se3.inverse(T), seen), target=points, transform=T)
    specimen = tmp_path / "specimen01"
    (specimen / RECORD).mkdir(parents=True)
    (specimen / "CT_bone_segmentations").mkdir()
    write_stl(bone, specimen / "CT_bone_segmentations" / "femur.stl")
    np.savetxt(specimen / RECORD / "reconstruction_pcd.xyz", np.tile(seen, (10, 1)))
    return tmp_path


def test_both_published_forms_are_found_with_their_bones_and_truths(dataset):
    camera, record = real.pairs(dataset)
    assert camera.name == "camera" and record.name == f"specimen01/{RECORD}/reconstruction_pcd"
    assert len(record.source) == real.MOST_POINTS and np.array_equal(record.T_target_source, np.eye(4))
    for pair in (camera, record):
        on_bone = se3.apply(pair.T_target_source, pair.source)
        assert (on_bone.min(axis=0) > pair.target.points.min(axis=0) - 0.1).all()
        assert (on_bone.max(axis=0) < pair.target.points.max(axis=0) + 0.1).all()
    assert [pair.name for pair in real.pairs(dataset / "specimen01")] == [f"{RECORD}/reconstruction_pcd"]


def test_a_folder_without_data_and_a_record_without_its_bone_are_one_line(dataset, tmp_path_factory, capsys):
    empty = tmp_path_factory.mktemp("empty")
    with pytest.raises(ConfigError, match="specimen folders"):
        list(real.pairs(empty))
    assert main(["demo", "--real", str(empty)]) == 1 and capsys.readouterr().err.count("\n") == 1
    assert main(["demo", "--real", str(dataset), "--weights", str(empty / "none")]) == 1
    assert "safetensors" in capsys.readouterr().err
    (dataset / "specimen01/CT_bone_segmentations/femur.stl").unlink()
    with pytest.raises(InvalidPointCloudError, match=r"femur\.stl"):
        list(real.pairs(dataset))


def test_the_demo_judges_real_clouds_and_fails_on_a_wrong_one(dataset, capsys):
    (dataset / "specimen01" / RECORD / "reconstruction_pcd.xyz").unlink()
    assert main(["demo", "--real", str(dataset)]) == 0
    assert "1 right, 0 wrong" in capsys.readouterr().out
    with np.load(dataset / "camera.npz") as pair:
        np.savez(dataset / "camera.npz", **{**pair, "transform": np.eye(4)})
    assert main(["demo", "--real", str(dataset)]) == 1
    assert "0 right, 1 wrong" in capsys.readouterr().out


def test_the_sawbone_femur_of_a_realsense_is_found(capsys):
    folder = real.default_folder()
    if not (folder / "realsense_sawbone_femur.npz").is_file():
        pytest.skip(f"real data does not ship and {folder} has none: set {real.ENVIRONMENT_VARIABLE}")
    assert main(["demo", "--real", str(folder)]) == 0
    assert "0 wrong" in capsys.readouterr().out
