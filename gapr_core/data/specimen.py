"""One bone of one subject, with the ray-casting state that protocols need, built once and kept."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gapr_core.errors import InvalidPointCloudError
from gapr_core.geometry import extent
from gapr_core.surface import Surface

Array = NDArray[np.float64]
CLEARANCE_MM = 0.1  # from a point to where its ray begins, or the ray would hit the point's own face


@dataclass(frozen=True, eq=False)
class Specimen:
    """One bone surface and whose it is.

    Attributes:
        surface: points (N, 3) mm and faces (F, 3), in the frame of the scan.
        bone: bone type, for example "femur".
        person: identity that splits and `wrong` pairs go by; the same for all bones of one subject.
        cohort: the data the surface comes from, for example "llp26", "parametric", "ct".
    """

    surface: Surface
    bone: str
    person: str
    cohort: str = ""

    def __post_init__(self) -> None:
        if self.surface.faces is None or len(self.surface.faces) == 0:
            raise InvalidPointCloudError(
                "a mesh with faces",
                f"a cloud without faces for {self.bone} of {self.person}",
                "give a surface mesh (STL, PLY, OBJ): views and new points are drawn from its faces",
            )

    def __reduce__(self) -> tuple[Any, ...]:
        """Travels to worker processes without its ray-casting state."""
        return type(self), (self.surface, self.bone, self.person, self.cohort)

    def sample(self, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """(count, 3) points and unit normals, uniform over the area, drawn again at every call."""
        return self.surface.sample(count, rng)

    def visible_from(self, points: Array, direction: Array) -> NDArray[np.bool_]:
        """Find the surface points (N, 3) that see a far probe in `direction`, (3,) or (N, 3).

        Orientation of the faces does not matter: a ray from the far side runs through the bone and hits it.
        """
        start = points - self._centre + CLEARANCE_MM * direction
        rays = np.hstack([start, np.broadcast_to(direction, start.shape)]).astype(np.float32)
        return ~self._scene.test_occlusions(rays).numpy()

    def distance(self, points: Array) -> Array:
        """Unsigned distance (N,) mm from points (N, 3) to the surface."""
        queries = (points - self._centre).astype(np.float32)
        return self._scene.compute_distance(queries).numpy().astype(np.float64)

    def signed_distance(self, points: Array) -> Array:
        """Distance (N,) mm from points (N, 3) to the surface, negative inside."""
        queries = (points - self._centre).astype(np.float32)
        return self._scene.compute_signed_distance(queries).numpy().astype(np.float64)

    def end(self, share: float, upper: bool) -> Specimen:
        """Keep a share of the length at one end, closed where it is cut, as a shorter scan does.

        `upper` is the end with the larger coordinate along the axis nearest to the bone's longest direction.
        """
        triangles, centred = self.surface.triangles, self.surface.points - self._centre
        axis = extent.principal(centred).axes[0].copy()
        axis *= np.sign(axis[np.abs(axis).argmax()]) * (1.0 if upper else -1.0)
        along = centred @ axis
        kept = along >= along.max() - share * np.ptp(along)
        faces = triangles[kept[triangles].all(axis=1)]
        used, faces = np.unique(faces, return_inverse=True)
        points, faces = _closed(self.surface.points[used], faces.reshape(-1, 3))
        return replace(self, surface=Surface(points, faces))

    def cut(self, normal: Array, offset_mm: float) -> Specimen:
        """Keep the side of a plane against its normal, closed by the plane, as a saw does.

        Corners of cut faces that are beyond the plane move onto it.

        Args:
            normal: (3,) unit.
            offset_mm: along the normal, from the origin of the scan.
        """
        beyond = self.surface.points @ normal - offset_mm
        faces = self.surface.triangles[(beyond < 0.0)[self.surface.triangles].any(axis=1)]
        used, faces = np.unique(faces, return_inverse=True)
        flattened = self.surface.points[used] - np.outer(np.maximum(beyond[used], 0.0), normal)
        points, faces = _closed(flattened, faces.reshape(-1, 3))
        return replace(self, surface=Surface(points, faces))

    @cached_property
    def _centre(self) -> Array:
        return self.surface.points.mean(axis=0)

    @cached_property
    def _scene(self) -> Any:
        """Open3D RaycastingScene, centred so that its float32 is fine enough."""
        import open3d as o3d

        scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        vertices = np.ascontiguousarray(self.surface.points - self._centre, dtype=np.float32)
        scene.add_triangles(vertices, np.ascontiguousarray(self.surface.triangles, dtype=np.uint32))
        return scene


def _closed(points: Array, faces: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Fill every hole of a mesh with triangles from its rim to the rim's middle."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    _, first, counts = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    rim = edges[first[counts == 1]]
    linked = coo_array((np.ones(len(rim)), (rim[:, 0], rim[:, 1])), shape=(len(points), len(points)))
    hole = connected_components(linked, directed=False)[1][rim[:, 0]]
    _, hole = np.unique(hole, return_inverse=True)
    middles = np.array([points[rim[hole == i, 0]].mean(axis=0) for i in range(hole.max(initial=-1) + 1)]).reshape(-1, 3)
    caps = np.column_stack([rim[:, ::-1], len(points) + hole])
    return np.vstack([points, middles]), np.vstack([faces, caps])
