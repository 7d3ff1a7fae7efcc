"""Pointers recorded with a marker on the bone, which moves between the rows."""

import json

import numpy as np
import pytest
from recordings import T_REFERENCE_BONE, csv_of, igs_of, motions

from gapr_core.cli import main
from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_core.formats import reading
from gapr_core.formats.options import ReadOptions
from gapr_core.formats.poses import poses_in
from gapr_core.formats.tracker import pivot
from gapr_core.geometry import se3

TIP = (3.0, -5.0, 150.0)
NAMES = ["two.csv", "two.igs.mha"]


def recorded(path, points, reference_lost=(), pointer_lost=()):
    """A reference that moves with its bone, and a pointer on points (N, 3) in the frame of that reference."""
    references, pointers = motions(len(points), 0), motions(len(points), 1)
    touched = np.einsum("nij,nj->ni", references[:, :3, :3], points) + references[:, :3, 3]
    pointers[:, :3, 3] = touched - pointers[:, :3, :3] @ TIP
    (igs_of if path.suffix == ".mha" else csv_of)(path, (references, reference_lost), (pointers, pointer_lost))
    return path


POINTS = np.random.default_rng(5).uniform(-50.0, 50.0, (12, 3))


def read(path, tool=1, reference=0):
    return reading.read(path, ReadOptions(tip_mm=TIP, tool=tool, reference=reference)).points


@pytest.mark.parametrize("name", NAMES)
def test_points_of_a_moving_bone_are_right_in_the_frame_of_its_reference(tmp_path, name):
    path = recorded(tmp_path / name, POINTS)
    np.testing.assert_allclose(read(path), POINTS, atol=1e-9)
    assert np.abs(read(path, reference=None) - POINTS).max() > 50.0


@pytest.mark.parametrize("name", NAMES)
def test_rows_without_the_reference_or_the_pointer_are_left_out_in_step(tmp_path, name):
    path = recorded(tmp_path / name, POINTS, reference_lost=(2, 5), pointer_lost=(0, 5))
    np.testing.assert_allclose(read(path), np.delete(POINTS, [0, 2, 5], axis=0), atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("reference", [1, 2, -1])
def test_a_reference_that_is_the_pointer_or_not_there_is_an_error_that_lists_the_tools(tmp_path, name, reference):
    path = recorded(tmp_path / name, POINTS)
    with pytest.raises(InvalidPointCloudError, match=r"other than tool 1; got .* with 2 \(0.*, 1.*--reference"):
        read(path, reference=reference)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("lost", [range(12), range(6)])
def test_a_reference_that_is_never_seen_with_the_pointer_is_an_error_that_lists_the_tools(tmp_path, name, lost):
    path = recorded(tmp_path / name, POINTS, lost, set(range(12)) - set(lost))
    with pytest.raises(InvalidPointCloudError, match=r"tool 1 and its reference 0 in view; got .* with 2 \(0.*, 1"):
        read(path)


def test_transforms_that_lead_to_different_frames_are_not_combined(tmp_path):
    path = recorded(tmp_path / "two.igs.mha", POINTS)
    path.write_bytes(path.read_bytes().replace(b"StylusToTracker", b"StylusToReference"))
    with pytest.raises(InvalidPointCloudError, match="one frame; got .*StylusToReference and ReferenceToTracker"):
        read(path)


def test_files_that_are_no_recording_refuse_a_reference(tmp_path):
    np.save(tmp_path / "a.npy", POINTS)
    with pytest.raises(ConfigError, match="--reference"):
        reading.read(tmp_path / "a.npy", ReadOptions(reference=0))
    np.savetxt(tmp_path / "a.csv", POINTS, delimiter=",")
    with pytest.raises(InvalidPointCloudError, match="--reference"):
        reading.read(tmp_path / "a.csv", ReadOptions(reference=0))


@pytest.mark.parametrize("name", NAMES)
def test_a_dimple_that_moves_with_a_marker_gives_the_tip(tmp_path, name):
    path = recorded(tmp_path / name, np.tile([10.0, -20.0, 30.0], (40, 1)))
    found = pivot(poses_in(path, 1, 0))
    np.testing.assert_allclose(found.tip_mm, TIP, atol=1e-6)
    np.testing.assert_allclose(found.pivot_mm, [10.0, -20.0, 30.0], atol=1e-6)
    assert main(["pivot", str(path), "--tool", "1", "--reference", "0"]) == 0
    assert main(["pivot", str(path), "--tool", "1"]) == 1


@pytest.mark.parametrize("name", NAMES)
def test_a_bone_that_moved_is_registered_in_the_frame_of_its_reference_alone(tmp_path, name):
    from gapr_core.data.parametric import make_bone

    bone = make_bone("femur", seed=3)
    rng = np.random.default_rng(2)
    points = rng.permutation(bone.points)[:400]
    np.save(tmp_path / "bone.npy", bone.points)
    path = recorded(tmp_path / name, se3.apply(T_REFERENCE_BONE, points))
    line = ["register", "--source", str(path), "--target", str(tmp_path / "bone.npy"), "--tip", "3,-5,150"]
    line += ["--tool", "1", "--json", str(tmp_path / "o.json")]
    assert main([*line, "--reference", "0"]) == 0
    found = np.array(json.loads((tmp_path / "o.json").read_text())["transform"])
    assert se3.rms_apart_mm(found, se3.inverse(T_REFERENCE_BONE), se3.apply(T_REFERENCE_BONE, points)) < 2.0
    assert main(line) != 0
