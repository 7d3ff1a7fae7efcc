"""A scene: what a camera saw, from one place or from several.

One image shows one side of a wound, with one set of errors. The camera moves a little, and it shows more bone, what hid
it, and other errors. The images are one cloud in one frame in which the bone rests; each keeps its lines of sight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from gapr_core.clouds import finite_points
from gapr_core.config import RegistrarConfig
from gapr_core.errors import InvalidPointCloudError
from gapr_core.registration import free_space, inputs
from gapr_core.registration import source as sources
from gapr_core.registration.free_space import DepthImage, Visible
from gapr_core.registration.proposals.regions import Region
from gapr_core.registration.source import PreparedSource
from gapr_core.results import Refusal
from gapr_core.surface import as_array

Array = NDArray[np.float64]

MOST_PLACES = 16  # an image of its own is compared for each
HOW = "pass x, y, z in mm: where the camera was, or where it was for each point"


@dataclass(frozen=True, eq=False)
class Look:
    """What was seen from one place.

    Attributes:
        points: (N, 3), mm, source frame.
        viewpoint: (3,), mm, source frame: where the camera was.
    """

    points: Array
    viewpoint: Array


@dataclass(frozen=True, eq=False)
class Scene:
    """What a camera saw from K places.

    Attributes:
        source: the cloud, with normals towards the camera.
        images: the same as its camera saw it, one for each place.
        viewpoints: (K, 3) mm, source frame: the places.
        look: (N,) index of the place that each point of the source was seen from.
        regions: parts of it that may be bone alone.
        left_out: (L, 3) mm, source frame: places from which too few points were seen for an image.
    """

    source: PreparedSource
    images: tuple[DepthImage, ...]
    viewpoints: Array
    look: NDArray[np.int64]
    regions: Sequence[Region] = ()
    left_out: Array = field(default_factory=lambda: np.empty((0, 3)))

    @property
    def viewpoint(self) -> Array:
        """(3,) mm, the middle of the places."""
        return np.asarray(self.viewpoints.mean(axis=0))

    def of(self, number: int) -> Scene:
        """The same with the image of one place alone."""
        return replace(self, images=self.images[number : number + 1])

    def part(self, members: NDArray[np.bool_], config: RegistrarConfig) -> PreparedSource:
        """Some of its points as a source of its own, its normals towards the camera."""
        part = sources.describe(self.source.points[members], config.source)
        return part.facing(self.viewpoints[self.look[members]])

    def compare(
        self, poses: Array, points: Array, normals: Array, on_mm: float, front_mm: float, num_threads: int = 0
    ) -> Visible:
        """What the camera saw of a target under poses (K, 4, 4), the mean over its places; see `free_space.compare`."""
        how = points, normals
        seen = [free_space.compare(poses, *how, image, on_mm, front_mm, num_threads) for image in self.images]
        return free_space.average(seen)


def split(source: ArrayLike, viewpoint: ArrayLike) -> list[Look]:
    """A cloud (N, 3) by where its camera was: one place (3,) for all, or one for each point (N, 3); mm.

    Raises:
        InvalidPointCloudError: a viewpoint of another shape, or one that is not finite; more than `MOST_PLACES` places.
    """
    given = as_array(viewpoint, "a viewpoint", HOW)
    if given.ndim < 2:
        return [Look(finite_points(source), inputs.numbers(viewpoint, (3,), "viewpoint", HOW))]
    points = as_array(source, "an (N, 3) source", "pass x, y, z in mm")
    of_points = inputs.numbers(viewpoint, (len(points), 3), "viewpoint", HOW)
    finite_points(points)  # a source that is none is named here
    begins = np.append(True, (np.diff(of_points, axis=0) != 0.0).any(axis=1))[: len(points)]  # runs from one place
    places, of_run = np.unique(of_points[begins], axis=0, return_inverse=True)
    look = of_run.reshape(-1)[np.cumsum(begins) - 1]
    if len(places) > MOST_PLACES:
        how = "pass the last images, or those from places that differ most"
        raise InvalidPointCloudError(f"at most {MOST_PLACES} places of a camera", f"{len(places)}", how)
    found = [Look(finite_points(points[look == i]), place) for i, place in enumerate(places)]
    return found or [Look(points, np.zeros(3))]  # of no point at all


def prepared(looks: Sequence[Look], config: RegistrarConfig) -> Scene | Refusal:
    """The scene of looks, of which those of too few points are left out; the first one's refusal where all are."""
    found = [(sources.prepare(look.points, config.source, config.num_threads, in_scene=True), look) for look in looks]
    seen = [(source, look.viewpoint) for source, look in found if isinstance(source, PreparedSource)]
    if not seen:
        return next(source for source, _ in found if isinstance(source, Refusal))
    scene = scene_from([source for source, _ in seen], np.array([place for _, place in seen]), config)
    left_out = [look.viewpoint for source, look in found if isinstance(source, Refusal)]
    return replace(scene, left_out=np.reshape(left_out, (-1, 3)))


def scene_from(looks: Sequence[PreparedSource], viewpoints: Array, config: RegistrarConfig) -> Scene:
    """The scene that a camera saw from viewpoints (K, 3), mm, source frame; no regions yet.

    Raises:
        InvalidViewpointError: a viewpoint in the middle of what was seen from it.
    """
    settings, looks = config.clutter, [each.facing(place) for each, place in zip(looks, viewpoints, strict=True)]
    images = tuple(
        free_space.see(_levelled(each, settings.levelled_by), each.normals, place, settings.free_space)
        for each, place in zip(looks, viewpoints, strict=True)
    )
    if len(looks) == 1:
        return Scene(looks[0], images, viewpoints, np.zeros(len(looks[0].points), dtype=np.int64))
    points = np.concatenate([each.points for each in looks])
    together = sources.prepare(points, config.source, config.num_threads, in_scene=True)
    assert isinstance(together, PreparedSource)  # one of them is enough
    of_point = np.repeat(np.arange(len(looks)), [len(each.points) for each in looks])
    look = of_point[cKDTree(points).query(together.points)[1]]
    return Scene(together.facing(viewpoints[look]), images, viewpoints, look)


def _levelled(source: PreparedSource, count: int) -> Array:
    """(N, 3) points, mm, moved along their normals to the mean of `count` neighbours: the noise is averaged."""
    around = source.points[source.neighbours[:, :count]].mean(axis=1) - source.points
    return source.points + source.normals * np.einsum("ni,ni->n", around, source.normals)[:, None]
