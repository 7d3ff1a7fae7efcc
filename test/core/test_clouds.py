import struct
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from gapr_core import Registrar, RegistrarConfig, clouds
from gapr_core.errors import InvalidPointCloudError
from gapr_core.registration.problem import target
from gapr_core.surface import Surface, as_points

VERTICES = np.array([[0, 0, 0], [40, 0, 0], [0, 30, 0], [0, 0, 20]], dtype=float)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def write_with_open3d(path, mesh):
    import open3d as o3d

    if not mesh:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(VERTICES))
        assert o3d.io.write_point_cloud(str(path), cloud)
        return
    triangles = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(VERTICES), o3d.utility.Vector3iVector(FACES))
    triangles.compute_triangle_normals()
    assert o3d.io.write_triangle_mesh(str(path), triangles)


def write_vtk(path, binary, faces=FACES):
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
    from vtkmodules.vtkIOLegacy import vtkPolyDataWriter
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    points, cells, poly = vtkPoints(), vtkCellArray(), vtkPolyData()
    points.SetData(numpy_to_vtk(VERTICES, deep=True))
    for face in faces:
        cells.InsertNextCell(3, face)
    poly.SetPoints(points)
    poly.SetPolys(cells)
    writer = vtkXMLPolyDataWriter() if path.suffix == ".vtp" else vtkPolyDataWriter()
    if path.suffix == ".vtk" and binary:
        writer.SetFileTypeToBinary()
    writer.SetFileName(str(path))
    writer.SetInputData(poly)
    assert writer.Write()


def same_corners(surface):
    return {tuple(p) for p in surface.points.round(4)} == {tuple(p) for p in VERTICES}


@pytest.mark.parametrize("name", ["bone.ply", "bone.stl", "bone.obj", "bone.vtk", "bone.vtp"])
def test_meshes_come_back_with_their_vertices_and_faces(tmp_path, name):
    if name.startswith("bone.vt"):
        write_vtk(tmp_path / name, binary=name == "bone.vtk")
    else:
        write_with_open3d(tmp_path / name, mesh=True)
    surface = clouds.load(tmp_path / name)
    assert same_corners(surface) and surface.faces.shape == (4, 3)
    assert surface.face_areas_mm2.sum() == pytest.approx(Surface(VERTICES, FACES).face_areas_mm2.sum(), rel=1e-5)


def test_polygons_of_a_ply_file_become_triangles(tmp_path):
    (tmp_path / "quad.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0\n100 0 0\n100 50 0\n0 50 0\n0 0 70\n4 0 1 2 3\n3 0 1 4\n"
    )
    surface = clouds.load(tmp_path / "quad.ply")
    np.testing.assert_array_equal(surface.faces, [[0, 1, 2], [0, 2, 3], [0, 1, 4]])
    assert surface.face_areas_mm2.sum() == pytest.approx(100 * 50 + 100 * 70 / 2)


@pytest.mark.parametrize("binary", [False, True])
def test_points_without_cells_are_a_cloud_where_the_file_says_its_end(tmp_path, binary):
    for name in ("cloud.vtp", "cloud.vtk"):
        write_vtk(tmp_path / name, binary, faces=())
    surface = clouds.load(tmp_path / "cloud.vtp")
    assert same_corners(surface) and surface.faces is None
    with pytest.raises(InvalidPointCloudError, match="4 points without a cell, as in a cut file; save a cloud as PLY"):
        clouds.load(tmp_path / "cloud.vtk")


@pytest.mark.parametrize("name", ["cloud.ply", "cloud.pcd"])
def test_clouds_come_back_without_faces(tmp_path, name):
    write_with_open3d(tmp_path / name, mesh=False)
    surface = clouds.load(tmp_path / name)
    assert same_corners(surface) and surface.faces is None


def test_numpy_files_are_read(tmp_path):
    np.save(tmp_path / "a.npy", VERTICES.astype(np.float32))
    np.savez(tmp_path / "a.npz", points=VERTICES, faces=FACES)
    assert same_corners(clouds.load(tmp_path / "a.npy"))
    assert clouds.load(tmp_path / "a.npz").faces.shape == (4, 3)


@pytest.mark.parametrize(("unit", "mm"), [("m", 1000.0), ("cm", 10.0)])
def test_units_become_millimetres(unit, mm):
    assert clouds.load(VERTICES / mm, units=unit).extent_mm == pytest.approx(Surface(VERTICES).extent_mm)


OF_UNIT_EXTENT = VERTICES / Surface(VERTICES).extent_mm
OPTIONS = r"\(--units cm; --source-units cm, of the source alone; model_unit of the node\)"


@pytest.mark.parametrize(("points", "unit", "said"), [
    (VERTICES / 1000.0, "mm", "it looks like m: pass units='m'"), (VERTICES, "m", "it looks like mm"),
    (VERTICES / 10.0, "mm", "looks like cm .* or in .*: pass units='cm', or convert it to mm$"),
    (OF_UNIT_EXTENT * 1.5, "mm", "it looks like m: pass units='m'"),  # or cm: scanners and ROS write m
    (OF_UNIT_EXTENT * 3.1, "mm", r"looks like cm \(31 mm across\) or in \(79 mm across\): pass"),
])  # fmt: skip
def test_a_cloud_in_another_unit_is_refused_with_its_likely_unit(tmp_path, points, unit, said):
    with pytest.raises(InvalidPointCloudError, match=said):
        clouds.load(points, units=unit)
    np.save(tmp_path / "a.npy", points)
    with pytest.raises(InvalidPointCloudError, match=said.replace("pass units='cm',", f"pass units='cm' {OPTIONS},")):
        clouds.load(tmp_path / "a.npy", units=unit)


def test_a_source_of_a_call_without_units_is_to_be_converted():
    search = Registrar(RegistrarConfig(num_threads=1))
    dense = np.random.default_rng(0).normal(size=(900, 3))
    prepared = search.prepare(dense * 60.0)
    with pytest.raises(InvalidPointCloudError, match="the source of .* read as mm; it looks like m: convert it to mm$"):
        search.register(dense * 0.06, prepared)


@pytest.mark.parametrize(("points", "said"), [
    ([[1.0, 2.0, 3.0]], "points on the surface of a bone; got a.xyz with 1 point; acquire more of it"),
    ([[1.0, 2.0, 3.0]] * 7, "points on the surface of a bone; got a.xyz with 7 points in one place; acquire more"),
    ([*VERTICES, [0.0, 9e3, 0.0]], "points of one bone; got a.xyz with 1 of its 5 points metres from the others; take"),
    (VERTICES * 1e3, "a bone or a piece of one, 10 to 2500 mm across; got a.xyz of .* check the file and its unit"),
])  # fmt: skip
@pytest.mark.parametrize("unit", ["mm", "cm"])
def test_points_that_no_unit_helps_are_not_blamed_on_the_unit(tmp_path, monkeypatch, points, said, unit):
    monkeypatch.chdir(tmp_path)
    np.savetxt("a.xyz", np.array(points) / clouds.MM_PER_UNIT[unit])
    with pytest.raises(InvalidPointCloudError, match=said):
        clouds.load("a.xyz", units=unit)


@pytest.mark.parametrize(("made", "said"), [
    (lambda o3d: o3d.geometry.PointCloud(), "got a PointCloud; pass its points: np.asarray"),
    (lambda o3d: o3d.geometry.TriangleMesh(), r"a TriangleMesh; of a mesh for `prepare`: Surface.from_open3d\("),
    (lambda o3d: SimpleNamespace(vertices=VERTICES, faces=FACES), r"Surface\(mesh.vertices, mesh.faces\)"),
    (lambda o3d: {"a": 1}, "shape .N, 3.; got a dict; pass x y z in columns"), (lambda o3d: None, "NoneType"),
])  # fmt: skip
def test_objects_of_other_libraries_are_named_with_what_to_pass_of_them(made, said):
    o3d = pytest.importorskip("open3d", reason="open3d is optional: pip install '.[data]'")
    with pytest.raises(InvalidPointCloudError, match=said):
        clouds.load(made(o3d))


def written(write, ending):
    """Make a file with another format's writer."""

    def made(folder):
        write(folder / f"written.{ending}")
        return (folder / f"written.{ending}").read_bytes()

    return made


DICOM = bytes(128) + b"DICM" + bytes(16)
BONE_STL = written(lambda path: write_with_open3d(path, mesh=True), "stl")
CUT_PLY = written(lambda path: write_with_open3d(path, mesh=True), "ply")
PLY = b"ply\nformat %s 1.0\nelement vertex %d\nproperty float x\nproperty float y\nproperty float z\n"


@pytest.mark.parametrize(("name", "content", "said"), [
    ("text.ply", b"this is not a bone\n", "text.ply"), ("text.vtp", b"<VTKFile>", "text.vtp"),
    ("text.vtk", b"no header", "text.vtk"), ("text.npz", b"PK nothing", "text.npz"),
    ("text.pcd", b"# .PCD\nVERSION 7\n", "text.pcd"),
    ("cut.ply", PLY % (b"binary_little_endian", 9) + b"end_header\n" + struct.pack("<5f", *range(5)), "cut.ply"),
    ("faces.ply", PLY % (b"ascii", 3) + b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
                  b"0 0 0\n100 0 0\n0 100 0\n3 0 1 9\n", "faces.ply"),
    *[(f"bone.{kind}", BONE_STL, rf"bone.{kind} .*looks like \.stl: rename it")
      for kind in ("ply", "vtp", "npz", "csv", "obj")],
    ("bone.stl", written(lambda path: np.save(path, VERTICES), "npy"), r"looks like \.npy: rename it"),
    ("bone.stl", written(lambda path: np.savez(path, points=VERTICES), "npz"), r"looks like \.npz: rename it"),
    ("bone.ply", lambda folder: CUT_PLY(folder)[:-9], "bone.ply .*export it again"),
    *[(f"bone.{kind}", b"", rf"bone\.{kind} \(0 bytes, an empty file\)")
      for kind in ("ply", "stl", "obj", "vtk", "vtp", "pcd", "npy", "npz", "csv", "txt", "xyz")],
    ("pc.npz", written(lambda path: np.savez(path, VERTICES), "npz"),
     r"points; got pc.npz: only arr_0; .*np\.savez\(file, points=P\)"),
    ("IM0001", DICOM, r"IM0001, a DICOM file; .* or a DICOM SEG as \.dcm"),
    ("none.dicom", b"", r"\.ply \.pcd"), ("none.ply", None, "a file that exists"),
])  # fmt: skip
def test_a_file_that_cannot_be_read_is_named_with_the_remedy(tmp_path, name, content, said):
    if content is not None:
        (tmp_path / name).write_bytes(content(tmp_path) if callable(content) else content)
    with pytest.raises(InvalidPointCloudError, match=said):
        clouds.load(tmp_path / name)


@pytest.mark.parametrize(("name", "content", "said"), [
    ("bone.stl", BONE_STL, "no slices .*; name a file in it"),
    ("1.dcm", lambda _: DICOM, r"a folder of DICOM files; .*segment the bone .*\.seg\.nrrd"),
    ("IM0001", lambda _: DICOM, r"a folder of DICOM files; .*segment the bone .*\.seg\.nrrd"),
])  # fmt: skip
def test_a_folder_without_slices_is_answered_with_what_to_load(tmp_path, name, content, said):
    (tmp_path / name).write_bytes(content(tmp_path))
    with pytest.raises(InvalidPointCloudError, match=said):
        clouds.load(tmp_path)


@pytest.mark.parametrize(("points", "unit"), [([[1.0, 2.0, 3.0]], "mm"), (VERTICES / 1e3, "mm"), (VERTICES, "m")])
def test_points_that_need_not_be_a_bone_may_have_any_size(points, unit):
    found = clouds.load(points, unit, of_bone=False).points
    np.testing.assert_allclose(found, np.array(points) * clouds.MM_PER_UNIT[unit])
    with pytest.raises(InvalidPointCloudError, match="units 'mm', 'cm', 'm', 'in' or 'auto'"):
        clouds.load(points, "inch", of_bone=False)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_rows_with_a_number_beyond_any_coordinate_are_dropped_as_they_are_by_a_registration():
    dirty = np.vstack([VERTICES, [[1e300, 0, 0], [0, -1e15, 0]]])
    np.testing.assert_array_equal(clouds.load(dirty).points, VERTICES)
    np.testing.assert_array_equal(clouds.finite_points(dirty), VERTICES)


@pytest.mark.parametrize(("extent", "unit", "said"), [
    (45.0, "mm", "45 mm across, read in mm, as small as a patella."), (59.0, "mm", "as small as a patella"),
    (61.0, "mm", ""), (690.0, "mm", ""), (710.0, "mm", "longer than any human bone"), (45.0, "cm", ""),
    (18.7, "mm", "this one has 187 mm in cm, 475 mm in inches"), (18.7, "in", ""),
    (18.7, "cm", "187 mm across, read in cm. A femur has 350 to 550 mm, a pelvis 250 to 350 mm; this one has 475 mm"),
])  # fmt: skip
def test_a_bone_from_a_file_is_warned_of_where_its_size_is_that_of_another_unit(tmp_path, caplog, extent, unit, said):
    """A bone in cm or inches and a source in the same, both read as mm, fit each other: only the size can show it."""
    points = np.random.default_rng(0).normal(size=(400, 3))
    np.save(tmp_path / "bone.npy", points * extent / Surface(points).extent_mm)
    found = clouds.odd_size(clouds.load(clouds.load(tmp_path / "bone.npy", unit)))
    assert said in str(found or "") and (found is None) == (said == "")
    target.prepare(tmp_path / "bone.npy", unit)
    assert ("bone.npy: The bone is" in caplog.text) == bool(said)
    assert clouds.odd_size(clouds.load(np.load(tmp_path / "bone.npy"), unit)) is None, "arrays come from programs"


def test_auto_guesses_the_unit_and_warns(caplog):
    assert clouds.load(VERTICES / 1000.0, units="auto").extent_mm == pytest.approx(Surface(VERTICES).extent_mm)
    assert "taken to be in m" in caplog.text


@pytest.mark.parametrize(("given", "said"), [
    *[(points, "shape") for points in (np.zeros((4, 2)), np.zeros(3))],
    (np.zeros((2, 3, 3)), "none finite"), (np.array([["a", "b", "c"]]), "expected"),
    *[(rows, "shape") for rows in (
        [[1.0, 2.0, 3.0], [1.0, 2.0]], [[1.0, 2.0, 3.0], 4.0], [np.zeros((2, 3)), [1.0]],
    )],
    *[(Surface(points), r"\(N, 3\)") for points in (
        VERTICES.ravel(), VERTICES[:, :2], VERTICES.astype(object), VERTICES * 1j,
    )],
    (np.full((5, 3), np.nan), "none finite"),
    (Surface(np.vstack([VERTICES, [0.0, 9e3, 0.0]]), FACES), "1 of its 5 points metres from the others; take"),
    (Surface([*VERTICES.tolist(), [np.nan, 0, 0]], None, [[0, 0, 1]] * 4),
     "a normal for each point; got 4 normals of 5 points; leave"),
])  # fmt: skip
def test_points_that_cannot_be_are_refused(given, said):
    with pytest.raises(InvalidPointCloudError, match=said):
        clouds.load(given)


@pytest.mark.parametrize(
    ("given", "how"),
    [(Surface(np.zeros((5, 3))), "pass its points"), ("a.ply", "load it first"), (Path("a.ply"), "load it first")],
)
def test_what_is_no_array_is_answered_with_how_to_make_one(given, how):
    with pytest.raises(InvalidPointCloudError, match=how):
        as_points(given)


def test_rows_that_are_not_finite_are_dropped_with_a_warning(caplog):
    dirty = np.vstack([VERTICES, [[np.nan, 0, 0], [np.inf, 0, 0]]])
    assert len(clouds.load(dirty).points) == 4
    assert "array: 2 of 6 points are not finite: left out" in caplog.text


def test_normals_of_a_surface_may_be_a_list():
    surface = clouds.load(Surface([*VERTICES.tolist(), [np.nan, 0, 0]], None, [[0, 0, 1]] * 5))
    assert len(surface.points) == 4 and np.array_equal(surface.normals, [[0, 0, 1]] * 4)


def test_masked_rows_are_missing():
    points = np.random.default_rng(0).normal(size=(40, 3)) * 30.0
    mask = np.zeros((40, 3), bool)
    mask[::2], mask[1, 0] = True, True
    kept = clouds.load(np.ma.masked_array(points, mask)).points
    np.testing.assert_array_equal(kept, points[3::2])
    whole = np.ma.masked_array((points * 10).astype(int), mask)
    np.testing.assert_array_equal(clouds.load(whole).points, (points * 10).astype(int)[3::2])


def test_a_tensor_is_taken_without_its_gradient():
    torch = pytest.importorskip("torch", reason="tensors: pip install torch")
    points = np.random.default_rng(0).normal(size=(40, 3)) * 30.0
    np.testing.assert_array_equal(clouds.load(torch.tensor(points, requires_grad=True)).points, points)


def test_points_are_drawn_uniformly_in_area_on_the_faces():
    surface = Surface(VERTICES, FACES)
    points, normals = surface.sample(20_000, np.random.default_rng(0))
    on_floor = np.isclose(points[:, 2], 0.0) & np.isclose(np.abs(normals[:, 2]), 1.0)
    share = surface.face_areas_mm2[0] / surface.face_areas_mm2.sum()
    assert on_floor.mean() == pytest.approx(share, abs=0.01)


def test_a_mesh_goes_to_open3d_and_comes_back():
    again = Surface.from_open3d(Surface(VERTICES, FACES).to_open3d())
    assert np.array_equal(again.points, VERTICES) and np.array_equal(again.faces, FACES)


@pytest.mark.parametrize(("call", "surface", "said"), [
    (Surface.to_open3d, Surface(VERTICES), "triangle mesh"), (Surface.mirrored, Surface(VERTICES), "triangle mesh"),
    (lambda mesh: mesh.sample(5, np.random.default_rng(0)), Surface(VERTICES), "triangle mesh"),
    (lambda mesh: mesh.sample(5, np.random.default_rng(0)), Surface(np.zeros((3, 3)), np.array([[0, 1, 2]])), "area"),
])  # fmt: skip
def test_a_surface_without_faces_or_area_is_no_mesh(call, surface, said):
    with pytest.raises(InvalidPointCloudError, match=said):
        call(surface)


def test_a_mirrored_mesh_is_still_wound_outward():
    from gapr_core.data.solid import volume_mm3

    mesh = Surface(VERTICES, FACES, VERTICES)
    assert volume_mm3(mesh.mirrored()) == pytest.approx(volume_mm3(mesh)) and volume_mm3(mesh) > 0.0
    assert np.array_equal(mesh.mirrored().points, VERTICES * [-1.0, 1.0, 1.0])
    assert np.array_equal(mesh.mirrored().normals, mesh.mirrored().points)


def test_lists_in_a_surface_are_taken_as_arrays():
    loaded = clouds.load(Surface((30.0 * VERTICES).tolist(), FACES.tolist()))
    np.testing.assert_array_equal(loaded.points, 30.0 * VERTICES)
    np.testing.assert_array_equal(loaded.triangles, FACES)


@pytest.mark.parametrize(("faces", "text"), [
    (FACES.ravel(), "triangles"), (np.tile([[0, 1, 2, 3]], (2, 1)), "triangles"),
    (FACES + 100, "beyond"), (np.zeros((4, 3), dtype=np.int64), "area"),
])  # fmt: skip
def test_faces_that_make_no_surface_are_refused(tmp_path, faces, text):
    np.savez(tmp_path / "a.npz", points=VERTICES, faces=faces)
    for source in (tmp_path / "a.npz", Surface(VERTICES, faces)):
        with pytest.raises(InvalidPointCloudError, match=text):
            clouds.load(source)


def test_areas_and_samples_of_a_mesh_follow_its_triangles():
    surface = Surface(VERTICES, FACES)
    a, b, c = (VERTICES[FACES[:, i]] for i in range(3))
    across = np.cross(b - a, c - a)
    areas = 0.5 * np.linalg.norm(across, axis=1)
    np.testing.assert_allclose(surface.face_areas_mm2, areas, rtol=1e-15)
    points, normals = surface.sample(20_000, np.random.default_rng(0))
    face = np.abs(normals[:, None] - across / (2.0 * areas[:, None])).sum(axis=2).argmin(axis=1)
    np.testing.assert_allclose(normals, across[face] / (2.0 * areas[face, None]), atol=1e-15)
    assert np.abs(np.einsum("ni,ni->n", points - a[face], normals)).max() < 1e-12
    assert np.bincount(face) / 20_000 == pytest.approx(areas / areas.sum(), abs=0.01)


def test_a_triangle_without_a_vertex_is_an_error_and_no_area():
    with pytest.raises(IndexError):
        Surface(VERTICES, np.array([[0, 1, 2], [0, 1, 4]])).face_areas_mm2  # noqa: B018


def test_samples_of_a_mesh_are_those_of_a_choice_by_area_bit_by_bit():
    """What was drawn with a seed, pairs and targets that models were fitted to, stays as it was."""
    made = np.random.default_rng(3)
    surface = Surface(made.normal(size=(50, 3)), np.stack([made.permutation(50)[:3] for _ in range(90)]))
    for count in (1, 7, 5000):
        rng = np.random.default_rng(count)
        corners = surface.points[surface.triangles]
        crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = np.linalg.norm(crosses, axis=1)
        face, (u, v) = rng.choice(90, size=count, p=areas / areas.sum()), rng.random((2, count, 1))
        u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
        a, b, c = (corners[face, i] for i in range(3))
        points, normals = surface.sample(count, np.random.default_rng(count))
        assert (points == a + u * (b - a) + v * (c - a)).all()
        np.testing.assert_allclose(normals, crosses[face] / areas[face, None], atol=1e-12)
