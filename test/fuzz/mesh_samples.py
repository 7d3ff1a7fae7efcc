"""One small bone-sized body in every mesh and cloud format, as other programs write it."""

import io
import struct
import tempfile
from functools import cache
from pathlib import Path

import numpy as np


def body(rings=9, sectors=12):
    """(points, faces) of an ellipsoid with a knob, 80 mm long; float32 numbers, so that every format keeps them."""
    z, a = np.linspace(0.0, np.pi, rings), np.linspace(0.0, 2.0 * np.pi, sectors, endpoint=False)
    grid = np.stack([np.outer(np.sin(z[1:-1]), np.cos(a)), np.outer(np.sin(z[1:-1]), np.sin(a)),
                     np.outer(np.cos(z[1:-1]), np.ones_like(a))], axis=-1).reshape(-1, 3)  # fmt: skip
    points = np.vstack([grid, [[0, 0, 1], [0, 0, -1]]]) * [15.0, 20.0, 40.0]
    top, bottom, faces = len(grid), len(grid) + 1, []
    for k in range(sectors):
        n = (k + 1) % sectors
        faces += [[top, k, n], [bottom, (rings - 3) * sectors + n, (rings - 3) * sectors + k]]
        for r in range(rings - 3):
            i, j = r * sectors, (r + 1) * sectors
            faces += [[i + k, j + k, j + n], [i + k, j + n, i + n]]
    return points.round(2).astype(np.float32), np.array(faces)


@cache
def samples():
    """Bytes of each file by its name."""
    points, faces = body()
    made = {"faces.npz": _npz(points=points, faces=faces), "cloud.npz": _npz(points=points)}
    made["cloud.npy"] = _npy(points)
    made |= _stl(points, faces) | _ply(points, faces) | _pcd(points) | _vtk(points, faces)
    made["mesh.obj"] = _obj(points, faces)
    return made


def _npy(array):
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def _npz(**arrays):
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def _stl(points, faces):
    facets = b"".join(struct.pack("<12fH", 0, 0, 0, *points[face].ravel(), 0) for face in faces)
    text = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x:.2f} {y:.2f} {z:.2f}\n" for x, y, z in points[face])
        + "endloop\nendfacet\n"
        for face in faces
    )
    return {
        "binary.stl": b"exported".ljust(80) + struct.pack("<I", len(faces)) + facets,
        "text.stl": f"solid bone\n{text}endsolid bone\n".encode(),
    }


def _obj(points, faces):
    rows = [f"v {x:.2f} {y:.2f} {z:.2f}\n" for x, y, z in points] + ["f {} {} {}\n".format(*f) for f in faces + 1]
    return "".join(["# a bone\n", *rows]).encode()


def _ply(points, faces):
    head = f"element vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\n"
    corners = f"element face {len(faces)}\nproperty list uchar int vertex_indices\n"
    rows = "".join(f"{x:.2f} {y:.2f} {z:.2f}\n" for x, y, z in points)
    rows += "".join("3 {} {} {}\n".format(*face) for face in faces)
    packed = b"".join(struct.pack("<B3i", 3, *face) for face in faces)
    start = "ply\nformat {} 1.0\n"
    little = start.format("binary_little_endian") + head
    return {
        "text.ply": (start.format("ascii") + head + corners + f"end_header\n{rows}").encode(),
        "binary.ply": (little + corners + "end_header\n").encode() + points.tobytes() + packed,
        "cloud.ply": (little + "end_header\n").encode() + points.tobytes(),
    }


def _pcd(points):
    """Text, binary, and compressed in literal runs only, which is LZF as well."""
    fields = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
    head = f"{fields}WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA "
    rows = "".join(f"{x:.2f} {y:.2f} {z:.2f}\n" for x, y, z in points)
    planes = points.T.tobytes()
    runs = [planes[i : i + 32] for i in range(0, len(planes), 32)]
    packed = b"".join(bytes([len(run) - 1]) + run for run in runs)
    return {
        "text.pcd": f"{head}ascii\n{rows}".encode(),
        "binary.pcd": f"{head}binary\n".encode() + points.tobytes(),
        "packed.pcd": f"{head}binary_compressed\n".encode() + struct.pack("<II", len(packed), len(planes)) + packed,
    }


def _vtk(points, faces):
    from vtkmodules.vtkIOLegacy import vtkPolyDataWriter
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    made = {}
    for kind in ("text", "binary"):
        for version in (42, 51):
            writer = vtkPolyDataWriter()
            writer.SetFileVersion(version)
            writer.SetFileTypeToASCII() if kind == "text" else writer.SetFileTypeToBinary()
            made[f"{kind}{version}.vtk"] = _written(writer, points, faces)
    for mode in ("Ascii", "Binary", "Appended"):
        for compressor in ("None", "ZLib", "LZMA"):
            writer = vtkXMLPolyDataWriter()
            getattr(writer, f"SetDataModeTo{mode}")()
            getattr(writer, f"SetCompressorTypeTo{compressor}")()
            writer.SetEncodeAppendedData(compressor != "LZMA")
            made[f"{mode}-{compressor}.vtp".lower()] = _written(writer, points, faces)
    return made


def _written(writer, points, faces):
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

    corners, cells, poly = vtkPoints(), vtkCellArray(), vtkPolyData()
    corners.SetData(numpy_to_vtk(points, deep=True))
    for face in faces:
        cells.InsertNextCell(3, face)
    poly.SetPoints(corners)
    poly.SetPolys(cells)
    writer.SetInputData(poly)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "written"
        writer.SetFileName(str(path))
        assert writer.Write()
        return path.read_bytes()
