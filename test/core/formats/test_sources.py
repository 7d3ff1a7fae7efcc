"""Points of pointers, probes and markups, with the traps of each format."""

import json
import re
from types import SimpleNamespace

import numpy as np
import pytest
from recordings import LPS_RAS, PIVOT, POINTS, TIP, igs, ndi_csv, slices_with_poses, turned_poses
from scipy.spatial.transform import Rotation
from vtk_files import legacy_vtk, triangle_with

from gapr_core import clouds
from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_core.formats import markups, plugins, reading, tracker
from gapr_core.formats.options import ReadOptions
from gapr_core.surface import Surface


def fcsv(path, said, points=POINTS):
    rows = "".join(f"p{i},{x},{y},{z},0,0,0,1,1,1,0,F-{i},,\n" for i, (x, y, z) in enumerate(points))
    columns = "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
    path.write_text(f"# Markups fiducial file version = 4.6\n{said}{columns}{rows}")
    return path


@pytest.mark.parametrize(("said", "factors"), [
    ("0", LPS_RAS), ("1", [1, 1, 1]), ("RAS", LPS_RAS), ("LPS", [1, 1, 1]),
])  # fmt: skip
def test_old_fcsv_files_write_their_axes_as_a_number_and_0_is_ras(tmp_path, said, factors):
    read = markups.load(fcsv(tmp_path / "a.fcsv", f"# CoordinateSystem = {said}\n"))
    np.testing.assert_allclose(read.points, POINTS * factors)
    assert read.labels == ("F-0", "F-1", "F-2")
    np.testing.assert_allclose(clouds.load(tmp_path / "a.fcsv", units="m").points, POINTS * factors)


def test_points_of_an_fcsv_file_that_were_never_placed_stay_behind(tmp_path):
    """3D Slicer 5 ends a row with two columns without a name, the status of the position first, and may keep a CR."""
    path = fcsv(tmp_path / "a.fcsv", "# CoordinateSystem = LPS\n")
    head, *rows = path.read_text().split("associatedNodeID\n")
    rows = rows[0].splitlines()
    assert len(rows) == 3
    rows = [f"{rows[0]}\r,2,0", f"{rows[1]},0,0", f"{rows[2]},2,0"]
    path.write_bytes(f"{head}associatedNodeID\n".encode() + "".join(f"{row}\n" for row in rows).encode())
    read = markups.load(path)
    np.testing.assert_allclose(read.points, POINTS[[0, 2]])
    assert read.labels == ("F-0", "F-2")


@pytest.mark.parametrize(("content", "said"), [
    ("", "neither LPS nor RAS"), ("# CoordinateSystem = 2\n", "neither LPS nor RAS"),
    ("# CoordinateSystem = LPS\n# CoordinateSystem = RAS\n", "lines CoordinateSystem that contradict each other"),
])  # fmt: skip
def test_axes_of_markups_are_never_guessed(tmp_path, content, said):
    with pytest.raises(InvalidPointCloudError, match=said):
        reading.read(fcsv(tmp_path / "a.fcsv", content))
    path = fcsv(tmp_path / "b.fcsv", "# CoordinateSystem = LPS\n")
    path.write_text(2 * path.read_text())  # two files that were joined
    assert len(markups.load(path).points) == 6


def test_several_lists_of_a_file_are_joined_with_a_warning(tmp_path, caplog):
    path = tmp_path / "a.mrk.json"
    markups.save(path, markups.Markups(POINTS, ("a", "b", "c")))
    content = json.loads(path.read_text())
    region = {"type": "ROI", "coordinateSystem": "RAS", "controlPoints": [{"position": [1.0, 2.0, 3.0]}]}
    empty = {"type": "Fiducial", "coordinateSystem": "LPS", "controlPoints": []}
    for more, said in (([empty], None), ([empty, region], "a.mrk.json: 2 lists are joined (3 Fiducial, 1 ROI)")):
        path.write_text(json.dumps({"markups": content["markups"] + more}))
        assert len(clouds.load(path).points) == 2 + len(more)
        assert (said in caplog.text) if said else not caplog.text


@pytest.mark.parametrize("value", [1e308, np.inf, np.nan, -1e12])
def test_markups_with_a_number_beyond_any_coordinate_are_refused_by_their_name(tmp_path, value):
    path = fcsv(tmp_path / "a.fcsv", "# CoordinateSystem = LPS\n", np.vstack([POINTS, [0.0, value, 0.0]]))
    for read in (markups.load, reading.read):
        with pytest.raises(InvalidPointCloudError, match="finite numbers below 1e.12; got a.fcsv with others; place"):
            read(path)


@pytest.mark.parametrize(("space", "factors"), [("LPS", [1, 1, 1]), ("RAS", LPS_RAS)])
def test_mrk_json_points_come_in_lps_and_undefined_ones_stay_behind(tmp_path, space, factors):
    points = [{"label": f"L{i}", "position": p.tolist()} for i, p in enumerate(POINTS)]
    points.append({"label": "later", "position": [0, 0, 0], "positionStatus": "undefined"})
    node = {"type": "Fiducial", "coordinateSystem": space, "coordinateUnits": "mm", "controlPoints": points}
    (tmp_path / "a.mrk.json").write_text(json.dumps({"markups": [node]}))
    read = markups.load(tmp_path / "a.mrk.json")
    np.testing.assert_allclose(read.points, POINTS * factors)
    assert read.labels == ("L0", "L1", "L2")


FLAT = {"coordinateSystem": "LPS", "controlPoints": [{"position": [1.0, 2.0]}] * 3}  # six numbers, no two points


@pytest.mark.parametrize("name", ["a.mrk.json", "a.fcsv"])
@pytest.mark.parametrize("content", [
    "", "{}", "nonsense", '{"markups": []}', '{"markups": [{"coordinateSystem": "LPS"}]}',
    json.dumps({"markups": [FLAT]}),
])  # fmt: skip
def test_damaged_and_empty_markups_are_refused_in_one_line(tmp_path, name, content):
    (tmp_path / name).write_text(content)
    with pytest.raises(InvalidPointCloudError, match=name):
        reading.read(tmp_path / name)


OBJ = "v 10 20 30\nv -40 5 60\nv 7 -8 90\nv 0 0 0\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


@pytest.mark.parametrize("content", [
    OBJ, *[OBJ.replace(" ", between) for between in ("\t", "   ", " \t")],
    # a line may end with a comment, which no backslash continues, or go on after a backslash
    "# C:\\bones\\\nv 10 20 30 # C:\\\nv -40 5\\\n60#\nv 7 -8 90\nv 0 \\\n 0 \\\r\n0\n"
    "f 1 3 2#c\nf 1 \\\n2 4 # \\\nf 2 3 4\\\n\nf 3 1 4 # 5\n",
])  # fmt: skip
def test_words_and_lines_of_an_obj_file(tmp_path, content):
    (tmp_path / "a.obj").write_text(content)
    surface = reading.read(tmp_path / "a.obj")
    np.testing.assert_allclose(surface.points, [*POINTS, [0, 0, 0]])
    assert surface.faces.tolist() == [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]


def test_a_pivot_calibration_finds_the_tip_and_says_how_well(tmp_path):
    path = ndi_csv(tmp_path / "pivot.csv", turned_poses(), lost=(3, 7))
    tip = tracker.pivot(tracker.read_poses(path))
    np.testing.assert_allclose(tip.tip_mm, TIP, atol=1e-6)
    np.testing.assert_allclose(tip.pivot_mm, PIVOT, atol=1e-6)
    assert tip.residual_mm < 1e-6 and tip.poses == 38
    noisy = tracker.pivot(turned_poses(400, noise=0.3))
    assert noisy.residual_mm == pytest.approx(0.3 * np.sqrt(3.0), rel=0.1)
    np.testing.assert_allclose(noisy.tip_mm, TIP, atol=0.3)


def test_a_recording_may_have_semicolons_and_no_decimal_commas(tmp_path):
    commas = ndi_csv(tmp_path / "a.csv", turned_poses())
    text = commas.read_text().replace(",", ";")
    (tmp_path / "b.csv").write_text(text)
    np.testing.assert_array_equal(tracker.read_poses(tmp_path / "b.csv"), tracker.read_poses(commas))
    tips = reading.read(tmp_path / "b.csv", ReadOptions(tip_mm=tuple(TIP))).points
    np.testing.assert_allclose(tips, np.tile(PIVOT, (40, 1)), atol=1e-6)
    (tmp_path / "c.csv").write_text(text.replace(".", ","))
    with pytest.raises(InvalidPointCloudError, match="a point, such as 1.5; got c.csv with -?[0-9]+,[0-9]+; save it"):
        tracker.read_poses(tmp_path / "c.csv")


@pytest.mark.parametrize(("poses", "said"), [
    (turned_poses(axis=np.array([0.0, 0.0, 1.0])), "two axes"), (turned_poses(5), "at least 10 poses"),
    (turned_poses(60) + np.pad(np.random.default_rng(1).uniform(-60.0, 60.0, (60, 3, 1)), ((0, 0), (0, 1), (3, 0))),
     "within 3 mm of one place"),
])  # fmt: skip
def test_poses_without_one_tip_are_refused(poses, said):
    with pytest.raises(InvalidPointCloudError, match=said):
        tracker.pivot(poses)


def test_poses_of_which_the_tip_had_left_its_place_do_not_move_the_calibration():
    """Recordings run before the tip is in the dimple and after: of six real ones three had 2 to 11 % such poses."""
    poses = turned_poses(300, noise=0.3)
    lifted = turned_poses(40)
    lifted[:, :3, 3] += np.linspace(20.0, 300.0, 40)[:, None] * [0.6, 0.0, 0.8]
    clean, tip = tracker.pivot(poses), tracker.pivot(np.concatenate([lifted, poses]))
    assert (tip.poses, tip.left_out, clean.left_out) == (300, 40, 0)
    np.testing.assert_allclose(tip.tip_mm, clean.tip_mm, atol=1e-9)
    assert tip.residual_mm == pytest.approx(clean.residual_mm)


def test_angles_about_z_y_and_x_are_the_same_poses_as_quaternions(tmp_path):
    """NDI Track writes either; Rz Ry Rx are the angles of the rotation Rz Ry Rx, in degrees."""
    poses = turned_poses(40)
    rows = ["Tools,Port 0x0A: NDI-MF2 s/n:1,Frame,Time [sec],Face,State,Rz,Ry,Rx,Tx,Ty,Tz,Error,Markers"]
    for T in poses:
        rz, ry, rx = Rotation.from_matrix(T[:3, :3]).as_euler("ZYX", degrees=True)
        turn = [Rotation.from_euler(axis, angle, degrees=True) for axis, angle in (("z", rz), ("y", ry), ("x", rx))]
        np.testing.assert_allclose((turn[0] * turn[1] * turn[2]).as_matrix(), T[:3, :3], atol=1e-12)
        rows.append(",".join(["1", "Port 0x0A", "7", "1.5", "1", "OK", *map(str, [rz, ry, rx, *T[:3, 3]]), "0.1", "0"]))
    path = tmp_path / "probe.csv"
    path.write_text("\n".join(rows) + "\n")
    np.testing.assert_allclose(tracker.read_poses(path), poses, atol=1e-9)
    with pytest.raises(InvalidPointCloudError, match="--tip"):
        reading.read(path)
    surface = reading.read(path, ReadOptions(tip_mm=(3.0, -5.0, 150.0)))
    np.testing.assert_allclose(surface.points, np.tile(PIVOT, (40, 1)), atol=1e-6)


def test_several_tools_are_listed_by_what_ndi_track_calls_them(tmp_path):
    path = two_tools(tmp_path / "two.csv")
    text = path.read_text().replace("Port,", "Port 2: NDI 8700339,", 1)
    path.write_text(text.replace("Tools,Port,", "Tools,Port 3: NDI 340,", 1))
    with pytest.raises(InvalidPointCloudError, match=r"with 2 \(0: Port 2: NDI 8700339, 1: Port 3: NDI 340\)"):
        tracker.read_poses(path)


def two_tools(path):
    """A reference at rest, then a pointer."""
    rest, pointer = np.tile(np.eye(4), (12, 1, 1)), turned_poses(12)
    if path.suffix == ".mha":
        igs(path, pointer, ["OK"] * 12)
        frames = "".join(f"Seq_Frame{i:04d}_ATransform = {' '.join(map(str, T.ravel()))}\n" for i, T in enumerate(rest))
        path.write_bytes(frames.encode() + path.read_bytes())
        return path
    rows = [line.split(",") for line in ndi_csv(path, pointer).read_text().splitlines()]
    still = [line.split(",") for line in ndi_csv(path, rest).read_text().splitlines()]
    path.write_text("".join(",".join(a + b) + "\n" for a, b in zip(still, rows, strict=True)))
    return path


def test_an_error_lists_at_most_eight_tools_and_cuts_their_names(tmp_path):
    named = [f"tool{i}{100 * 'x'}" for i in range(9)]
    with pytest.raises(InvalidPointCloudError) as found:
        tracker.chosen(None, named, tmp_path / "many.igs.mha")
    assert "with 9 (0: tool0" in str(found.value) and "7: tool7" in str(found.value) and "tool8" not in str(found.value)
    assert 40 * "x" not in str(found.value)


@pytest.mark.parametrize("value", [b"nan", b"-inf"])
def test_a_transform_that_is_not_finite_is_refused_where_it_is_valid(tmp_path, value):
    for second in ("OK", "INVALID"):
        path = igs(tmp_path / "tool.igs.mha", turned_poses(3), ["OK", second, "OK"])
        path.write_bytes(re.sub(rb"(Seq_Frame0001_\w+Transform = )\S+", rb"\g<1>" + value, path.read_bytes()))
        if second == "OK":
            with pytest.raises(InvalidPointCloudError, match="not finite"):
                reading.read(path, ReadOptions(tip_mm=tuple(TIP)))
    points = reading.read(path, ReadOptions(tip_mm=tuple(TIP))).points
    np.testing.assert_allclose(points, np.tile(PIVOT, (2, 1)), atol=1e-6)


@pytest.mark.parametrize("name", ["two.csv", "two.igs.mha"])
def test_one_of_several_tools_is_never_guessed(tmp_path, name):
    path, tip = two_tools(tmp_path / name), tuple(TIP)
    with pytest.raises(InvalidPointCloudError, match="one tool; got .* with 2 .0.*1.*; name one with --tool"):
        reading.read(path, ReadOptions(tip_mm=tip))
    with pytest.raises(InvalidPointCloudError, match="tool 2; got"):
        reading.read(path, ReadOptions(tip_mm=tip, tool=2))
    points = reading.read(path, ReadOptions(tip_mm=tip, tool=1)).points
    np.testing.assert_allclose(points, np.tile(PIVOT, (12, 1)), atol=1e-6)
    with pytest.raises(InvalidPointCloudError, match="the tip of the tool; got .*; give it with --tip"):
        reading.read(path)


def test_units_of_markups_are_one_for_all_axes(tmp_path):
    points = [{"label": f"L{i}", "position": (p / 10.0).tolist()} for i, p in enumerate(POINTS)]
    coded = ["cm", "UCUM", "centimeter"], ["cm", "UCUM"]  # schema 1.0.3 of 3D Slicer
    right = [(each, POINTS) for each in (["cm", "cm", "cm"], "cm", *coded)]
    for said, expected in (*right, (["cm", "mm", "cm"], None), (["inch", "UCUM"], None), ("inch", None)):
        node = {"coordinateSystem": "LPS", "coordinateUnits": said, "controlPoints": points}
        (tmp_path / "a.mrk.json").write_text(json.dumps({"markups": [node]}))
        if expected is not None:
            np.testing.assert_allclose(markups.load(tmp_path / "a.mrk.json").points, expected)
            continue
        with pytest.raises(InvalidPointCloudError, match="coordinateUnits .* none of mm"):
            markups.load(tmp_path / "a.mrk.json")


@pytest.mark.parametrize(("tip", "said"), [
    (TIP, ""), (np.zeros(3), ""), (TIP / 1000.0, "the tip is 0.15 mm from its marker"), (TIP * 1000.0, "1.5e+05 mm"),
])  # fmt: skip
def test_a_tip_that_seems_to_be_in_another_unit_is_warned_of(tmp_path, caplog, tip, said):
    """In metres it lay on the marker: a pointer that was hardly turned gave the right shape, 150 mm off."""
    rows = "".join(f"OK,1,0,0,0,{x},{y},{z}\n" for x, y, z in POINTS)
    (tmp_path / "a.csv").write_text(f"State,Q0,Qx,Qy,Qz,Tx,Ty,Tz\n{rows}")
    for path in (tmp_path / "a.csv", igs(tmp_path / "a.igs.mha", turned_poses(3), ["OK"] * 3)):
        caplog.clear()
        assert len(reading.read(path, ReadOptions(tip_mm=tuple(tip))).points) == 3
        assert (said in caplog.text and "is it in mm?" in caplog.text) if said else not caplog.text


def test_poses_of_a_plus_sequence_are_read_where_they_are_valid(tmp_path):
    path = igs(tmp_path / "a.igs.mha", turned_poses(4), ["OK", "INVALID", "OK", "OK"])
    surface = reading.read(path, ReadOptions(tip_mm=tuple(TIP)))
    np.testing.assert_allclose(surface.points, np.tile(PIVOT, (3, 1)), atol=1e-6)
    with pytest.raises(InvalidPointCloudError, match="no valid transform"):
        reading.read(igs(tmp_path / "b.igs.mha", turned_poses(1), ["INVALID"]), ReadOptions(tip_mm=tuple(TIP)))


def test_a_folder_of_tracked_slices_is_one_cloud(tmp_path):
    poses = turned_poses(2)
    for i in range(2):
        np.savetxt(tmp_path / f"slice{i}.xyz", POINTS)
    np.testing.assert_allclose(reading.read(tmp_path).points, np.vstack([POINTS, POINTS]))
    np.savetxt(tmp_path / "poses.csv", poses.reshape(2, 16), delimiter=",")
    moved = [POINTS @ T[:3, :3].T + T[:3, 3] for T in poses]
    np.testing.assert_allclose(reading.read(tmp_path).points, np.vstack(moved))
    np.savetxt(tmp_path / "slice2.xyz", POINTS)
    with pytest.raises(InvalidPointCloudError, match="2 poses of 3 slices"):
        reading.read(tmp_path)


def test_slices_are_in_the_order_of_their_numbers(tmp_path, caplog):
    poses = turned_poses(12)
    expected = np.vstack([(POINTS + i) @ T[:3, :3].T + T[:3, 3] for i, T in enumerate(poses)])
    padded = slices_with_poses(tmp_path / "padded", poses)
    np.testing.assert_allclose(reading.read(padded).points, expected)
    assert "count as numbers" not in caplog.text
    plain = slices_with_poses(tmp_path / "plain", poses, [f"slice_{i}.xyz" for i in range(1, 13)])
    np.testing.assert_allclose(reading.read(plain).points, expected)
    assert "first line of poses.csv is of slice_1.xyz, the last of slice_12.xyz" in caplog.text


@pytest.mark.parametrize("file", ["poses.txt", "Poses.csv", "pose.csv", "POSES.CSV", "slice_poses.csv", "poses.json"])
def test_poses_under_a_name_like_theirs_are_refused(tmp_path, file):
    folder = slices_with_poses(tmp_path / "a", turned_poses(2), file=file)
    with pytest.raises(InvalidPointCloudError, match=f"poses in poses.csv; got a: {file}; rename it to poses.csv"):
        reading.read(folder)


def test_names_that_only_contain_the_word_are_slices(tmp_path):
    folder = slices_with_poses(tmp_path / "a", turned_poses(1), ["exposed_bone.xyz"])
    (folder / ".poses.csv.swp").write_text("an editor's own")
    assert len(reading.read(folder).points) == 3


CHANGES = {
    "transposed": lambda T: T.T, "scaled": lambda T: T @ np.diag([2.0, 2.0, 2.0, 1.0]),
    "reflected": lambda T: T @ np.diag([1.0, 1.0, -1.0, 1.0]), "nan": lambda T: T * np.nan,
    "last row": lambda T: T + np.diag([0.0, 0.0, 0.0, 1.0]),
}  # fmt: skip


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_poses_of_slices_are_rigid(tmp_path, change):
    poses = turned_poses(2)
    rounded = slices_with_poses(tmp_path / "rounded", np.round(poses, 3))
    moved = [(POINTS + i) @ T[:3, :3].T + T[:3, 3] for i, T in enumerate(poses)]
    np.testing.assert_allclose(reading.read(rounded).points, np.vstack(moved), atol=0.2)
    folder = slices_with_poses(tmp_path / "a", [poses[0], change(poses[1])])
    with pytest.raises(InvalidPointCloudError, match="rigid 4x4 matrices in poses.csv; got a: pose 2 with "):
        reading.read(folder)


MESH = (
    "# vtk DataFile Version 3.0\n{}\nASCII\nDATASET POLYDATA\n"
    "POINTS 3 float\n10 20 30 -40 5 60 7 -8 90\nPOLYGONS 1 4\n3 0 1 2\n"
)


@pytest.mark.parametrize(("title", "axes", "factors"), [
    ("bone", "auto", [1, 1, 1]), ("SPACE=LPS", "auto", [1, 1, 1]), ("SPACE=RAS", "auto", LPS_RAS),
    ("bone", "ras", LPS_RAS), ("bone", "lps_to_ras", LPS_RAS), ("bone", "lps", [1, 1, 1]),
    ("SPACE=RAS", "as_is", [1, 1, 1]), ("SPACE=RAS", "lps", [1, 1, 1]), ("SPACE=RAS", "ras", LPS_RAS),
    ("SPACE=LPS", "ras", LPS_RAS), ("SPACE=LPS", "lps_to_ras", LPS_RAS), ("SPACE=LPS", "as_is", [1, 1, 1]),
    ("SPACE = RAS", "auto", LPS_RAS), ("SPACE =LPS", "lps_to_ras", LPS_RAS), ("SPACE", "auto", [1, 1, 1]),
    ("WORKSPACE=RAS", "auto", [1, 1, 1]), ("SPACE=RAS, SPACE=RAS", "auto", LPS_RAS), ("space=ras", "auto", LPS_RAS),
])  # fmt: skip
def test_axes_of_a_mesh_come_from_the_caller_or_from_its_comment(tmp_path, title, axes, factors):
    (tmp_path / "a.vtk").write_text(MESH.format(title))
    np.testing.assert_allclose(reading.read(tmp_path / "a.vtk", ReadOptions(axes=axes)).points, POINTS * factors)


@pytest.mark.parametrize("compressor", ["None", "ZLib"])
@pytest.mark.parametrize("mode", ["Ascii", "Binary", "Appended"])
@pytest.mark.parametrize(("said", "factors"), [
    ("LPS", [1, 1, 1]), ("RAS", LPS_RAS), ("SCANNER", [1, 1, 1]), (None, [1, 1, 1]),
])  # fmt: skip
def test_axes_of_a_vtp_file_come_from_its_array_space_however_it_is_written(tmp_path, mode, compressor, said, factors):
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    poly, writer = triangle_with(*[said] * bool(said)), vtkXMLPolyDataWriter()
    writer.SetFileName(str(tmp_path / "a.vtp"))
    getattr(writer, f"SetDataModeTo{mode}")()
    getattr(writer, f"SetCompressorTypeTo{compressor}")()
    writer.SetInputData(poly)
    assert writer.Write()
    np.testing.assert_allclose(reading.read(tmp_path / "a.vtp").points, POINTS * factors)


@pytest.mark.parametrize("version", [42, 51])
@pytest.mark.parametrize("is_binary", [False, True])
def test_texts_in_a_legacy_vtk_file_are_passed_over(tmp_path, version, is_binary):
    """A binary text has its length before it, in one, two or four bytes."""
    poly = triangle_with(*("x" * length for length in (0, 5, 63, 64, 300, 16383, 16384)))
    surface = reading.read(legacy_vtk(tmp_path / "a.vtk", poly, is_binary, version))
    np.testing.assert_allclose(surface.points, POINTS)
    assert surface.faces.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize("version", [42, 51])
@pytest.mark.parametrize("is_binary", [False, True])
@pytest.mark.parametrize(("said", "factors"), [("LPS", [1, 1, 1]), ("RAS", LPS_RAS), ("SCANNER", [1, 1, 1])])
def test_axes_of_a_legacy_vtk_file_come_from_its_field_space_as_well(tmp_path, version, is_binary, said, factors):
    path = legacy_vtk(tmp_path / "a.vtk", triangle_with(said), is_binary, version)
    np.testing.assert_allclose(reading.read(path).points, POINTS * factors)


@pytest.mark.parametrize("is_binary", [False, True])
@pytest.mark.parametrize("name", ["a.vtk", "a.VTK"])
def test_axes_of_a_legacy_vtk_file_may_come_after_kilobytes_of_other_fields(tmp_path, is_binary, name):
    from vtkmodules.util.numpy_support import numpy_to_vtk

    poly, fields = triangle_with("RAS"), triangle_with()
    for number in range(2):
        array = numpy_to_vtk(np.random.default_rng(0).random((700, 3)), deep=True)
        array.SetName(f"parameters {number}")
        for component in range(3):
            array.SetComponentName(component, "xyz"[component])
        fields.GetFieldData().AddArray(array)
    fields.GetFieldData().AddArray(poly.GetFieldData().GetAbstractArray("SPACE"))
    path = legacy_vtk(tmp_path / name, fields, is_binary)
    assert path.read_bytes().index(b"SPACE") > 8192
    np.testing.assert_allclose(reading.read(path).points, POINTS * LPS_RAS)


def test_comments_of_a_ply_file_may_be_in_any_language(tmp_path):
    head = "ply\nformat {} 1.0\ncomment Oberschenkel, M\u00fcller \u9aa8\nelement vertex 3\n"
    head += "property float x\nproperty float y\nproperty float z\nend_header\n"
    rows = "\n".join(" ".join(map(str, point)) for point in POINTS)
    (tmp_path / "text.ply").write_text(head.format("ascii") + rows + "\n", encoding="utf-8")
    binary = head.format("binary_little_endian").encode() + POINTS.astype("<f4").tobytes()
    (tmp_path / "binary.ply").write_bytes(binary)
    for name in ("text.ply", "binary.ply"):
        np.testing.assert_allclose(reading.read(tmp_path / name).points, POINTS)


@pytest.mark.parametrize("comment", ["converted from format ascii", "no end_header here", "end_header", "format ascii"])
@pytest.mark.parametrize("ending", ["\n", "\r\n", "\r"])
def test_comments_of_a_ply_file_may_hold_the_words_of_its_header(tmp_path, comment, ending):
    head = f"ply\nformat binary_little_endian 1.0\ncomment {comment}\nelement vertex 3\n"
    head += "property float x\nproperty float y\nproperty float z\nend_header\n"
    (tmp_path / "a.ply").write_bytes(head.replace("\n", ending).encode() + POINTS.astype("<f4").tobytes())
    np.testing.assert_allclose(reading.read(tmp_path / "a.ply").points, POINTS)


@pytest.mark.parametrize("change", [
    ("facet normal", "facet  normal"), ("facet normal", "facet\tnormal"), ("solid a", "solid endfacet"),
    ("endloop\nendfacet", "endloop endfacet"),
    ("solid a", "solid facet normal"), ("solid a\nfacet", "\ufeffsolid a\nfacet"), ("\n", "\r\n"), ("\n", "\n\t"),
])  # fmt: skip
def test_words_of_a_text_stl_file_count_at_the_beginning_of_its_lines(tmp_path, change):
    corners = "".join(f"vertex {x} {y} {z}\n" for x, y, z in POINTS)
    content = f"solid a\nfacet normal 0 0 1\nouter loop\n{corners}endloop\nendfacet\nendsolid a\n"
    (tmp_path / "a.stl").write_text(content.replace(*change), encoding="utf-8", newline="")
    surface = reading.read(tmp_path / "a.stl")
    np.testing.assert_allclose(surface.points[surface.faces[0]], POINTS)


TABLES = {
    "0.xyz": "10 20 30\n-40 5 60\n7 -8 90\n",
    "1.txt": "# from a probe\nx;y;z\n10;20;30\n-40;5;60\n7;-8;90\n",
    "2.csv": "10,20,30\n-40,5,60\n7,-8,90\n",
    "3.csv": "Time,Z,X,Y\n0,30,10,20\n1,60,-40,5\n2,90,7,-8\n",
    "4.csv": "\ufeff10,20,30\r\n-40,5,60\r\n7,-8,90\r\n",
    "5.xyz": "\ufeff# z x y\r\n30 10 20\r\n60 -40 5\r\n90 7 -8\r\n",
    "6.csv": "sep=;\nz;x;y\n30;10;20\n60;-40;5\n90;7;-8\n",
    "7.csv": "\ufeffsep=,\r\nz,x,y\r\n30,10,20\r\n60,-40,5\r\n90,7,-8\r\n",
    "a.txt": "z y x\n30 20 10\n60 5 -40\n90 -8 7\n",
    "b.xyz": "id x y z\n0 10 20 30\n1 -40 5 60\n2 7 -8 90\n",
    "c.csv": "\ufeffZ (mm),Y (mm),X (mm)\n30,20,10\n60,5,-40\n90,-8,7\n",
    "d.csv": '"X","Y","Z"\n10,20,30\n-40,5,60\n7,-8,90\n',
    "f.csv": "id,x_mm,y_mm,z_mm\n0,10,20,30\n1,-40,5,60\n2,7,-8,90\n",
    "o.xyz": "cloud 7\n10 20 30\n-40 5 60\n7 -8 90\n",
    "e.xyz": "a cloud\n10 20 30\n-40 5 60\n7 -8 90\n",
    "g.txt": "# from a probe\n# id x y z\n0 10 20 30\n1 -40 5 60\n2 7 -8 90\n",
    "h.txt": "//Z Y X R G B\n30 20 10 1 2 3\n60 5 -40 1 2 3\n90 -8 7 1 2 3\n",
    "i.txt": "# x y z of the femur\n10 20 30\n-40 5 60\n7 -8 90\n",
    "j.csv": "# made by hand\ntime,x,y,z,\n0,10,20,30\n1,-40,5,60\n2,7,-8,90\n",
    "k.csv": "x_ref,y_ref,z_ref,x,y,z\n1,2,3,10,20,30\n1,2,3,-40,5,60\n1,2,3,7,-8,90\n",
    "l.txt": "x (mm) y (mm) z (mm)\n10 20 30\n-40 5 60\n7 -8 90\n",
    "m.txt": "x y z colour\n10 20 30 1 2\n-40 5 60 1 2\n7 -8 90 1 2\n",
    "n.csv": '"Tool, time",x,y,z\n0,10,20,30\n1,-40,5,60\n2,7,-8,90\n',
    "text.csv": "name,x,y,z\nhip,10,20,30\n,-40,5,60\nknee,7,-8,90\n",
    "quoted.csv": '"x","y","z"\n"10","20","30"\n"-40","5","60"\n"7","-8","90"\n',
    "nameless.csv": '"10","20","30"\n"-40","5","60"\n"7","-8","90"\n',
    "later.csv": 'x,y,z,note\n10,20,30,\n-40,5,60,"a, b"\n7,-8,90,"5"\n',
    "tabs.txt": "# by hand\nx\ty\tz\tname\n10\t20\t30\tthe hip\n\n-40\t5\t60\t\n7\t-8\t90\t\n",
    "spaces.xyz": "name x y z\nhip 10 20 30\nknee -40 5 60\nfoot 7 -8 90\n",
    "comment.txt": "# x y z name\n10 20 30 hip\n-40 5 60 knee\n7 -8 90 foot\n",
    "trailing.csv": "x,y,z,\n10,20,30,\n-40,5,60,\n7,-8,90,\n",
}


@pytest.mark.parametrize("name", TABLES)
def test_a_line_of_names_says_which_column_is_which_and_the_others_may_be_text(tmp_path, name):
    (tmp_path / name).write_text(TABLES[name], encoding="utf-8")
    np.testing.assert_allclose(reading.read(tmp_path / name).points, POINTS)


@pytest.mark.parametrize(("name", "delimiter", "header"), [("a.txt", " ", ""), ("a.csv", ",", ""),
                                                           ("a.xyz", " ", "x y z")])  # fmt: skip
def test_a_row_for_each_coordinate_is_refused_as_transposed(tmp_path, name, delimiter, header):
    points = np.random.default_rng(0).normal(size=(40, 3))
    np.savetxt(tmp_path / name, points.T, delimiter=delimiter, header=header)
    with pytest.raises(InvalidPointCloudError, match=f"{name}: 3 rows of 40 numbers; is it transposed.*one point a"):
        reading.read(tmp_path / name)
    np.savetxt(tmp_path / name, points[:12].T, delimiter=delimiter, header=header)
    assert len(reading.read(tmp_path / name).points) == 3
    names = "x y z " + " ".join(f"c{i}" for i in range(37))
    np.savetxt(tmp_path / name, points.T, delimiter=delimiter, header=delimiter.join(names.split()))
    assert len(reading.read(tmp_path / name).points) == 3


@pytest.mark.parametrize(("more", "header", "is_warned"), [
    ([[7.0, 8.0]], "", True), ([[7.0, 8.0, 9.0]], "", True), ([[0.6, 0.8, 0.0]], "", False), ([[]], "", False),
    ([[7.0, 8.0]], "x y z a b", False),
])  # fmt: skip
def test_columns_that_nobody_named_are_warned_of_unless_they_are_normals(tmp_path, caplog, more, header, is_warned):
    rows = np.hstack([POINTS, np.repeat(more, len(POINTS), axis=0)])
    for name, delimiter, comments in (("a.txt", " ", "# "), ("b.csv", ",", "")):
        caplog.clear()
        np.savetxt(tmp_path / name, rows, delimiter=delimiter, comments=comments,
                   header=delimiter.join(header.split()))  # fmt: skip
        np.testing.assert_allclose(clouds.load(tmp_path / name).points, POINTS)
        said = f"{name} has {rows.shape[1]} columns without names: the first three are taken as x y z"
        assert (said in caplog.text) == is_warned


@pytest.mark.parametrize(("names", "unit"), [
    ("x (cm),y (cm),z (cm)", "cm"), ("x_m,y_m,z_m", None), ("X [m],Y [m],Z [m]", "m"), ("t (mm),x,y_cm,z_cm", "cm"),
    ("L (mm),P (mm),S (mm)", "mm"), ("x,y,z,error_cm", None), ("# x/cm,y/cm,z/cm", "cm"), ("# of the hip_cm", None),
    ("x (centimeters),y (centimeters),z (centimeters)", "cm"), ("x in cm,y in cm,z in cm", "cm"),
    ("# x,y,z in cm", "cm"), ("x (metres),y (metres),z (metres)", "m"), ("x in,y in,z in", None),
    ("x_millimetre,y_millimetre,z_millimetre", "mm"), ("x (in),y [inch],z (inches)", "in"),
    ("x_inch,y_inch,z_inch", "in"),
])  # fmt: skip
def test_a_unit_in_the_names_of_the_coordinates_is_never_passed_over(tmp_path, names, unit):
    path, extra = tmp_path / "a.csv", (names.count(",") == 3)
    rows = np.insert(POINTS, 0 if names.startswith("t") else 3, 7.0, axis=1) if extra else POINTS
    path.write_text(names + "\n" + "".join(",".join(map(str, row)) + "\n" for row in rows))
    for named, mm in clouds.MM_PER_UNIT.items():
        if named == "m":  # so large is no bone
            continue
        if unit in (None, named):
            np.testing.assert_allclose(clouds.load(path, units=named).points, POINTS * mm)
            continue
        said = f"the unit that the file says; got .*a.csv with coordinates in {unit} by their names, read as {named}"
        with pytest.raises(InvalidPointCloudError, match=f"{said}; pass units='{unit}'"):
            clouds.load(path, units=named)
    if unit == "cm":
        np.testing.assert_allclose(clouds.load(path, units="auto").points, POINTS * 10.0)


def test_the_unit_of_another_column_is_not_that_of_the_coordinates(tmp_path):
    (tmp_path / "a.csv").write_text("x (mm),y (mm),z (mm),r (um)\n1,2,3,4\n40,50,60,4\n10,20,90,4\n")
    assert clouds.load(tmp_path / "a.csv").extent_mm > 90.0


def test_slices_in_another_unit_are_refused(tmp_path):
    (tmp_path / "a.csv").write_text("x (cm),y (cm),z (cm)\n1,2,3\n40,50,60\n")
    with pytest.raises(InvalidPointCloudError, match="slices in mm; got .*a.csv with coordinates in cm"):
        clouds.load(tmp_path)


SLICER = "label,{},defined,selected,visible,locked,description\n"
ROWS = (
    'F-1,10,20,30,1,1,1,0,\n"F-2, later",-40,5,60,1,1,1,0,"hip, left"\n'
    "F-3,0,0,0,0,1,1,0,never placed\nF-4,7,-8,90,1,1,1,0,\n"
)


@pytest.mark.parametrize(("content", "factors"), [
    (SLICER.format("l,p,s") + ROWS, [1, 1, 1]), (SLICER.format("r,a,s") + ROWS, LPS_RAS),
    ("R,A,S\n10,20,30\n-40,5,60\n7,-8,90\n", LPS_RAS),
    ("# id r a s\n0 10 20 30\n1 -40 5 60\n2 7 -8 90\n", LPS_RAS),
    ("L (mm);P (mm);S (mm)\n10;20;30\n-40;5;60\n7;-8;90\n", [1, 1, 1]),
    ("r a s id\n10 20 30 0\n-40 5 60 1\n7 -8 90 2\n", LPS_RAS),
    ("# R A S of the femur\n10 20 30\n-40 5 60\n7 -8 90\n", LPS_RAS),
    ("# a,r,s,q\n20,10,30,\n5,-40,60,\n-8,7,90,\n", LPS_RAS),
    ("S\tA\tR\n30\t20\t10\n60\t5\t-40\n90\t-8\t7\n", LPS_RAS),
])  # fmt: skip
def test_columns_l_p_s_and_r_a_s_say_their_axes(tmp_path, caplog, content, factors):
    path = tmp_path / "a.csv"
    path.write_text(content)
    np.testing.assert_allclose(reading.read(path).points, POINTS * factors)
    assert reading.says_axes(path) and ("has columns r a s: x and y are negated" in caplog.text) == (factors == LPS_RAS)
    np.testing.assert_allclose(reading.read(path, ReadOptions(axes="as_is")).points, POINTS)
    if factors == LPS_RAS:
        with pytest.raises(ConfigError, match="a file in LPS for lps_to_ras; got a.csv, which has columns r a s; use"):
            reading.read(path, ReadOptions(axes="lps_to_ras"))


def test_normals_in_r_a_s_are_turned_with_their_points(tmp_path):
    (tmp_path / "a.csv").write_text("r,a,s,nx,ny,nz\n10,20,30,0,1,0\n-40,5,60,1,0,0\n")
    surface = reading.read(tmp_path / "a.csv")
    np.testing.assert_allclose(surface.points, POINTS[:2] * LPS_RAS)
    np.testing.assert_allclose(surface.normals, [[0, -1, 0], [-1, 0, 0]])


def test_a_point_with_an_empty_cell_is_left_out(tmp_path):
    (tmp_path / "a.csv").write_text("x,y,z,t\n10,20,30,0\n,,,1\n-40,5,60,\n1,,2,3\n7,-8,90,4\n")
    assert np.isnan(reading.read(tmp_path / "a.csv").points).any(axis=1).tolist() == [False, True, False, True, False]
    np.testing.assert_allclose(clouds.load(tmp_path / "a.csv").points, POINTS)


@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-16-be"])
@pytest.mark.parametrize("ending", ["csv", "txt", "fcsv", "mrk.json", "obj", "ply", "pcd", "vtk", "stl", "igs.mha"])
@pytest.mark.parametrize("mark", ["\ufeff", ""])
def test_utf_16_is_said_to_be_so(tmp_path, mark, ending, encoding):
    (tmp_path / f"a.{ending}").write_bytes((f"{mark}x,y,z\n" + 20 * "1,2,3\n").encode(encoding))
    with pytest.raises(InvalidPointCloudError, match=f"UTF-8 text; got a.{ending}: UTF-16 text; save it as UTF-8"):
        reading.read(tmp_path / f"a.{ending}")


UNCLEAR = [
    ("a.txt", "Point ID x y z\n0 1 2 3\n1 4 5 6\n", "for each of 4 columns; got a.txt: 5 .columns Point ID x y z"),
    ("b.txt", "time x y z quality flag\n0 1 2 3 9\n", "a name for each of 5 columns; got b.txt: 6"),
    ("c.txt", "Doe Jane\n0 1 2 3\n1 4 5 6\n", "a name for each of 4 columns; got c.txt: 2 names; give"),
    ("d.csv", "x,y,z\n25,828,-183,606,289,912\n", "each of 6 columns; got d.csv: 3 .*; .* decimals with a point"),
    ("e.csv", "25,828,-183,606,289,912\n", "decimals with a point, .* got e.csv: decimal commas"),
    ("f.csv", "x;y;z\n25,828;-183,606;289,912\n", "got f.csv: decimal commas .*; write them with a point$"),
    ("g.txt", "25,828 -183,606 289,912\n5,8 -3,6 2,2\n", "got g.txt: decimal commas .*; columns of whole numbers need"),
    ("h.csv", "x_ref,y_ref,z_ref,x_tip,y_tip,z_tip\n1,2,3,4,5,6\n",
     "one column each for x y z; got h.csv: .* x_ref .* z_tip"),
    ("j.csv", "0,10,20,30\n1,-40,5,60\n2,7,-8,90\n", "x y z in the first columns; got j.csv: a first column"),
    ("i.txt", "x y z x y z\n1 2 3 4 5 6\n", "one column each for x y z; got i.txt: columns x y z x y z; name"),
    ("k.xyz", "1.0 2.0 3.0 # Doe\n4 5 6\n7 8 9\n", "k.xyz: a first line with 3 numbers among its 5 words; take"),
    ("l.csv", "1.0,2.0,3.0,Doe\n4,5,6\n7,8,9\n", "3 numbers, names of 3 columns or a title; got l.csv: a first line"),
    ("m.txt", "1.0 2.0 3.O 4\n4 5 6\n7 8 9\n", "m.txt: a first line with 3 numbers among its 4 words"),
    ("n.xyz", "1 2 3 0 0 1 Doe\n4 5 6 0 0 1\n7 8 9 0 1 0\n", "n.xyz: a first line with 6 numbers among its 7 words"),
    *[("a.xyz", content, "a.xyz") for content in ("", "1 2\n3 4\n", "1 2 3\n4 5\n", "1 2 3\n4 5 x\n", "1 2 3\n4 5 6")],
    ("a.csv", "r,t,s\n1,2,3\n", "name them x y z, or leave that line out"),
    ("a.csv", "id,px,py,pz\n1,2,3,4\n", "name them x y z, or leave that line out"),
    ("a.csv", "x,y,z,l,p,s\n1,2,3,4,5,6\n", "one kind of coordinates; got .*columns x y z and l p s"),
    ("a.csv", "l,p,r,a,s\n1,2,3,4,5\n", "one kind of coordinates; got .*columns l p s and r a s"),
    ("a.csv", "# SPACE=LPS\nr,a,s\n1,2,3\n", "the same axes by comment and columns; got .*SPACE=LPS and columns r a s"),
    ("a.csv", "r a s r\n1 2 3\n", "a name for each of 3 columns"),
    ("a.csv", "# by hand\nx,y,z\n\n1,2,3\n4,Doe,6\n", "a number; got a.csv: text in column 2 of line 5; correct it"),
    ("a.csv", "name,x,y,z\na,1,2,3\nb,4,5\n", "4 columns in every line; got a.csv: 3 in line 3"),
    ("a.csv", "1,2,3\n4,5,6,7\n", "3 columns in every line; got a.csv: 4 in line 2"),
    ("a.csv", "1,2,3\n4,,6\n", "nothing in column 2 of line 2; correct it, or begin with a line of names"),
    ("a.csv", "1 2 3 0\n4 5 6 Doe\n", "text in column 4 of line 2; correct it, or begin with a line of names"),
    ("a.csv", "name;x;y;z\na;25,828;-183,606;289,912\n", "decimals with a point, .* got a.csv: decimal commas"),
    ("a.csv", 'name,x,y,z,note\na,1,2,3,"b\nc,4,5,6,"\nd,1,2,3,\n', "a quotation mark that is not closed in its line"),
    ("a.csv", "name,x,y,z\na,1_0,2,3\n", "text in column 2 of line 2"),
    ("a.txt", "1 2 3\n\0 5 6\n", "a number; got a.txt: text in column 1 of line 2"),  # one zero makes no UTF-16
    ("a.csv", "x (mm),y (cm),z (mm)\n1,2,3\n40,50,60\n", "one unit of all coordinates; got cm and mm"),
    ("a.csv", "x_um,y_um,z_um\n1,2,3\n40,50,60\n", "in mm, cm, m or in; got a.csv with columns in um; convert them"),
    *[("a.csv", f"x ({unit}),y [{unit}],z({unit})\n1,2,3\n40,50,60\n", f"a.csv with columns in {unit}; convert")
      for unit in ("um", "\u00b5m", "dm", "ft", "yd")],
]  # fmt: skip


@pytest.mark.parametrize(("name", "content", "said"), UNCLEAR)
def test_columns_and_units_are_never_guessed(tmp_path, name, content, said):
    (tmp_path / name).write_text(content)
    for units in clouds.MM_PER_UNIT:
        with pytest.raises(InvalidPointCloudError, match=said) as caught:
            clouds.load(tmp_path / name, units=units)
        assert "Doe" not in str(caught.value)


@pytest.mark.parametrize("axes", ["auto", "lps", "ras"])
def test_comments_that_contradict_each_other_about_the_axes_are_refused(tmp_path, axes):
    (tmp_path / "a.csv").write_text("# was SPACE=RAS, now turned: SPACE=LPS\n10,20,30\n")
    with pytest.raises(InvalidPointCloudError, match="one SPACE in all comments; got a.csv: SPACE=LPS and SPACE=RAS; "):
        reading.read(tmp_path / "a.csv", ReadOptions(axes=axes))


@pytest.mark.parametrize("head", ["", "x,y,z,nx,ny,nz\n"])
def test_whole_numbers_with_normals_are_no_decimal_commas(tmp_path, head):
    (tmp_path / "a.csv").write_text(head + "10,20,30,0,0,1\n40,5,60,0,1,0\n")
    surface = reading.read(tmp_path / "a.csv")
    np.testing.assert_allclose(surface.points, [[10, 20, 30], [40, 5, 60]])
    np.testing.assert_allclose(surface.normals, [[0, 0, 1], [0, 1, 0]])


def test_a_contradiction_of_axes_is_said(tmp_path, caplog):
    (tmp_path / "a.vtk").write_text(MESH.format("SPACE=RAS"))
    reading.read(tmp_path / "a.vtk", ReadOptions(axes="lps"))
    assert "says SPACE=RAS and is read as LPS" in caplog.text
    with pytest.raises(ConfigError, match="a file in LPS for lps_to_ras; got a.vtk, which says SPACE=RAS; use as_is"):
        reading.read(tmp_path / "a.vtk", ReadOptions(axes="lps_to_ras"))


def test_files_that_say_their_own_axes_are_not_turned_by_those_of_a_mesh(tmp_path):
    path = fcsv(tmp_path / "a.fcsv", "# CoordinateSystem = RAS\n")
    for axes in ("auto", "lps", "as_is"):
        np.testing.assert_allclose(reading.read(path, ReadOptions(axes=axes)).points, POINTS * LPS_RAS)
    np.testing.assert_allclose(reading.read(path, ReadOptions(axes="lps_to_ras")).points, POINTS)
    with pytest.raises(ConfigError, match="ras for a.fcsv, which has its own"):
        reading.read(path, ReadOptions(axes="ras"))
    with pytest.raises(ConfigError, match="axes that are one of auto, lps"):
        reading.read(path, ReadOptions(axes="up"))


def test_a_source_of_a_tracker_is_turned_by_the_axes_that_are_named(tmp_path):
    """What 3D Slicer shows live is RAS: a .tfm of the numbers as they are lies on the other side of the patient."""
    poses = turned_poses()
    csv, plus = ndi_csv(tmp_path / "a.csv", poses), tmp_path / "a.igs.mha"
    igs(plus, poses, ["OK"] * len(poses))
    for path in (csv, plus):
        for axes, factors in (("auto", [1, 1, 1]), ("lps", [1, 1, 1]), ("ras", LPS_RAS)):
            points = reading.read(path, ReadOptions(axes=axes, tip_mm=tuple(TIP))).points
            np.testing.assert_allclose(points, np.tile(PIVOT * factors, (len(poses), 1)), atol=1e-6)


def test_which_packages_bring_readers_is_looked_up_once(tmp_path, monkeypatch):
    """The look-up reads the metadata of every package that is installed: tens of milliseconds, for each file."""
    np.savetxt(tmp_path / "a.xyz", POINTS)
    clouds.load(tmp_path / "a.xyz", units="mm")
    monkeypatch.setattr(plugins, "entry_points", pytest.fail)
    clouds.load(tmp_path / "a.xyz", units="mm")


def test_a_reader_of_another_package_is_not_asked_for_axes_since_they_are_turned_once(tmp_path, monkeypatch):
    (tmp_path / "a.made").touch()
    asked = []
    reader = SimpleNamespace(read=lambda _, options: asked.append(options.axes) or Surface(POINTS), UNIT="mm")
    monkeypatch.setattr(plugins, "_entries", lambda: (SimpleNamespace(name="made", value="made", load=lambda: reader),))
    points = reading.read(tmp_path / "a.made", ReadOptions(axes="ras")).points
    np.testing.assert_allclose(points, POINTS * LPS_RAS)
    assert asked == ["auto"]


@pytest.mark.parametrize("gap", [0.033, 2.0])
def test_a_first_column_of_times_or_of_frames_with_gaps_is_no_x(tmp_path, gap):
    rng, rows = np.random.default_rng(0), 20
    table = np.column_stack([gap * np.arange(rows), rng.normal(0.0, 40.0, (rows, 3))])
    path = tmp_path / "a.csv"
    np.savetxt(path, table, delimiter=",", fmt="%.4f")
    with pytest.raises(InvalidPointCloudError, match="or their times.*begin with a line of names"):
        reading.read(path)
    np.savetxt(path, table, delimiter=",", fmt="%.4f", header="t,x,y,z", comments="")
    np.testing.assert_allclose(reading.read(path).points, table[:, 1:], atol=1e-3)
    np.savetxt(path, table[:11], delimiter=",", fmt="%.4f")  # so few rise by chance
    assert len(reading.read(path).points) == 11


@pytest.mark.parametrize("step", [1, -1])
def test_numbers_of_frames_with_several_points_each_are_no_x(tmp_path, step):
    rows = [f"{step * (k // 10)} {k * 0.7 % 9:.2f} {k * 1.3 % 7:.2f} {k * 2.1 % 5:.2f}" for k in range(40)]
    (tmp_path / "a.xyz").write_text("\n".join([*rows, ""]))
    with pytest.raises(InvalidPointCloudError, match="x y z in the first columns"):
        clouds.load(tmp_path / "a.xyz")
    grid = [f"{k // 10} {k % 10} {k * k % 7} {k * 2.1 % 5:.2f}" for k in range(40)]  # whole mm, and an intensity
    (tmp_path / "b.xyz").write_text("\n".join([*grid, ""]))
    np.testing.assert_allclose(clouds.load(tmp_path / "b.xyz").points[:2], [[0, 0, 0], [0, 1, 1]])
