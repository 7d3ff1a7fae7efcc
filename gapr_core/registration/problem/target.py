"""Everything static about the pre-operative bone, computed once at loading."""

from __future__ import annotations

import dataclasses
import logging
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from gapr_core import clouds
from gapr_core.config import TargetConfig
from gapr_core.errors import InvalidPointCloudError
from gapr_core.geometry import distance_field, extent, quadrics, sampling, visibility
from gapr_core.geometry.distance_field import DistanceField
from gapr_core.geometry.flat_ends import OF_POINT, flat_ends
from gapr_core.registration.problem import bone_mesh
from gapr_core.registration.problem.bone_mesh import BoneMesh
from gapr_core.surface import Surface

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

DENSER = 4  # points drawn on a mesh over those kept, so that they can be kept evenly
FLAT = 1e-3  # spread along an axis over the largest spread, below which there is no extent
LEAST_SHELL = 0.5  # least share of points seen from outside for a shell
DOUBLES_MM = 0.02  # points of a cloud this close are one: the spacing is that of the surface


@dataclass(frozen=True, eq=False)
class PreparedTarget:
    """The bone as registration sees it: its outer shell as oriented, curved surface elements.

    Attributes:
        points: (M, 3) float64, mm, evenly thinned, visible from outside.
        normals: (M, 3) unit, outward.
        tree: k-d tree of the points.
        field: nearest points and distances on a grid.
        anchors: (A,) indices of evenly spread points where the search places the source.
        spacing_mm: median distance between neighbouring points.
        surface: the loaded surface, mm, for display.
        both_cortices: the same with the inner cortex of a hollow bone, for a source that follows both; else None.
        elements: (M, 13) points, normals, shapes (second fundamental forms xx xy xz yy yz zz, 1/mm) and variances
            (mm^2: how badly an element fits its surroundings, at an edge or a thin blade), for the compiled loops.
        cache: results that proposers keep per target (a network's features).
        drawn: (S, 6) points and normals, `points` among them and those of flat ends and of an inner cortex.
        offset_mm: distance of the surface that a sensor sees from `points`, outwards; in `elements`.
    """

    points: Array
    normals: Array
    tree: cKDTree
    field: DistanceField
    anchors: NDArray[np.int64]
    spacing_mm: float
    surface: Surface
    elements: Array
    both_cortices: PreparedTarget | None = None
    cache: dict[Any, Any] = dataclasses.field(default_factory=dict)
    drawn: Array = dataclasses.field(default_factory=lambda: np.empty((0, 6)))
    offset_mm: float = 0.0

    def __repr__(self) -> str:
        return f"<PreparedTarget: {len(self.points)} points, {self.surface.extent_mm:.0f} mm across>"

    @property
    def kernel_view(self) -> tuple[Array, NDArray[np.int32], Array, float, float]:
        """Arguments that every loop of `kernels` takes."""
        return self.elements, self.field.nearest, self.field.origin, 1.0 / self.field.cell_mm, self.spacing_mm

    def mesh_distances(self, points: Array) -> tuple[Array, Array] | None:
        """Measure exact distances (N,), mm, of points (N, 3) to the mesh, and gradients (N, 3); None for a cloud.

        Positive outside of where a sensor sees the surface (`offset_mm`), NaN beyond the reach of the field.
        """
        faces = self.surface.faces
        if faces is None or not len(faces):
            return None
        if BoneMesh not in self.cache:  # when they are first asked for
            dropped = self.drawn[self.tree.query(self.drawn[:, :3])[0] > 0.0]
            self.cache[BoneMesh] = bone_mesh.build(self.surface.points, faces, (self.points, self.normals), dropped)
        distances, gradients = self.cache[BoneMesh].distances(points)
        distances[np.abs(distances) > self.field.reach_mm] = np.nan
        return distances - self.offset_mm, gradients

    @cached_property
    def half_extent_mm(self) -> float:
        """Largest distance of a point to the centroid: the scale of a pair."""
        return extent.half_extent_mm(self.points)

    @cached_property
    def main_axes(self) -> Array:
        """(3, 3) principal axes as rows, the longest first."""
        return extent.principal(self.points).axes

    @cached_property
    def centre_mm(self) -> Array:
        """(3,) mean of the points."""
        return np.asarray(self.points.mean(axis=0))


def prepare(
    target: str | Path | ArrayLike | Surface,
    units: str = "mm",
    config: TargetConfig | None = None,
    num_threads: int = 0,
) -> PreparedTarget:
    """Load and prepare a target.

    Args:
        target: path, `Surface` or (M, 3) array (see `clouds.load`).
        units: "mm", "cm", "m" or "auto".
        config: sizes; the defaults suit bones from a cartilage to a pelvis.
        num_threads: 0 for all cores; the answer does not depend on it.

    Raises:
        InvalidPointCloudError: a file that cannot be read, no bone, a plane, a line or too few points.
    """
    config = config or TargetConfig()
    surface = clouds.load(target, units)
    if isinstance(target, str | Path):
        clouds.warn_of_size(Path(target).name, surface)
    points, normals = _surface_elements(surface, config, num_threads)
    _check_is_a_body(points, config)
    spacing_mm = quadrics.spacing(points, num_threads=num_threads)
    shell = _outer_shell(points, normals, spacing_mm, config, num_threads)
    whole = _described(*_without_flat_ends(*shell, spacing_mm, config), surface, config, num_threads)
    whole = replace(whole, drawn=np.hstack(shell))
    outer = _outer_cortex(points, normals, spacing_mm, config, num_threads)
    if outer is None:
        return whole
    outer = _without_flat_ends(*outer, spacing_mm, config, warns=False)
    return replace(
        _described(*outer, surface, config, num_threads), both_cortices=whole, drawn=np.hstack([points, normals])
    )


def _described(
    points: Array, normals: Array, surface: Surface, config: TargetConfig, num_threads: int
) -> PreparedTarget:
    """Describe points (M, 3) with outward normals (M, 3)."""
    tree = cKDTree(points)
    count = max(config.quadric_neighbours, 1 + config.misfit_neighbours)
    gaps, around = quadrics.nearest(points, count, tree, num_threads)
    neighbours = np.ascontiguousarray(around[:, : config.quadric_neighbours])
    spacing_mm = float(np.median(gaps[:, 1]))
    for _ in range(2):  # the second fit excludes neighbours on the other side of a blade
        normals, shapes = quadrics.fit_quadrics(points, normals, neighbours, num_threads)
    others = around[:, 1 : 1 + config.misfit_neighbours]
    misfit = quadrics.misfit_mm(points, normals, shapes, others, num_threads=num_threads)
    return PreparedTarget(
        points=points,
        normals=normals,
        tree=tree,
        field=distance_field.build(points, normals, spacing_mm, config.field_reach_mm, num_threads=num_threads),
        anchors=sampling.thin(points, config.anchors),
        spacing_mm=spacing_mm,
        surface=surface,
        elements=np.hstack(
            [points, normals, shapes.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]], config.misfit_gain * misfit[:, None] ** 2]
        ),
    )


def _surface_elements(surface: Surface, config: TargetConfig, num_threads: int) -> tuple[Array, Array]:
    """Draw evenly thinned points (M, 3) with unit normals of arbitrary sign."""
    if surface.faces is not None and len(surface.faces):
        points, normals = surface.sample(DENSER * config.most_points, np.random.default_rng(0))
        keep = sampling.thin(points, config.most_points)
        return points[keep], normals[keep]
    unique = sampling.distinct(surface.points)
    unique = unique[sampling.voxel_indices(unique, DOUBLES_MM)]
    points = unique[sampling.thin(unique, config.most_points)]
    _, neighbours = quadrics.nearest(points, config.normal_neighbours, num_threads=num_threads)
    return points, quadrics.local_frames(points, neighbours, num_threads).normals


def _check_is_a_body(points: Array, config: TargetConfig) -> None:
    if len(points) < config.fewest_points:
        given = f"{len(points)} distinct points"
        raise InvalidPointCloudError(f"a target of at least {config.fewest_points} points", given, "export it denser")
    if shape := _flat_shape(points):
        raise InvalidPointCloudError("a bone with extent in three directions", f"a {shape}", "check the file")


def _flat_shape(points: Array) -> str:
    """Name the shape of points (N, 3) without extent in some direction, line or plane; "" for others."""
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(points.T)), 0.0))
    if spread[0] >= FLAT * spread[2]:
        return ""
    return "line" if spread[1] < FLAT * spread[2] else "plane"


def _outer_shell(
    points: Array, normals: Array, spacing_mm: float, config: TargetConfig, num_threads: int
) -> tuple[Array, Array]:
    """Select points visible from outside with outward normals; all points if fewer than half are visible."""
    votes, counts = visibility.outward_votes(
        points, normals, spacing_mm, config.view_directions, num_threads=num_threads
    )
    normals = quadrics.orient(normals, votes)
    shell = counts > 0
    return (points[shell], normals[shell]) if shell.mean() > LEAST_SHELL else (points, normals)


def _without_flat_ends(
    points: Array, normals: Array, spacing_mm: float, config: TargetConfig, warns: bool = True
) -> tuple[Array, Array]:
    """Drop points and normals on a flat end of the model; keep everything if no body would be left."""
    if not config.flat_end_mm2:
        return points, normals
    on_end = flat_ends(points, normals, spacing_mm, config.flat_end_mm2)
    left = points[~on_end]
    if not on_end.any() or len(left) < config.fewest_points or _flat_shape(left):
        return points, normals
    if warns:
        log.warning(
            "the model has flat ends (%.0f mm^2), as where a scan or a cut ends, or a table: no point is laid on them. "
            "Delete what is not bone; target.flat_end_mm2=0 keeps them",
            OF_POINT * spacing_mm**2 * np.count_nonzero(on_end),
        )
    return left, normals[~on_end]


def _outer_cortex(
    points: Array, normals: Array, spacing_mm: float, config: TargetConfig, num_threads: int
) -> tuple[Array, Array] | None:
    """Select points and outward normals of a hollow bone's outer cortex; None for a bone of one surface."""
    layer = visibility.outer_layer(points, normals, spacing_mm, config.view_directions, num_threads)
    if layer is None:
        return None
    points, outward = points[layer[0]], layer[1][layer[0]]
    _, neighbours = quadrics.nearest(points, config.normal_neighbours, num_threads=num_threads)
    return points, quadrics.orient(quadrics.local_frames(points, neighbours, num_threads).normals, outward)
