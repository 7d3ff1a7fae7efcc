"""A scene: a camera's view from one place or from several, as one cloud; each image keeps its own lines of sight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from gapr_core.clouds import finite_points
from gapr_core.config import RegistrarConfig
from gapr_core.errors import InvalidPointCloudError
from gapr_core.geometry.extent import is_point
from gapr_core.registration.problem import inputs
from gapr_core.registration.problem import source as sources
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.proposals.regions import Region
from gapr_core.registration.scenes import free_space
from gapr_core.registration.scenes.free_space import DepthImage, Visible
from gapr_core.results import Refusal
from gapr_core.surface import as_array, as_points

Array = NDArray[np.float64]

MOST_PLACES = 16  # an image of its own is compared for each
HOW = "pass x, y, z in mm: where the camera was, or where it was for each point"


@dataclass(frozen=True, eq=False)
class Look:
    """A view from one place."""

    points: Array  # (N, 3) finite, mm, source frame
    viewpoint: Array  # (3,), mm, source frame: place of the camera


Viewpoint = ArrayLike | Sequence[Look]  # (3,) or (N, 3) mm, or the looks themselves


@dataclass(frozen=True, eq=False)
class Scene:
    """A camera's view from K places."""

    source: PreparedSource  # the cloud, with normals towards the camera
    images: tuple[DepthImage, ...]  # image of each place
    viewpoints: Array  # (K, 3) mm, source frame: the places
    look: NDArray[np.int64]  # (N,) index of each point's place
    regions: Sequence[Region] = ()  # parts of it that may be bone alone
    each: tuple[Scene, ...] = ()  # view from each place, as a scene of its own; () of a single one
    # (K,) number of each place among the given ones
    names: NDArray[np.int64] = field(default_factory=lambda: np.zeros(1, dtype=np.int64))
    # (G, 3) mm, source frame: the given places, also those with too few points
    given: Array = field(default_factory=lambda: np.empty((0, 3)))

    def part(self, members: NDArray[np.bool_], config: RegistrarConfig) -> PreparedSource:
        """Cut some of its points into a source of their own, with normals towards the camera.

        Their flatness stays that of the whole cloud: that of the part omits tissue.
        """
        part = sources.describe(self.source.points[members], config.source)
        part = replace(part, flatness_mm=self.source.flatness_mm[members])
        return part.facing(self.viewpoints[self.look[members]])

    def compare(
        self, poses: Array, points: Array, normals: Array, on_mm: float, front_mm: float, num_threads: int = 0
    ) -> Visible:
        """Compare a target under poses (K, 4, 4) with the views, averaged over the places; see `free_space.compare`."""
        how = points, normals
        seen = [free_space.compare(poses, *how, image, on_mm, front_mm, num_threads) for image in self.images]
        return free_space.average(seen)


def split(source: ArrayLike, viewpoint: Viewpoint) -> list[Look]:
    """Split the finite points of a cloud (N, 3), mm, by the place of its camera: one for all, or one for each point.

    Looks in place of a viewpoint are the cloud, split already.

    Raises:
        InvalidPointCloudError: a viewpoint of another shape, or one that is not finite; more than `MOST_PLACES` places.
    """
    places = as_array(viewpoint, "a viewpoint", HOW)
    if places.size and isinstance(places.flat[0], Look):
        return list(places)
    if places.ndim < 2:
        return [Look(finite_points(source), inputs.numbers(places, (3,), "viewpoint", HOW))]
    return _by_place(as_points(source), places)


def _by_place(points: Array, of_points: NDArray[Any]) -> list[Look]:
    """Split finite points of a cloud (N, 3) by the camera's places (N, 3); looks are sorted by place."""
    usable = is_point(points)
    if of_points.shape == points.shape and of_points.dtype.kind == "f":
        of_points = np.where(usable[:, None], of_points, 0.0)
    of_points = inputs.numbers(of_points, points.shape, "viewpoint", HOW)[usable]
    begins = np.append(True, (np.diff(of_points, axis=0) != 0.0).any(axis=1))[: len(of_points)]  # runs from one place
    places, of_run = np.unique(of_points[begins], axis=0, return_inverse=True)
    if len(places) > MOST_PLACES:
        how = "pass the last images, or those from places that differ most"
        raise InvalidPointCloudError(f"at most {MOST_PLACES} places of a camera", f"{len(places)}", how)
    points, look = points[usable], of_run.reshape(-1)[np.cumsum(begins) - 1]
    looks = [Look(finite_points(points[look == i]), place) for i, place in enumerate(places)]
    return looks or [Look(points, np.zeros(3))]  # of no point at all


def prepared(looks: Sequence[Look], config: RegistrarConfig) -> Scene | Refusal:
    """Prepare the scene of looks, without those of too few points; the first one's refusal where all have too few.

    With others a look needs the points of a region: an image of a few is all holes. Raises as `scene_from`.
    """
    clouds = [sources.prepare(look.points, config.source, config.num_threads, in_scene=True) for look in looks]
    seen = {name: source for name, source in enumerate(clouds) if isinstance(source, PreparedSource)}
    if not seen:
        return next(source for source in clouds if isinstance(source, Refusal))
    fewest = config.clutter.region_fewest_points
    seen = {name: source for name, source in seen.items() if len(source.points) >= fewest} or seen
    each = [scene_from(source, looks[name].viewpoint, config) for name, source in seen.items()]
    scene = each[0] if len(each) == 1 else _together(each, config)
    if isinstance(scene, Refusal):
        return scene
    return replace(scene, names=np.array(list(seen)), given=np.array([look.viewpoint for look in looks]))


def scene_from(source: PreparedSource, viewpoint: Array, config: RegistrarConfig) -> Scene:
    """Build the scene seen from one viewpoint (3,), mm, source frame; no regions yet.

    Raises:
        InvalidViewpointError: a viewpoint in the middle of its own points.
    """
    seen = source.facing(viewpoint)
    around = seen.points[seen.neighbours[:, : config.clutter.levelled_by]].mean(axis=1) - seen.points
    heights = np.einsum("ni,ni->n", around, seen.normals)  # of the mean of neighbours: the noise is averaged
    image = free_space.see(seen.points + seen.normals * heights[:, None], seen.normals, viewpoint)
    return Scene(seen, (image,), viewpoint[None], np.zeros(len(seen.points), dtype=np.int64))


def _together(each: Sequence[Scene], config: RegistrarConfig) -> Scene | Refusal:
    """Join scenes of one place each, in one frame; a refusal where they are no body together."""
    viewpoints = np.concatenate([scene.viewpoints for scene in each])
    points = np.concatenate([scene.source.points for scene in each])
    together = sources.prepare(points, config.source, config.num_threads, in_scene=True)
    if isinstance(together, Refusal):
        return together
    of_point = np.repeat(np.arange(len(each)), [len(scene.source.points) for scene in each])
    look = of_point[cKDTree(points).query(together.points)[1]]
    images = tuple(scene.images[0] for scene in each)
    return Scene(together.facing(viewpoints[look]), images, viewpoints, look, each=tuple(each))
