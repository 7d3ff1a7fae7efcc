"""Transforms of a sequence and of slices are rigid, and axes turn a folder of slices once."""

import numpy as np
import pytest
from recordings import LPS_RAS, POINTS, T_REFERENCE_BONE, TIP, igs, igs_of, motions, slices_with_poses, turned_poses

from gapr_core.cli import main
from gapr_core.errors import InvalidPointCloudError
from gapr_core.formats import reading
from gapr_core.formats.options import ReadOptions
from gapr_core.formats.poses import poses_in
from gapr_core.geometry import se3

CHANGES = {
    "scaled": (np.diag([0.2, 0.2, 0.2, 1.0]), "determinant 0.008"),
    "reflected": (np.diag([1.0, 1.0, -1.0, 1.0]), "determinant -1"),
    "sheared": (np.eye(4) + 0.2 * np.eye(4, k=1) * [1, 1, 1, 0], "rotation part"),
    "last row": (np.diag([1.0, 1.0, 1.0, 1.00001]), "last row is 0 0 0 1.00001, not 0 0 0 1"),
}


def changed(poses, number, how):
    poses = poses.copy()
    poses[number] = poses[number] @ CHANGES[how][0]
    return poses


@pytest.mark.parametrize("how", CHANGES)
def test_a_tool_of_a_sequence_is_moved_by_rigid_poses_alone(tmp_path, capsys, how):
    path = igs(tmp_path / "a.igs.mha", changed(turned_poses(12), 3, how), ["OK"] * 12)
    said = f"rigid poses.*; got .*a.igs.mha with ProbeToTracker of frame 3, whose .*{CHANGES[how][1]}.*--tool"
    with pytest.raises(InvalidPointCloudError, match=said):
        reading.read(path, ReadOptions(tip_mm=tuple(TIP)))
    with pytest.raises(InvalidPointCloudError, match=said):
        poses_in(path)
    assert main(["pivot", str(path)]) == 1
    err = capsys.readouterr().err
    assert "frame 3" in err and err.count("\n") == 1


@pytest.mark.parametrize("how", CHANGES)
def test_the_reference_of_a_tool_is_rigid_too(tmp_path, how):
    path, rest = tmp_path / "two.igs.mha", motions(4, 0)
    igs_of(path, (changed(rest, 2, how), ()), (motions(4, 1), ()))
    with pytest.raises(InvalidPointCloudError, match="with ReferenceToTracker of frame 2, whose"):
        poses_in(path, 1, 0)
    assert len(poses_in(path, 1)) == 4
    igs_of(path, (changed(rest, 2, how), {2}), (motions(4, 1), ()))
    assert len(poses_in(path, 1, 0)) == 3  # a frame that is not valid is not looked at


def test_transforms_of_a_sequence_that_are_not_used_may_scale(tmp_path):
    """PLUS writes calibrations next to poses; those of an image are mm per pixel."""
    path, poses = igs(tmp_path / "a.igs.mha", turned_poses(3), ["OK"] * 3), turned_poses(3)
    scaled = " ".join(map(str, np.diag([0.1, 0.1, 0.1, 1.0]).ravel()))
    head = "".join(f"Seq_Frame{i:04d}_ImageToProbeTransform = {scaled}\n" for i in range(3))
    path.write_bytes(head.encode() + path.read_bytes())
    np.testing.assert_allclose(poses_in(path, 1), poses, atol=1e-9)
    with pytest.raises(InvalidPointCloudError, match="ImageToProbe of frame 0"):
        poses_in(path, 0)


def test_poses_of_a_sequence_with_few_digits_are_read_and_made_rigid(tmp_path):
    path = igs(tmp_path / "a.igs.mha", np.round(turned_poses(4), 3), ["OK"] * 4)
    found = poses_in(path)
    np.testing.assert_allclose(found, turned_poses(4), atol=2e-3)
    np.testing.assert_allclose(
        found[:, :3, :3] @ found[:, :3, :3].swapaxes(1, 2), np.tile(np.eye(3), (4, 1, 1)), atol=1e-12
    )


def test_a_transform_that_leads_from_the_tracker_is_no_pose_of_a_tool(tmp_path):
    path = igs(tmp_path / "a.igs.mha", turned_poses(4), ["OK"] * 4)
    path.write_bytes(path.read_bytes().replace(b"ProbeToTracker", b"TrackerToProbe"))
    with pytest.raises(InvalidPointCloudError, match="in the frame of the tracker; got .*TrackerToProbe of a.igs.mha"):
        reading.read(path, ReadOptions(tip_mm=tuple(TIP)))
    path.write_bytes(path.read_bytes().replace(b"TrackerToProbe", b"TrackerToolToTracker"))
    assert len(poses_in(path)) == 4


@pytest.mark.parametrize("tip", [None, (0.0, 0.0, 0.0)])
def test_a_sequence_that_is_named_as_a_label_map_is_to_be_renamed(tmp_path, tip):
    igs(tmp_path / "a.mha", turned_poses(4), ["OK"] * 4)
    said = "a label map as .mha; got a.mha, a recording by PLUS; rename it to .igs.mha, and give --tip"
    with pytest.raises(InvalidPointCloudError, match=said):
        reading.read(tmp_path / "a.mha", ReadOptions(tip_mm=tip))


@pytest.mark.parametrize("name", ["a.nrrd", "a.igs.nrrd"])
def test_a_sequence_as_nrrd_is_to_be_saved_as_mha(tmp_path, name):
    (tmp_path / name).write_text("NRRD0004\ntype: unsigned char\nSeq_Frame0000_ProbeToTrackerTransform:=1 0 0 0\n\n")
    said = f"a label map as .nrrd; got {name}, a recording by PLUS; save it as .igs.mha in PLUS, and give --tip"
    with pytest.raises(InvalidPointCloudError, match=said):
        reading.read(tmp_path / name, ReadOptions(tip_mm=(0.0, 0.0, 0.0)))


def test_an_empty_sequence_is_called_empty_before_a_tip_is_asked_for(tmp_path):
    (tmp_path / "a.igs.mha").touch()
    with pytest.raises(InvalidPointCloudError, match=r"a\.igs\.mha \(0 bytes, an empty file\)"):
        reading.read(tmp_path / "a.igs.mha")


def test_slices_in_metres_are_refused_and_poses_in_metres_warned_of(tmp_path, caplog):
    poses = np.array(turned_poses(3))
    poses[:, :3, 3] += np.arange(3)[:, None] * 20.0
    folder = slices_with_poses(tmp_path / "a", poses)
    assert len(reading.read(folder).points) == 9 and "are they in m?" not in caplog.text
    in_m = poses.copy()
    in_m[:, :3, 3] /= 1000.0
    np.savetxt(folder / "poses.csv", in_m.reshape(3, 16), delimiter=",")
    assert len(reading.read(folder).points) == 9 and "all places in poses.csv are within" in caplog.text
    for path in folder.glob("slice*"):
        np.savetxt(path, np.loadtxt(path) / 1000.0)
    with pytest.raises(InvalidPointCloudError, match=r"slices in mm; got a: slices that are .* mm across at most"):
        reading.read(folder)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_huge_pose_of_slices_is_refused_without_a_warning_of_numpy(tmp_path):
    folder = slices_with_poses(tmp_path / "a", [np.diag([1e200, 1e200, 1e200, 1.0])])
    with pytest.raises(InvalidPointCloudError, match="pose 1 with last row 0 0 0 1 and determinant inf"):
        reading.read(folder)


def test_files_that_are_joined_are_counted_and_named(tmp_path, caplog):
    folder = slices_with_poses(tmp_path / "a", turned_poses(3))
    reading.read(folder)
    assert "3 files of a are joined, slice_00.xyz to slice_02.xyz; the bone must not have moved" in caplog.text
    caplog.clear()
    reading.read(slices_with_poses(tmp_path / "b", turned_poses(1)))
    assert not caplog.text


@pytest.mark.parametrize("off", [1e-5, 5e-3])
def test_the_last_row_of_a_pose_of_slices_is_exact(tmp_path, off):
    poses = turned_poses(2)
    poses[1, 3] += [0.0, 0.0, 0.0, off]
    folder = slices_with_poses(tmp_path / "a", poses)
    with pytest.raises(
        InvalidPointCloudError, match=f"got a: pose 2 with last row 0 0 0 {1.0 + off:g} and determinant 1"
    ):
        reading.read(folder)


@pytest.mark.parametrize("has_poses", [True, False])
def test_a_folder_of_slices_is_turned_once_and_after_its_poses(tmp_path, has_poses):
    folder = slices_with_poses(tmp_path / "a", [T_REFERENCE_BONE, se3.inverse(T_REFERENCE_BONE)])
    if not has_poses:
        (folder / "poses.csv").unlink()
    slices = [POINTS, POINTS + 1]
    if has_poses:
        slices = [se3.apply(T_REFERENCE_BONE, slices[0]), se3.apply(se3.inverse(T_REFERENCE_BONE), slices[1])]
    turned = {"ras": LPS_RAS, "lps_to_ras": LPS_RAS}
    for axes, factors in ({"auto": 1.0, "as_is": 1.0, "lps": 1.0} | turned).items():
        points = reading.read(folder, ReadOptions(axes=axes)).points
        np.testing.assert_allclose(points, np.vstack(slices) * factors, atol=1e-9)


@pytest.mark.parametrize("axes", ["auto", "as_is", "lps", "lps_to_ras"])
def test_a_slice_that_says_ras_is_refused_by_its_name(tmp_path, axes):
    folder = slices_with_poses(tmp_path / "a", turned_poses(2))
    file = folder / "slice_01.xyz"
    points = file.read_text()
    file.write_text(f"# SPACE=RAS\n{points}")
    with pytest.raises(InvalidPointCloudError, match="got a: slice_01.xyz, which says that it is in RAS; turn it"):
        reading.read(folder, ReadOptions(axes=axes))
    file.write_text(f"# SPACE=LPS\n{points}")
    assert len(reading.read(folder, ReadOptions(axes=axes)).points) == 6
