"""Files that are packed, in another encoding, of another kind or not there: what is said of each, and what to do."""

import gzip
import json
import struct
import sys
from importlib.metadata import EntryPoint
from types import SimpleNamespace

import numpy as np
import pytest

from gapr_core.errors import InvalidPointCloudError, MethodUnavailableError
from gapr_core.formats import markups, plugins, poses, reading
from gapr_core.formats.options import ReadOptions
from gapr_core.surface import Surface

TEXT = b"x,y,z\n1,2,3\n"
NIFTI = struct.pack("<i", 348) + bytes(400)
FCSV = b"# CoordinateSystem = LPS\n# columns = id,x,y,z\n1,10,20,30\n"


def refusal(path, content, read=reading.read):
    path.write_bytes(content)
    with pytest.raises(InvalidPointCloudError) as caught:
        read(path)
    assert path.name in str(caught.value) and "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("name", [
    "tgt.stl.gz", "src.csv.gz", "seg.nrrd.gz", "tgt.stl", "src.csv", "src.xyz", "seg.nrrd", "seg.mha", "a.fcsv", "a.gz",
])  # fmt: skip
def test_what_gzip_packed_is_to_be_unpacked(tmp_path, name):
    said = refusal(tmp_path / name, gzip.compress(TEXT))
    assert f"a file that is not packed; got {name}, which is gzip-compressed; unpack it first (gunzip), or" in said


def test_markups_and_recordings_are_unpacked_first_as_well(tmp_path):
    said = refusal(tmp_path / "a.fcsv", gzip.compress(FCSV), markups.load)
    assert said.endswith("unpack it first (gunzip), or save it without compression")
    assert "unpack it first" in refusal(tmp_path / "probe.csv", gzip.compress(TEXT), poses.poses_in)


@pytest.mark.parametrize("order", "<>")
def test_nifti_under_the_other_of_its_two_names_is_to_be_renamed(tmp_path, order):
    content = struct.pack(f"{order}i", 348) + bytes(400)
    plain = "gzip-compressed NIfTI; got a.nii.gz, which is plain NIfTI; rename it to .nii"
    assert plain in refusal(tmp_path / "a.nii.gz", content)
    said = refusal(tmp_path / "a.nii", gzip.compress(content))
    assert said.endswith("a.nii, which is gzip-compressed; it is NIfTI: rename it to .nii.gz")


def test_a_gzip_file_that_is_cut_is_packed_even_so(tmp_path):
    assert "unpack it first" in refusal(tmp_path / "a.nii", gzip.compress(NIFTI)[:12])


@pytest.mark.parametrize("name", ["nowhere.csv", "nowhere.docx", "nowhere", "nowhere.stl.gz", "nowhere.mhd"])
def test_a_path_that_does_not_exist_is_said_not_to(tmp_path, name):
    with pytest.raises(InvalidPointCloudError, match=f"a file that exists; got .*{name}; check the path"):
        reading.read(tmp_path / name)


@pytest.mark.parametrize("name", ["seg.mhd", "seg.nhdr", "SEG.MHD"])
def test_a_header_without_its_voxels_is_to_be_saved_with_them(tmp_path, name):
    said = refusal(tmp_path / name, b"ObjectType = Image\nElementDataFile = other.raw\n")
    assert said.endswith(f"in one file; got {name}; save it as one file: .mha or .nrrd")


@pytest.fixture
def bags(monkeypatch):
    """A reader of bags, as a package that is installed brings it; what it is given."""
    given = []

    def read(path, options):
        given.append(path)
        return Surface(np.eye(3))

    monkeypatch.setitem(sys.modules, "reader_of_bags", SimpleNamespace(read=read, UNIT="m"))
    entries = [EntryPoint(name, "reader_of_bags", plugins.GROUP) for name in ("mcap", "metadata.yaml")]
    monkeypatch.setattr(plugins, "_entries", lambda: tuple(entries))
    return given


def test_the_file_that_makes_a_folder_a_bag_stands_for_it(tmp_path, bags, monkeypatch):
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information:\n")
    (tmp_path / "a.mcap").write_bytes(b"")
    monkeypatch.chdir(tmp_path)
    for path in (tmp_path, tmp_path / "metadata.yaml", "metadata.yaml", tmp_path / "a.mcap"):
        assert len(reading.read(type(tmp_path)(path)).points) == 3
    assert bags == [tmp_path, tmp_path, tmp_path, tmp_path / "a.mcap"]


def test_the_list_of_what_can_be_read_has_folders_and_the_names_of_files(tmp_path, bags):
    said = refusal(tmp_path / "a.docx", b"")
    assert " .igs.mha .mcap metadata.yaml or a folder; got a.docx" in said


def test_a_bag_that_cannot_be_read_here_is_called_a_bag(tmp_path, monkeypatch):
    entry = EntryPoint("metadata.yaml", "gapr_ros.not_installed", plugins.GROUP)
    monkeypatch.setattr(plugins, "_entries", lambda: (entry,))
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information:\n")
    with pytest.raises(MethodUnavailableError, match="^expected reading bags; got no gapr_ros.not_installed; pip ins"):
        reading.read(tmp_path)


def test_a_bag_is_turned_by_the_axes_that_are_named(tmp_path, bags):
    (tmp_path / "a.mcap").write_bytes(b"")
    for axes, factors in (("auto", [1, 1, 1]), ("ras", [-1, -1, 1])):
        points = reading.read(tmp_path / "a.mcap", ReadOptions(axes=axes)).points
        np.testing.assert_array_equal(points, np.eye(3) * factors)


@pytest.mark.parametrize("name", ["bone.stl", "seg.nii", "a.xyz", "p.mrk.json", "folder"])
def test_a_file_of_another_kind_is_no_recording_for_a_pivot(tmp_path, name):
    (tmp_path / "folder").mkdir()
    if name != "folder":
        (tmp_path / name).write_bytes(b"solid a\n")
    with pytest.raises(InvalidPointCloudError, match=rf"a recording by NDI Track .* or PLUS .*; got {name}; record"):
        poses.poses_in(tmp_path / name)


def test_a_name_is_said_once_and_a_dot_has_one(tmp_path, monkeypatch):
    said = refusal(tmp_path / "a.csv", b"State,Q0,Qx,Qy,Qz,Tx,Ty,Tz\nOK,1,0,0,0,1,2,3\n")
    assert said.count("a.csv") == 1
    (tmp_path / "folder" / "poses.txt").parent.mkdir()
    (tmp_path / "folder" / "poses.txt").write_text("1 2 3\n")
    monkeypatch.chdir(tmp_path / "folder")
    with pytest.raises(InvalidPointCloudError, match="got folder: poses.txt"):
        reading.read(type(tmp_path)())


@pytest.mark.parametrize("read", [reading.read, markups.load])
def test_markups_under_a_plain_json_name_are_to_be_renamed(tmp_path, read):
    said = refusal(tmp_path / "few.json", b'{"@schema": "x", "markups": []}', read)
    assert said.endswith("it looks like markups of 3D Slicer: rename it to few.mrk.json")
    assert "few.mrk.json" not in refusal(tmp_path / "few.json", b'{"points": []}', read)


POINT = {"position": [1.0, 2.0, 3.0]}


@pytest.mark.parametrize(("content", "said"), [
    ({"points": []}, "JSON without the list `markups`: save control points from 3D Slicer"),
    ([1, 2], "JSON without the list `markups`"), (3, "JSON without the list `markups`"),
    ({"markups": {"a": 1}}, "`markups` that is no list of objects"), ({"markups": [1]}, "`markups` that is no list"),
    ({"markups": [{"coordinateSystem": "LPS", "controlPoints": [7]}]}, "`controlPoints` that is no list of objects"),
    ({"markups": [{"coordinateSystem": "LPS", "controlPoints": [{}]}]}, "a position that is not x y z"),
    ({"markups": [{"coordinateSystem": "LPS", "controlPoints": [POINT, {"position": ["a", 1, 2]}]}]}, "a position"),
    ({"markups": [{"coordinateSystem": "LPS", "controlPoints": [{"position": [True, 1, 2]}]}]}, "a position"),
])  # fmt: skip
@pytest.mark.parametrize("read", [reading.read, markups.load])
def test_json_of_something_else_is_no_markups(tmp_path, content, said, read):
    assert f"a.mrk.json ({said}" in refusal(tmp_path / "a.mrk.json", json.dumps(content).encode(), read)


@pytest.mark.parametrize(("content", "said"), [
    (FCSV.replace(b"id,x,y,z", b"id,r,a,s"), "columns id r a s, not x y z"),
    (FCSV.replace(b",20,30", b""), "a row that ends before its x y z"),
])  # fmt: skip
def test_rows_and_names_of_an_fcsv_file_have_x_y_z(tmp_path, content, said):
    assert said in refusal(tmp_path / "a.fcsv", content)


@pytest.mark.parametrize(
    "row",
    [
        b"1,10,20,30,0,0,0,1,1,1,0,knee,left, upper,node",
        b"1,10,20,30,0,0,0,1,1,1,0,knee,,node,2",
        b"1,10,20,30,0,0,0,1,1,1,0,knee,,node,4,0",
        b"1,10,20,30,0,0,0,1,1,1,0,knee,a,b,c,node",
        b"1,1,5,2,5,3,0,0,0,1,1,1,0,knee,,",
        b"1,1,5,2,5,3,0,0,0,1,1,1,0,2,2,node",
    ],
)
def test_a_row_of_an_fcsv_file_with_more_cells_than_names_is_refused(tmp_path, row):
    head = b"# CoordinateSystem = LPS\n# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
    good = b"0,10,20,30,0,0,0,1,1,1,0,hip,,node,2,0\n"
    said = refusal(tmp_path / "a.fcsv", head + good + row + b"\n")
    assert f"a row of {row.count(b',') + 1} values under 14 names" in said
    assert "quote texts and numbers with a comma, and end no row with one" in said


PLY = "ply\nformat ascii 1.0\n{}end_header\n{}"
XYZ = "element vertex 1\nproperty float x\nproperty float y\nproperty float z\n"


@pytest.mark.parametrize(("header", "said"), [
    ("element point 1\nproperty float x\n", "elements point and no vertex: a mesh or cloud has one"),
    ("", "elements missing and no vertex"),
    (XYZ.replace("float z", "float w"), "vertices without z"),
    (XYZ + "element face 1\nproperty list uchar int corners\n", "faces without a list vertex_indices or vertex_index"),
    (XYZ + "element face 1\nproperty int vertex_index\n", "faces without a list vertex_indices or vertex_index"),
    (XYZ.replace("float z", "float16 z"), "'property float16 z' where a property of an element has a type (char, "),
    (XYZ.replace("vertex 1", "vertex many"), "'element vertex many' where an element has a name and a count"),
    (XYZ.replace("vertex 1", "vertex"), "'element vertex' where an element has a name and a count"),
    ("property float x\n" + XYZ, "'property float x' where a property of an element"),
    (XYZ.replace("float z", "z"), "'property z' where a property of an element"),
])  # fmt: skip
def test_what_a_ply_header_lacks_is_named(tmp_path, header, said):
    assert said in refusal(tmp_path / "a.ply", PLY.format(header, "1 2 3\n1 2 3\n").encode())


VTK = "# vtk DataFile Version 3.0\nbone\nASCII\nDATASET POLYDATA\n"
VTK_POINTS = "POINTS 3 float\n1 2 3 4 5 6 7 8 9\n"


@pytest.mark.parametrize(("content", "said"), [
    ("POINTS 3 float16\n1 2 3 4 5 6 7 8 9\n", "numbers of type float16, which are not read: save them as float or"),
    (f"{VTK_POINTS}FIELD FieldData 1\nused 1 3 bit\n1 0 1\n", "numbers of type bit, which are not read"),
    ("POINTS three float\n", "a line 'POINTS three float' without the counts or the type of its section"),
    ("POINTS 3\n", "a line 'POINTS 3' without the counts"),
    (f"{VTK_POINTS}POLYGONS 1\n", "a line 'POLYGONS 1' without"),
    (f"{VTK_POINTS}FIELD FieldData\n", "a line 'FIELD FieldData' without"),
    (f"{VTK_POINTS}FIELD FieldData 1\nused\n", "a line 'USED' without"),
    (f"{VTK_POINTS}POLYGONS 2 3\nOFFSETS\n", "a line 'OFFSETS' without"),
])  # fmt: skip
def test_what_is_not_read_of_a_vtk_file_is_named(tmp_path, content, said):
    assert said in refusal(tmp_path / "a.vtk", (VTK + content).encode())


PCD = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 1\n{}POINTS 2\nDATA ascii\n"
ROWS = "10 20 30\n-40 5 60\n"


@pytest.mark.parametrize(("wrong", "said"), [
    (("WIDTH 2", "WIDTH two"), "WIDTH 'two' in its header, which is no whole number from 0"),
    (("POINTS 2", "POINTS -2"), "POINTS '-2' in its header"),
    (("SIZE 4 4 4", "SIZE 4 four 4"), "a field y of type Ffour and count 1"),
    (("COUNT 1 1 1", "COUNT 1 1 one"), "a field z of type F4 and count one"),
])  # fmt: skip
def test_numbers_in_a_pcd_header_are_whole(tmp_path, wrong, said):
    assert said in refusal(tmp_path / "a.pcd", (PCD.format("").replace(*wrong) + ROWS).encode())


def test_types_in_a_pcd_header_may_be_in_small_letters(tmp_path):
    (tmp_path / "a.pcd").write_text(PCD.format("").replace("F F F", "f f f") + ROWS)
    np.testing.assert_allclose(reading.read(tmp_path / "a.pcd").points, [[10, 20, 30], [-40, 5, 60]])


@pytest.mark.parametrize(("viewpoint", "is_said"), [
    ("", False), ("VIEWPOINT 0 0 0 1 0 0 0\n", False), ("VIEWPOINT 0.0 -0 0 1.0 0 0 0\n", False),
    ("VIEWPOINT 0 0 5 1 0 0 0\n", True), ("VIEWPOINT 0 0 0 0 1 0 0\n", True), ("VIEWPOINT 0 0 0\n", True),
    ("VIEWPOINT here\n", True),
])  # fmt: skip
def test_a_viewpoint_that_moves_the_cloud_is_said_not_to_be_applied(tmp_path, caplog, viewpoint, is_said):
    (tmp_path / "a.pcd").write_text(PCD.format(viewpoint) + ROWS)
    np.testing.assert_allclose(reading.read(tmp_path / "a.pcd").points, [[10, 20, 30], [-40, 5, 60]])
    said = "a.pcd: VIEWPOINT is not applied: the pose is of the numbers in the file"
    assert (said in caplog.text) == is_said


def test_errors_of_python_are_no_reasons(tmp_path, monkeypatch):
    monkeypatch.setattr("gapr_core.formats.meshes.obj.read", lambda path, limits: {}["vertex"])
    said = refusal(tmp_path / "a.obj", b"v 0 0 0\n")
    assert "a.obj (its content is not laid out as the format wants it (KeyError)); export it again" in said


@pytest.mark.parametrize(("error", "said"), [
    (PermissionError(13, "Permission denied"), r"may be read; got a.xyz \(Permission denied\); let this user read it"),
    (MemoryError(), "fits into memory; got a.xyz; thin or crop it"),
])  # fmt: skip
def test_what_the_machine_refuses_is_no_damaged_file(tmp_path, monkeypatch, error, said):
    (tmp_path / "a.xyz").write_text("1 2 3\n")

    def refuse(*_):
        raise error

    monkeypatch.setattr(reading.Format, "read", refuse)
    with pytest.raises(InvalidPointCloudError, match=said):
        reading.read(tmp_path / "a.xyz")


def with_corner(faces, vertex):
    return np.where(np.arange(faces.size).reshape(-1, 3) == 121, vertex, faces)


@pytest.mark.parametrize(("points", "faces", "said"), [
    (lambda p: p, lambda f: f, ""),
    (lambda p: p, lambda f: f[(f != 500).all(axis=1)], ""),  # a hole
    (lambda p: p, lambda f: with_corner(f, f[4000, 0]), "1 of 14000 faces do not fit"),
    (lambda p: p, lambda f: with_corner(f, f[40, 0]), "1 of 14000 faces do not fit"),  # without area
    (lambda p: p + 60.0 * (np.arange(len(p)) == 100)[:, None], lambda f: f, "1 of 7002 vertices stick out"),
])  # fmt: skip
def test_a_mesh_with_a_damaged_face_or_vertex_is_warned_of(tmp_path, caplog, femur, points, faces, said):
    """One bit of a number moves a vertex or a corner, and no such file has a checksum."""
    np.savez(tmp_path / "bone.npz", points=points(femur.points), faces=faces(femur.faces))
    reading.read(tmp_path / "bone.npz")
    assert ("bone.npz may be damaged: " + said in caplog.text) == bool(said) == bool(caplog.text)


def test_faces_that_share_no_vertices_are_no_damage(tmp_path, caplog, femur):
    corners = femur.points[femur.faces].reshape(-1, 3)
    np.savez(tmp_path / "bone.npz", points=corners, faces=np.arange(len(corners)).reshape(-1, 3))
    reading.read(tmp_path / "bone.npz")
    assert not caplog.text


def test_polygons_of_two_corners_are_left_out_with_a_warning(tmp_path, caplog):
    """One damaged digit of an offset takes a corner from a polygon and gives it to the next."""
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 50 0 0\nv 0 50 0\nv 0 0 50\nf 1 2\nf 1 2 3\nf 1 3 4 2\n")
    assert len(reading.read(tmp_path / "a.obj").triangles) == 3
    assert "1 polygons of fewer than three corners" in caplog.text
