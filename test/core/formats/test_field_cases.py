"""Files as other programs write them: read as they are meant, or refused with the true reason."""

import logging
import re

import numpy as np
import pytest
from mesh_samples import body, samples
from scipy.spatial.transform import Rotation

from gapr_core import clouds
from gapr_core.errors import InvalidPointCloudError
from gapr_core.formats import reading
from gapr_core.formats.options import ReadOptions
from gapr_core.formats.poses import poses_in
from gapr_core.geometry import se3

POINTS, FACES = body()
LIST = "property list uchar int vertex_indices"
TIP = (0.1, -0.3, 150.0)


def rows(points):
    return "".join("{:.4f} {:.4f} {:.4f}\n".format(*point) for point in points)


def obj_interleaved(path):
    """Each triangle after its own vertices, counted from the last one (trimesh, issue 2364)."""
    facets = "".join("".join("v {} {} {}\n".format(*POINTS[i]) for i in face) + "f -3 -2 -1\n" for face in FACES)
    path.write_text(facets)


def ply_range_grid(path, end="\n"):
    """Which pixel each point is (Stanford; PCL, issue 1059)."""
    grid = "".join(f"1 {i}{end}0{end}" for i in range(len(POINTS)))
    head = ["ply", "format ascii 1.0", f"element vertex {len(POINTS)}", *(f"property float {a}" for a in "xyz"),
            f"element range_grid {2 * len(POINTS)}", LIST, "end_header", ""]  # fmt: skip
    path.write_bytes((end.join(head) + rows(POINTS).replace("\n", end) + grid).encode())


def ply_tristrips(path):
    """One list of strips with -1 between them (miniply, issue 1)."""
    strips = " ".join(f"{a} {b} {c} -1" for a, b, c in FACES)
    head = ["ply", "format ascii 1.0", f"element vertex {len(POINTS)}", *(f"property float {a}" for a in "xyz"),
            "element tristrips 1", "property list int int vertex_indices", "end_header", ""]  # fmt: skip
    path.write_text("\n".join(head) + rows(POINTS) + f"{4 * len(FACES)} {strips}\n")


def pts(path):
    """Leica's count, then x y z intensity r g b (Open3D, issue 1384)."""
    path.write_text(f"{len(POINTS)}\n" + rows(POINTS).replace("\n", " 17 3 4 5\n"))


def image(path):
    """(H, W, 3) of a camera, 0 0 0 where it sees nothing (Zivid)."""
    pixels = np.zeros((len(POINTS), 2, 3), dtype=np.float32)
    pixels[:, 1] = POINTS
    np.save(path, pixels)


def structured(path):
    """As `read_points` of sensor_msgs_py gives them."""
    array = np.zeros(len(POINTS), dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "u2")])
    array["x"], array["y"], array["z"] = POINTS.T
    np.save(path, array)


def not_a_number(path):
    """As the C library of Windows prints a point that was not seen."""
    path.write_text("x y z\n" + rows(POINTS) + "-nan(ind) 1.#QNAN -1.#IND00\n")


def transposed(path):
    np.save(path, POINTS.T)


def pointer_poses():
    """(N, 4, 4) of a pointer whose tip is on the body."""
    turns = Rotation.from_rotvec(np.random.default_rng(0).normal(0.0, 0.5, (len(POINTS), 3))).as_matrix()
    return se3.from_rotation_translation(turns, POINTS - turns @ TIP)


def poses(path):
    """NaN where the pointer was not visible (scikit-surgerynditracker, issue 67)."""
    np.save(path, np.concatenate([pointer_poses(), np.full((5, 4, 4), np.nan)]))


def sheared_poses(path):
    found = pointer_poses()
    found[3, 0, 0] += 0.5
    np.save(path, found)


def csv_of_arrays(path):
    path.write_text('1,np.float64(2.5),"array([[1., 0.],\n[0., 1.]])"\n')


CASES = {  # file -> its writer, and what its error says
    "a.obj": (obj_interleaved, ""), "a.ply": (ply_range_grid, ""), "strips.ply": (ply_tristrips, ""),
    "a.pts": (pts, ""), "image.npy": (image, ""), "structured.npy": (structured, ""), "a.xyz": (not_a_number, ""),
    "tip.npy": (poses, ""),
    "transposed.npy": (transposed, r"shape (N, 3); got transposed.npy: shape (3, 86); pass its transpose"),
    "tip_sheared.npy": (sheared_poses, "pose 3 whose"),
    "tip.csv": (csv_of_arrays, "a recording by NDI Track (.csv) or PLUS (.igs.mha), or poses (N, 4, 4) as .npy"),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_what_other_programs_write_is_read_or_refused_for_its_true_reason(tmp_path, caplog, name):
    writer, refusal = CASES[name]
    writer(tmp_path / name)
    how = ReadOptions(tip_mm=TIP if name.startswith("tip") else None)
    if refusal:
        with pytest.raises(InvalidPointCloudError, match=re.escape(refusal)):
            clouds.load(tmp_path / name, options=how)
        return
    with caplog.at_level(logging.WARNING):
        surface = clouds.load(tmp_path / name, options=how)
    corners = surface.points if surface.faces is None else surface.points[np.unique(surface.faces)]
    np.testing.assert_allclose(np.unique(corners.round(2), axis=0), np.unique(POINTS.astype(float).round(2), axis=0))
    assert surface.faces is None or len(surface.faces) == len(FACES)
    assert not [said for said in caplog.messages if "not finite" not in said]


def test_line_ends_of_windows_in_a_range_grid(tmp_path):
    ply_range_grid(tmp_path / "a.ply", "\r\n")
    assert len(clouds.load(tmp_path / "a.ply").points) == len(POINTS)


def test_a_pivot_is_found_of_an_array_of_poses(tmp_path):
    poses(tmp_path / "a.npy")
    assert poses_in(tmp_path / "a.npy").shape == (len(POINTS), 4, 4)


def test_poses_without_a_tip_and_an_archive_are_called_so(tmp_path):
    poses(tmp_path / "a.npy")
    with pytest.raises(InvalidPointCloudError, match="the tip of the tool"):
        clouds.load(tmp_path / "a.npy")
    np.savez(tmp_path / "a.npz", points=POINTS)
    with pytest.raises(InvalidPointCloudError, match="an NPZ archive; pass its path"):
        clouds.load(np.load(tmp_path / "a.npz"))


@pytest.mark.parametrize("name", ["mesh.obj", "text.ply", "binary.ply", "faces.npz", "text42.vtk", "ascii-none.vtp"])
def test_a_face_beyond_the_vertices_is_found_as_the_file_is_read(tmp_path, name):
    faces = FACES.copy()
    faces[5, 1] = len(POINTS) + 3
    from mesh_samples import _npz, _obj, _ply, _vtk

    made = {"mesh.obj": _obj(POINTS, faces), "faces.npz": _npz(points=POINTS, faces=faces)}
    made |= _ply(POINTS, faces) | _vtk(POINTS, faces)
    (tmp_path / name).write_bytes(made[name])
    with pytest.raises(InvalidPointCloudError, match=f"faces of its {len(POINTS)} vertices"):
        reading.read(tmp_path / name)


@pytest.mark.parametrize("name", ["appended-zlib.vtp", "appended-lzma.vtp"])
def test_no_damaged_byte_of_a_packed_vtp_passes(tmp_path, name):
    """The checksum stands behind the data, and counts only once the stream has come to its end."""
    path, data = tmp_path / name, samples()[name]
    start, passed = data.index(b">_") + 2 if b">_" in data else data.index(b"_", data.index(b"<AppendedData")), 0
    whole = _read(path, data)
    for at in np.random.default_rng(0).integers(start, data.rindex(b"</AppendedData"), 200):
        try:
            found = _read(path, data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
        except InvalidPointCloudError:
            continue
        passed += 1
        np.testing.assert_array_equal(found.points, whole.points)
        np.testing.assert_array_equal(found.triangles, whole.triangles)
    assert passed < 100


def _read(path, data):
    path.write_bytes(data)
    return reading.read(path)
