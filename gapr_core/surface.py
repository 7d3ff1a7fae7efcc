"""Input of a registration: a cloud or a triangle mesh in one frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.errors import InvalidPointCloudError

Array = NDArray[np.float64]
OF_OBJECTS = {  # an attribute of meshes and clouds of other libraries -> what to pass of them
    "triangles": "of a mesh for `prepare`: Surface.from_open3d(mesh); of a cloud its points as an array",
    "faces": "of a mesh for `prepare`: Surface(mesh.vertices, mesh.faces); of a cloud its points as an array",
    "points": "pass its points: np.asarray(cloud.points)",
}


@dataclass(frozen=True, eq=False)
class Surface:
    """A cloud or a triangle mesh in one frame.

    Attributes:
        points: (N, 3) float64, mm; the vertices when there are faces.
        faces: (F, 3) int64 vertex indices, or None for a cloud.
        normals: (N, 3) float64 unit normals as read, or None.
        camera: (3,) float64, mm: where a camera saw a cloud from, if its pixels say (`geometry.pinhole`), or None.
        joined: the points were measured from several places, as several clouds or slices, or by a tip.
        unit: that its file was read in, such as "cm"; empty without a file.
    """

    points: Array
    faces: NDArray[np.int64] | None = None
    normals: Array | None = None
    camera: Array | None = None
    joined: bool = False
    unit: str = ""

    @classmethod
    def from_open3d(cls, mesh: Any) -> Surface:
        """Vertices and triangles of an `open3d.geometry.TriangleMesh`, in its unit; normals stay behind."""
        return cls(np.asarray(mesh.vertices).copy(), np.asarray(mesh.triangles).astype(np.int64))

    def to_open3d(self) -> Any:
        """Return the mesh as an `open3d.geometry.TriangleMesh`, mm, without normals.

        Raises:
            InvalidPointCloudError: for a cloud without faces.
        """
        import open3d as o3d

        points, faces = o3d.utility.Vector3dVector(self.points), o3d.utility.Vector3iVector(self.triangles)
        return o3d.geometry.TriangleMesh(points, faces)

    def __repr__(self) -> str:
        faces = "" if self.faces is None else f"{len(self.faces)} faces, "
        return f"<Surface: {len(self.points)} points, {faces}{self.extent_mm:.0f} mm across>"

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
        return float(np.linalg.norm(np.ptp(np.ascontiguousarray(self.points.T), axis=1)))  # by rows it takes longer

    @property
    def face_areas_mm2(self) -> Array:
        """(F,) triangle areas, mm^2."""
        return 0.5 * self._face_crosses()[1]

    def mirrored(self) -> Surface:
        """Mirror the mesh to the other side of the body: x negated, normals still outward.

        Raises:
            InvalidPointCloudError: for a cloud without faces.
        """
        mirror = np.array([-1.0, 1.0, 1.0])
        normals = None if self.normals is None else self.normals * mirror
        return Surface(self.points * mirror, self.triangles[:, ::-1].copy(), normals)

    def sample(self, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Random points on the faces, uniform in area.

        Returns:
            (count, 3) points, mm, and the (count, 3) unit normals of their faces (by the winding order).

        Raises:
            InvalidPointCloudError: for a cloud without faces, and for faces without an area.
        """
        from gapr_core.geometry.triangles import sampled

        crosses, areas = self._face_crosses()
        if not 0.0 < areas.sum() < np.inf:
            raise InvalidPointCloudError("faces with an area", f"{len(areas)} without", "check the mesh and its unit")
        upto = np.cumsum(areas / areas.sum())
        chosen, (u, v) = rng.random(count), rng.random((2, count))
        return sampled(self.points, self.triangles, crosses, areas, upto / upto[-1], chosen, u, v)  # type: ignore[no-any-return]

    def _face_crosses(self) -> tuple[Array, Array]:
        """(F, 3) vectors across the faces, as long as twice their areas, and these lengths (F,)."""
        from gapr_core.geometry.triangles import crosses

        return crosses(self.points, self.triangles)  # type: ignore[no-any-return]


def check_faces(surface: Surface, name: str) -> None:
    """Refuse faces that are no triangles, that point beyond the vertices, or that have no area at all.

    Raises:
        InvalidPointCloudError: they do.
    """
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


def as_points(array: ArrayLike) -> Array:
    """Convert anything of the shape (N, 3) to a float64 array; masked entries become NaN.

    Fields x y z of a structured array, such as `read_points` of ROS gives, are its columns. Of a camera's image
    (H, W, 3) the rows follow each other, and a pixel of 0 0 0 has no depth: it becomes NaN.

    Raises:
        InvalidPointCloudError: for another shape, rows of several lengths, or entries that are not real numbers.
    """
    if isinstance(array, Surface):
        raise InvalidPointCloudError("an array of shape (N, 3)", "a Surface", "pass its points: surface.points")
    if isinstance(array, str | PurePath):
        how = "load it first: gapr_core.load(path).points"
        raise InvalidPointCloudError("an array of shape (N, 3)", f"the path {str(array)!r}", how)
    if hasattr(array, "files"):
        raise InvalidPointCloudError("an array of shape (N, 3)", "an NPZ archive", "pass its path, or its array points")
    points = as_array(array, "an array of shape (N, 3)", "pass x y z in every row")
    if points.dtype.names and set("xyz") <= set(points.dtype.names):
        points = np.stack([np.ravel(points[name]) for name in "xyz"], axis=1)
    if points.ndim == 0 and points.dtype.kind == "O":
        how = next((how for name, how in OF_OBJECTS.items() if hasattr(array, name)), "pass x y z in columns")
        raise InvalidPointCloudError("an array of shape (N, 3)", f"a {type(array).__name__}", how)
    if points.dtype.kind not in "fiu":
        if hasattr(array, "files"):
            raise InvalidPointCloudError(
                "an array of shape (N, 3)", "an NPZ archive", "pass its path, or one of its arrays"
            )
        raise InvalidPointCloudError("(N, 3) real numbers", f"dtype {points.dtype}", "convert them to float")
    if points.ndim == 3 and points.shape[2] == 3:
        points = points.reshape(-1, 3).astype(np.float64)
        points[~points.any(axis=1)] = np.nan
    if points.ndim != 2 or points.shape[1] != 3:
        how = "pass its transpose" if points.ndim == 2 and points.shape[0] == 3 else "pass x y z in columns"
        raise InvalidPointCloudError("an array of shape (N, 3)", f"shape {points.shape}", how)
    return points.astype(np.float64)


def as_array(array: Any, expected: str, how: str) -> NDArray[Any]:
    """Convert to a NumPy array; a tensor may need a gradient or live on any device.

    Raises:
        InvalidPointCloudError: no array, such as rows of several lengths; with these words.
    """
    if hasattr(array, "detach"):
        array = array.detach().cpu()
    if np.ma.isMaskedArray(array) and array.dtype.kind in "fiu":
        return np.asarray(np.ma.filled(array.astype(np.float64), np.nan))
    try:
        return np.asarray(array)
    except (ValueError, TypeError, RuntimeError) as error:
        given = f"{type(array).__name__} ({' '.join(str(error).split())})"
        raise InvalidPointCloudError(expected, given, how) from error
