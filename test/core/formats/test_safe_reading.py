"""What damaged files did to the process once: it died, took memory as points, or asked for gigabytes."""

import io
import mmap
import os
import resource
import struct
import subprocess
import sys
import threading
import tracemalloc
import zipfile
import zlib

import numpy as np
import pytest

from gapr_core import clouds
from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_core.formats.limits import FileLimits
from gapr_core.formats.options import ReadOptions
from gapr_core.registration.problem.target import prepare

PCD = "VERSION .7\nFIELDS {}\nSIZE {}\nTYPE {}\nCOUNT {}\nWIDTH {n}\nHEIGHT 1\nPOINTS {n}\nDATA {how}\n"
XYZ = ("x y z", "4 4 4", "F F F", "1 1 1")
CORNERS = np.array([[0, 0, 0], [40, 0, 0], [0, 30, 0], [0, 0, 20]], dtype=np.float32)
TETRAHEDRON = "0 0 0 40 0 0 0 30 0 0 0 20\n"


def refusal(path, content):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InvalidPointCloudError) as caught:
        clouds.load(path)
    assert path.name in str(caught.value) and "\n" not in str(caught.value)
    return str(caught.value)


def test_normals_of_a_pcd_with_a_component_missing_are_left_out(tmp_path):
    fields = ("x y z normal_x foo normal_z", "4 4 4 4 4 4", "F F F F F F", "1 1 1 1 1 1")
    rows = np.hstack([CORNERS, np.ones((4, 3), dtype=np.float32)])
    (tmp_path / "a.pcd").write_bytes(PCD.format(*fields, n=4, how="binary").encode() + rows.tobytes())
    surface = clouds.load(tmp_path / "a.pcd")
    assert surface.normals is None and np.array_equal(surface.points, CORNERS)


VTK = "# vtk DataFile Version 3.0\nbone\n{}\nDATASET POLYDATA\nPOINTS 4 float\n"
OBJ = "v 0 0 0\nv 40 0 0\nv 0 30 0\n"
FACET = "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 40 0 0\n{}endloop\nendfacet\n{}"
PLY = (
    "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
    "element face {}\nproperty list uchar int vertex_indices\nend_header\n"
)


def vtp(points=4, polys=2, corners="0 1 2 1 2 3", ends="3 6"):
    return (
        '<VTKFile type="PolyData"><PolyData>'
        f'<Piece NumberOfPoints="{points}" NumberOfVerts="0" NumberOfPolys="{polys}">'
        f'<Points><DataArray type="Float32" NumberOfComponents="3" format="ascii">{TETRAHEDRON}</DataArray></Points>'
        f'<Polys><DataArray type="Int64" Name="connectivity" format="ascii">{corners}</DataArray>'
        f'<DataArray type="Int64" Name="offsets" format="ascii">{ends}</DataArray></Polys>'
        "</Piece></PolyData></VTKFile>\n"
    )


BOMB = '<!DOCTYPE a [<!ENTITY b "lol"><!ENTITY c "&b;&b;&b;&b;">]>'
CUT = [
    *[("a.pcd", PCD.format(*XYZ, n=4, how="ascii") + lines, "")  # short lines and missing points
      for lines in ("0 0 0\n40 0 0\n0 30\n0 0 20\n", "0 0 0\n40 0 0\n", "0 0 0\n40 0 0\n0 30 0\n0 0 2")],
    *[("a.pcd", PCD.format(*XYZ, n=4, how="binary").encode() + (CORNERS.tobytes() + b"x")[:length], "48")
      for length in (47, 36, 49)],
    *[("a.vtk", VTK.format("ASCII") + TETRAHEDRON + f"POLYGONS {polygons}", "") for polygons in (
        "4 5\n4 0 1 2 9\n", "1 5\n4 0 1 2 900000000\n", "1 5\n900 0 1 2 3\n", "1 5\n-4 0 1 2 3\n",
        "1000000000000 5\n4 0 1 2 3\n", "1 5000000000000\n4 0 1 2 3\n",
    )],
    ("a.vtk", VTK.format("BINARY").encode() + CORNERS.astype(">f4").tobytes()[:-1], ""),
    ("a.vtk", VTK.format("ASCII") + "0 0 0 40 0 0 0 30\n", ""),
    ("a.vtk", VTK.format("BINARY").encode() + CORNERS.astype(">f4").tobytes() + b"\n", ""),
    *[("a.vtp", content, "") for content in (
        vtp(points=1000000000000), vtp(corners="0 1 2 1 2 9"), vtp(corners="0 1 2 1 2 -3"), vtp(ends="3 900"),
        vtp(ends="6 3"), vtp(polys=10**12), vtp(points=-4), vtp(corners="0 1 2"),
    )],
    ("a.vtp", BOMB + vtp(), "document types"),
    *[("a.obj", content, "") for content in (
        f"{OBJ}f 1 2 3", f"{OBJ}v 0 0 20\n", f"{OBJ}v 0 0 20\nf 1 2 3\n", f"{OBJ}f 1 2 7\n", f"{OBJ}f 1 2 -9\n",
        f"{OBJ}f 1 2 3 \\\n", f"# number of vertices: 3\n# number of triangles: 2\n{OBJ}f 1 2 3\n",
        "v 0 0 0\nv 40 0\nv 0 30 0\nf 1 2 3\n",
    )],
    *[("a.stl", FACET.format(*parts), "")
      for parts in (("vertex 0 30 0\n", ""), ("", "endsolid a\n"), ("vertex 0 30\n", "endsolid\n"))],
    ("a.stl", bytes(80) + struct.pack("<I", 4_000_000_000) + bytes(50), ""),
    *[("a.ply", PLY.format(*counts).encode() + CORNERS.tobytes() + bytes(13), "")  # nothing is reserved for it
      for counts in ((10**9, 1), (10**7, 1), (4, 10**7))],
]  # fmt: skip


@pytest.mark.parametrize(("name", "content", "said"), CUT)
def test_a_file_that_ends_too_early_or_announces_too_much_is_refused(tmp_path, name, content, said):
    assert said in refusal(tmp_path / name, content)


def test_a_whole_vtp_file_is_read(tmp_path):
    (tmp_path / "good.vtp").write_text(vtp())
    assert clouds.load(tmp_path / "good.vtp").faces.tolist() == [[0, 1, 2], [1, 2, 3]]


def test_a_compressed_pcd_may_refer_back_and_never_before_its_beginning(tmp_path):
    head = PCD.format(*XYZ, n=4, how="binary_compressed").encode()
    planes = np.repeat(np.array([[10.0], [20.0], [30.0]], dtype="<f4"), 4, axis=1)
    planes[:, 0] = 0.0
    literal = planes.tobytes()
    packed = b"".join(bytes([3]) + bytes(4) + bytes([3]) + plane[4:8] + bytes([6 << 5, 3])
                      for plane in (literal[:16], literal[16:32], literal[32:]))  # fmt: skip
    (tmp_path / "a.pcd").write_bytes(head + struct.pack("<II", len(packed), 48) + packed)
    assert np.array_equal(clouds.load(tmp_path / "a.pcd").points.astype("<f4"), planes.T)
    broken = bytes([6 << 5, 3]) + packed[2:]
    refusal(tmp_path / "b.pcd", head + struct.pack("<II", len(broken), 48) + broken)


def npz(**members):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return file.getvalue()


def npy_header(shape):
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return file.getvalue()


def test_an_npz_that_unpacks_to_gigabytes_is_refused_before_it_is_unpacked(tmp_path):
    (tmp_path / "a.npz").write_bytes(npz(points=npy_header((1_500_000, 3)) + bytes(36_000_000)))
    with pytest.raises(InvalidPointCloudError, match="at most 20 MB of unpacked.* 34 MB.*MAX_UNPACKED"):
        clouds.load(tmp_path / "a.npz", options=ReadOptions(limits=FileLimits(unpacked_mb=20.0)))


@pytest.mark.parametrize("shape", [(10**12, 3), (5, 3), (3, 3), (-4, 3), (-4, -3)])
def test_an_array_has_exactly_the_numbers_that_its_header_announces(tmp_path, shape):
    content = npy_header(shape) + bytes(96)
    for path, data in ((tmp_path / "a.npy", content), (tmp_path / "a.npz", npz(points=content))):
        path.write_bytes(data)
        with pytest.raises(InvalidPointCloudError):
            clouds.load(path)


def test_objects_in_arrays_are_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.array([{}, {}, {}], dtype=object), allow_pickle=True)
    assert "objects" in refusal(tmp_path / "a.npy", (tmp_path / "a.npy").read_bytes())


@pytest.mark.parametrize(
    "limits", [FileLimits(file_mb=0.0001), FileLimits(unpacked_mb=0.00001), FileLimits(vertices=3)]
)
def test_each_limit_refuses_by_itself_and_says_how_to_raise_it(tmp_path, limits):
    np.save(tmp_path / "a.npy", np.vstack([CORNERS] * 3))
    assert len(clouds.load(tmp_path / "a.npy").points) == 12
    with pytest.raises(InvalidPointCloudError, match="at most .* raise GAPR_MAX_"):
        clouds.load(tmp_path / "a.npy", options=ReadOptions(limits=limits))


def test_limits_come_from_the_environment(tmp_path, monkeypatch):
    np.save(tmp_path / "a.npy", CORNERS)
    monkeypatch.setenv("GAPR_MAX_VERTICES", "3")
    with pytest.raises(InvalidPointCloudError, match="at most 3 points"):
        clouds.load(tmp_path / "a.npy")
    monkeypatch.setenv("GAPR_MAX_VERTICES", "many")
    with pytest.raises(ConfigError, match="GAPR_MAX_VERTICES"):
        clouds.load(tmp_path / "a.npy")


def test_a_pipe_is_read_to_its_end(tmp_path):
    """It has no size; once one byte of it was taken for the whole file."""
    os.mkfifo(tmp_path / "a.xyz")
    writer = threading.Thread(target=(tmp_path / "a.xyz").write_bytes, args=(TETRAHEDRON.encode(),))
    writer.start()
    try:
        assert FileLimits().read(tmp_path / "a.xyz") == TETRAHEDRON.encode()
    finally:
        writer.join()


def test_reading_takes_memory_for_the_file_and_not_for_the_limit(tmp_path):
    (tmp_path / "a.xyz").write_bytes(TETRAHEDRON.encode())
    tracemalloc.start()
    try:
        assert FileLimits(file_mb=64.0).read(tmp_path / "a.xyz") == TETRAHEDRON.encode()
        assert tracemalloc.get_traced_memory()[1] < 1e6
    finally:
        tracemalloc.stop()


def ply_of(rows, faces, how="binary_little_endian", comment=""):
    """A PLY file of CORNERS with the bytes of so many faces."""
    head = (
        f"ply\nformat {how} 1.0\ncomment {comment}\nelement vertex 4\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    return head.encode() + CORNERS.astype("<f4" if "little" in how else ">f4").tobytes() + rows


@pytest.mark.parametrize("order", ["little", "big"])
def test_triangles_and_other_polygons_of_a_binary_ply_are_the_same_faces(tmp_path, order):
    def row(*corners):
        return struct.pack(f"{'<' if order == 'little' else '>'}B{len(corners)}i", len(corners), *corners)

    triangles, quad = row(0, 1, 2) + row(0, 2, 3), row(0, 1, 2, 3)
    (tmp_path / "a.ply").write_bytes(ply_of(triangles, 2, f"binary_{order}_endian"))
    (tmp_path / "b.ply").write_bytes(ply_of(quad, 1, f"binary_{order}_endian"))
    (tmp_path / "c.ply").write_bytes(ply_of(row(0, 1, 2) + quad, 2, f"binary_{order}_endian"))
    a, b, c = (clouds.load(tmp_path / f"{name}.ply") for name in "abc")
    assert np.array_equal(a.points, CORNERS) and a.faces.tolist() == b.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert c.faces.tolist() == [[0, 1, 2], [0, 1, 2], [0, 2, 3]]
    assert all(surface.points.flags.owndata and surface.faces.flags.writeable for surface in (a, b, c))


def test_a_ply_without_faces_that_ends_with_a_page_is_a_cloud(tmp_path):
    missing = -len(ply_of(b"", 0)) % mmap.ALLOCATIONGRANULARITY
    data = ply_of(b"", 0, comment="x" * missing)
    assert len(data) % mmap.ALLOCATIONGRANULARITY == 0
    (tmp_path / "a.ply").write_bytes(data)
    assert np.array_equal(clouds.load(tmp_path / "a.ply").points, CORNERS)


MEMORY = """
import resource, sys
import numpy, numba, plyfile
from gapr_core import clouds
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
surface = clouds.load(sys.argv[1])
unpacked = surface.points.nbytes + (0 if surface.faces is None else surface.faces.nbytes)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024, unpacked)
"""


def grid(n):
    """(n^2, 3) points and (2 (n - 1)^2, 3) faces of a square of 100 mm."""
    x, y = np.meshgrid(np.linspace(0, 100, n), np.linspace(0, 100, n))
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1, 1)
    points = np.stack([x.ravel(), y.ravel(), np.sin(x.ravel())], axis=1).astype("<f4")
    return points, np.vstack([i + [0, 1, n], i + [1, n + 1, n]])


def large(kind):
    points, faces = grid(300)
    rows = "".join("{} {} {}\n".format(*p) for p in points)
    if kind == "stl":
        facets = np.zeros(len(faces), dtype=np.dtype("12<f4,<u2"))
        facets["f0"][:, 3:] = points[faces].reshape(-1, 9)
        return bytes(80) + struct.pack("<I", len(faces)) + facets.tobytes()
    if kind == "obj":
        vertices = "".join("v {} {} {}\n".format(*p) for p in points)
        return (vertices + "".join("f {} {} {}\n".format(*f) for f in faces + 1)).encode()
    if kind == "pcd":
        return (
            PCD.format(*XYZ, n=len(points), how="ascii") + "".join("{} {} {}\n".format(*p) for p in points)
        ).encode()
    quads = np.column_stack([faces[: len(faces) // 2], faces[: len(faces) // 2, :1] + 301])
    return (
        f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(quads)}\nproperty list uchar int vertex_indices\nend_header\n"
        + rows + "".join("4 {} {} {} {}\n".format(*q) for q in quads)
    ).encode()  # fmt: skip


@pytest.mark.parametrize("kind", ["stl", "pcd", *(pytest.param(k, marks=pytest.mark.slow) for k in ("obj", "ply"))])
def test_a_load_takes_at_most_20_times_the_unpacked_data_and_200_mb(tmp_path, kind):
    (tmp_path / f"a.{kind}").write_bytes(large(kind))
    command = [sys.executable, "-c", MEMORY, str(tmp_path / f"a.{kind}")]
    taken, unpacked = map(int, subprocess.run(command, capture_output=True, text=True, check=True).stdout.split())
    assert 2e6 < unpacked and taken < 20 * unpacked + 200e6


def test_points_in_pairs_need_no_finer_buffer_than_the_bone(tmp_path):
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(2250, 3))
    ball *= 40.0 / np.linalg.norm(ball, axis=1)[:, None]
    pairs = np.vstack([ball, ball + 0.001 / np.sqrt(3.0)])
    limit, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (8 << 30, hard))
    try:
        target = prepare(pairs)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (limit, hard))
    assert 0.5 < target.spacing_mm < 5.0


def test_a_vtp_block_that_unpacks_to_more_than_it_says_is_stopped():
    from gapr_core.formats.meshes.vtp import _unpacked

    bomb = zlib.compress(bytes(50_000_000))
    assert _unpacked(zlib.compress(bytes(100)), 100, "vtkZLibDataCompressor") == bytes(100)
    for block in (bomb, zlib.compress(bytes(10))):
        with pytest.raises(ValueError, match="cut, or longer than announced"):
            _unpacked(block, 100, "vtkZLibDataCompressor")
