"""Clouds and meshes from files and arrays: formats, units, cleaning."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.errors import InvalidPointCloudError

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

MM_PER_UNIT = {"mm": 1.0, "m": 1000.0}
EXTENT_LIMITS_MM = (10.0, 2500.0)  # bounding-box diagonal of a piece of bone, and of the longest skeleton part


@dataclass(frozen=True)
class Surface:
    """A cloud or a triangle mesh in one frame.

    Attributes:
        points: (N, 3) float64, mm; the vertices when there are faces.
        faces: (F, 3) int64 vertex indices, or None for a cloud.
        normals: (N, 3) float64 unit normals as read, or None.
    """

    points: Array
    faces: NDArray[np.int64] | None = None
    normals: Array | None = None

    @classmethod
    def from_open3d(cls, mesh: Any) -> Surface:
        """Vertices and triangles of an `open3d.geometry.TriangleMesh`, in its unit; normals stay behind."""
        return cls(np.asarray(mesh.vertices).copy(), np.asarray(mesh.triangles).astype(np.int64))

    def to_open3d(self) -> Any:
        """The mesh as an `open3d.geometry.TriangleMesh`, mm, without normals.

        Raises:
            InvalidPointCloudError: for a cloud without faces.
        """
        import open3d as o3d

        points, faces = o3d.utility.Vector3dVector(self.points), o3d.utility.Vector3iVector(self.triangles)
        return o3d.geometry.TriangleMesh(points, faces)

    @property
    def triangles(self) -> NDArray[np.int64]:
        """(F, 3) the faces of a mesh.

        Raises:
            InvalidPointCloudError: for a cloud without faces.
        """
        if self.faces is None:
            raise InvalidPointCloudError("a triangle mesh", "a cloud without faces", "give a mesh")
        return self.faces

    @property
    def extent_mm(self) -> float:
        """Diagonal of the axis-aligned bounding box, mm."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    @property
    def face_areas_mm2(self) -> Array:
        """(F,) triangle areas, mm^2."""
        return 0.5 * np.asarray(np.linalg.norm(self._face_crosses(), axis=1))

    def mirrored(self) -> Surface:
        """The mesh of the other side of the body: x negated, faces turned so that normals stay outward.

        Raises:
            InvalidPointCloudError: for a cloud without faces.
        """
        mirror = np.array([-1.0, 1.0, 1.0])
        normals = None if self.normals is None else self.normals * mirror
        return Surface(self.points * mirror, self.triangles[:, ::-1].copy(), normals)

    def sample(self, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Points drawn anew from the faces, uniform in area.

        Returns:
            (count, 3) points, mm, and the (count, 3) unit normals of their faces (by the winding order).

        Raises:
            InvalidPointCloudError: for a cloud without faces.
        """
        crosses = self._face_crosses()
        areas = np.linalg.norm(crosses, axis=1)
        face = rng.choice(len(areas), size=count, p=areas / areas.sum())
        u, v = rng.random((2, count, 1))
        u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
        a, b, c = self._corners(face)
        return a + u * (b - a) + v * (c - a), crosses[face] / areas[face, None]

    def _corners(self, face: NDArray[np.int64] | slice = slice(None)) -> tuple[Array, Array, Array]:
        faces = self.triangles
        return tuple(self.points[faces[face, i]] for i in range(3))  # type: ignore[return-value]

    def _face_crosses(self) -> Array:
        a, b, c = self._corners()
        return np.cross(b - a, c - a)


def load(source: str | Path | ArrayLike | Surface, units: str = "mm") -> Surface:
    """A surface in mm from a file, an array or another surface.

    Args:
        source: path to PLY, PCD, STL, OBJ, VTK, VTP, NPY or NPZ (array `points`, optional `faces`), an (N, 3) array
            of finite or non-finite floats (rows that are not finite are dropped), or a `Surface`.
        units: what the numbers are, "mm" or "m"; "auto" guesses from the extent and logs a warning.

    Raises:
        InvalidPointCloudError: unreadable file, unknown format, wrong shape, nothing finite, or an extent that
            cannot be a bone in the unit named.
    """
    if isinstance(source, str | Path):
        name, surface = str(source), _read(Path(source))
    else:
        name, surface = "array", source if isinstance(source, Surface) else Surface(as_points(source))
    if surface.faces is not None and len(surface.faces):
        _check_faces(surface, name)
    surface = _drop_non_finite(surface, name)
    scale = _mm_per_unit(surface, units, name)
    return Surface(surface.points * scale, surface.faces, surface.normals)


def as_points(array: ArrayLike) -> Array:
    """An (N, 3) float64 array from anything of that shape.

    Raises:
        InvalidPointCloudError: for another shape or for entries that are not real numbers.
    """
    points = np.asarray(array)
    if points.dtype.kind not in "fiu":
        raise InvalidPointCloudError("(N, 3) real numbers", f"dtype {points.dtype}", "convert them to float")
    if points.ndim != 2 or points.shape[1] != 3:
        raise InvalidPointCloudError("an array of shape (N, 3)", f"shape {points.shape}", "pass x y z in columns")
    return points.astype(np.float64)


def finite_points(array: ArrayLike) -> Array:
    """The rows of an (N, 3) array that are finite; may be empty."""
    points = as_points(array)
    return points[np.isfinite(points).all(axis=1)]


def check_extent(extent_mm: float, unit: str, name: str) -> None:
    """Raise `InvalidPointCloudError` when something of this size cannot be a bone or a piece of one."""
    low, high = EXTENT_LIMITS_MM
    if low <= extent_mm <= high:
        return
    other = next((u for u, mm in MM_PER_UNIT.items() if low <= extent_mm / MM_PER_UNIT[unit] * mm <= high), None)
    hint = (
        f"it looks like {other}: pass units={other!r}, or convert to {unit}" if other else "check the file and its unit"
    )
    raise InvalidPointCloudError(
        f"a bone or a piece of one, {low:g} to {high:g} mm across",
        f"{name} of {extent_mm:.3g} mm read as {unit}",
        hint,
    )


def _mm_per_unit(surface: Surface, units: str, name: str) -> float:
    if units == "auto":
        units = "m" if surface.extent_mm < EXTENT_LIMITS_MM[0] else "mm"
        log.warning("%s is %.3g across: taken to be in %s; name the unit to be sure", name, surface.extent_mm, units)
    if units not in MM_PER_UNIT:
        raise InvalidPointCloudError("units 'mm', 'm' or 'auto'", repr(units), "name one of them")
    check_extent(surface.extent_mm * MM_PER_UNIT[units], units, name)
    return MM_PER_UNIT[units]


def _drop_non_finite(surface: Surface, name: str) -> Surface:
    finite = np.asarray(np.isfinite(surface.points).all(axis=1))
    if not finite.any():
        raise InvalidPointCloudError(
            "points", f"{name} with {len(finite)} points, none finite", "check how it was made"
        )
    if finite.all():
        return surface
    if surface.faces is not None:
        raise InvalidPointCloudError("finite vertices", f"{(~finite).sum()} that are not in {name}", "repair the mesh")
    normals = None if surface.normals is None else surface.normals[finite]
    return Surface(surface.points[finite], None, normals)


def _read(path: Path) -> Surface:
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise InvalidPointCloudError(f"one of {' '.join(READERS)}", path.name, "convert the file to one of these")
    if not path.is_file():
        raise InvalidPointCloudError("a file that exists", str(path), "check the path")
    try:
        surface = reader(path)
    except InvalidPointCloudError:
        raise
    except Exception as error:
        raise _unreadable(path, str(error)) from error
    if len(surface.points) == 0:
        raise _unreadable(path, "no points in it")
    return surface


def _check_faces(surface: Surface, name: str) -> None:
    """Triangles, of vertices that there are, with some area."""
    faces, count = np.asarray(surface.faces), len(surface.points)
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        given = f"faces of shape {faces.shape} and type {faces.dtype} in {name}"
        raise InvalidPointCloudError("triangles as (F, 3) integers", given, "triangulate the mesh")
    if faces.min() < 0 or faces.max() >= count:
        raise InvalidPointCloudError(
            f"faces of its {count} vertices", f"some that point beyond them in {name}", "export it again"
        )
    if not surface.face_areas_mm2.any():
        raise InvalidPointCloudError("faces with an area", f"none with any in {name}", "export it again")


def _unreadable(path: Path, why: str) -> InvalidPointCloudError:
    kind = path.suffix.lower().lstrip(".").upper()
    return InvalidPointCloudError(f"a readable {kind} file", f"{path.name} ({why})", "export it again")


def _read_ply(path: Path) -> Surface:
    """With plyfile: Open3D hands out uninitialised memory for what a cut file lacks."""
    from plyfile import PlyData, PlyParseError

    try:  # triangles are read at once, other polygons one by one
        data = PlyData.read(str(path), known_list_len={"face": {"vertex_indices": 3, "vertex_index": 3}})
    except PlyParseError:
        data = PlyData.read(str(path))
    columns = data["vertex"].data
    points = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(np.float64)
    if "face" in data and data["face"].count:
        name = next(n for n in data["face"].data.dtype.names if n in ("vertex_indices", "vertex_index"))
        return Surface(points, _triangles(data["face"].data[name]))
    normals = ("nx", "ny", "nz")
    known = all(n in columns.dtype.names for n in normals)
    return Surface(points, None, np.stack([columns[n] for n in normals], axis=1).astype(np.float64) if known else None)


def _triangles(polygons: Any) -> NDArray[np.int64]:
    """(F, 3) fans of polygons: an (F, 3) array already, or one array of vertex indices for each."""
    if polygons.dtype != object:
        return np.asarray(polygons, dtype=np.int64)
    fans = [np.column_stack([np.full(len(p) - 2, p[0]), p[1:-1], p[2:]]) for p in polygons if len(p) > 2]
    return np.concatenate(fans).astype(np.int64)


def _read_open3d(path: Path) -> Surface:
    import open3d as o3d

    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh = o3d.geometry.TriangleMesh() if path.suffix.lower() == ".pcd" else o3d.io.read_triangle_mesh(str(path))
        if mesh.has_triangles():
            mesh.remove_duplicated_vertices()  # STL repeats every vertex in each face
            return Surface.from_open3d(mesh)
        cloud = o3d.io.read_point_cloud(str(path)) if path.suffix.lower() == ".pcd" else mesh
        points = np.asarray(cloud.points if hasattr(cloud, "points") else cloud.vertices).copy()
        return Surface(points, None, np.asarray(cloud.normals).copy() if _has_normals(cloud) else None)


def _has_normals(geometry: object) -> bool:
    check = getattr(geometry, "has_normals", None) or geometry.has_vertex_normals  # type: ignore[attr-defined]
    return bool(check()) and hasattr(geometry, "normals")


def _read_vtk(path: Path) -> Surface:
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkFiltersCore import vtkTriangleFilter
    from vtkmodules.vtkIOLegacy import vtkPolyDataReader
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    reader = vtkXMLPolyDataReader() if path.suffix.lower() == ".vtp" else vtkPolyDataReader()
    reader.SetFileName(str(path))
    triangles = vtkTriangleFilter()
    triangles.SetInputConnection(reader.GetOutputPort())
    triangles.PassVertsOff()
    triangles.PassLinesOff()
    triangles.Update()
    poly = triangles.GetOutput() if triangles.GetOutput().GetNumberOfPolys() else reader.GetOutput()
    if poly.GetNumberOfPoints() == 0:
        raise _unreadable(path, "no polygonal data in it")
    points = vtk_to_numpy(poly.GetPoints().GetData()).astype(np.float64)
    faces = vtk_to_numpy(poly.GetPolys().GetConnectivityArray()).astype(np.int64).reshape(-1, 3)
    return Surface(points, faces if len(faces) else None)


def _read_numpy(path: Path) -> Surface:
    data = np.load(path, allow_pickle=False)
    if isinstance(data, np.ndarray):
        return Surface(as_points(data))
    if "points" not in data:
        raise _unreadable(path, f"no array named points, only {', '.join(data) or 'nothing'}")
    faces = data["faces"].astype(np.int64) if "faces" in data else None
    return Surface(as_points(data["points"]), faces)


READERS: dict[str, Callable[[Path], Surface]] = {
    ".ply": _read_ply,
    ".pcd": _read_open3d,
    ".stl": _read_open3d,
    ".obj": _read_open3d,
    ".vtk": _read_vtk,
    ".vtp": _read_vtk,
    ".npy": _read_numpy,
    ".npz": _read_numpy,
}
