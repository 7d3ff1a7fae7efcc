"""The protocols `scene-*-looks`: a wound that a tracked camera sees from four places, in one frame in which it rests.

The first look is one as `scene` takes it. The others come from places around it, 15 to 35 degrees off the wound's axis,
and show the same region. Layers on the bone are the same in all looks; errors of the camera are drawn for each, and so
are those of the tracker that says where it was. A range that is wrong is wrong in all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.pair import TARGET_POINTS, Pair, place
from gapr_core.data.scenes import joint
from gapr_core.data.scenes.camera import View, see, seen_in_depth
from gapr_core.data.scenes.errors import seen_by_a_poor_camera, seen_in_stereo, under_layers
from gapr_core.data.scenes.scene import (
    MOST_POINTS,
    TRIES,
    Errors,
    SceneLevel,
    Setting,
    arrange,
    camera_off,
    first_view,
)
from gapr_core.data.sensors.depth_maps import Range
from gapr_core.data.specimen import Specimen
from gapr_core.errors import ConfigError
from gapr_core.geometry import se3

Array = NDArray[np.float64]

LOOKS = 4
OFF_DEG = (15.0, 35.0)  # of the later looks from the wound's axis
FEWEST_POINTS = 200  # of a later look
TRACKED_MM, TRACKED_DEG = 0.3, 0.05  # standard deviation of the camera's tracked place and turn, about each axis
RANGE = 0.003  # standard deviation of the relative error of a calibrated camera's range


@dataclass(frozen=True)
class LookedAt:
    """Content of the looks.

    Attributes:
        bone_share: of the points of the first look.
        errors: of the camera, drawn for each look.
        under_layers: the bone lies under layers.
        at_joint: the next bone of the same scan lies in the wound, too.
        range_wrong: standard deviation of the relative error of the camera's range.
    """

    bone_share: tuple[float, float] = (0.10, 0.90)
    errors: Errors = seen_in_depth
    under_layers: bool = False
    at_joint: bool = False
    range_wrong: float = 0.0


LOOKED_AT = {
    "scene-C3": LookedAt((0.10, 0.30)),
    "scene-stereo": LookedAt(errors=seen_in_stereo),
    "scene-noisy": LookedAt(errors=seen_by_a_poor_camera),
    "scene-layers": LookedAt(under_layers=True),
    "scene-joint": LookedAt((0.10, 0.60), at_joint=True),
    "scene-theatre": LookedAt((0.10, 0.60), seen_in_stereo, under_layers=True, at_joint=True, range_wrong=RANGE),
}
ALONE = tuple(name for name, kind in LOOKED_AT.items() if not kind.at_joint)  # of one bone


def several_looks(
    specimen: Specimen, rng: np.random.Generator, others: Sequence[Specimen] = (), turn: int | None = None,
    kind: LookedAt | None = None,
) -> Pair:  # fmt: skip
    """Make one wound as a camera sees it from `LOOKS` places.

    Its metadata hold `viewpoint` (N, 3) mm, the camera's place for each point in the source's frame. Further keys are
    `look` (N,), `is_bone` (N,), `bone_share` of all looks, the `neighbour` at a joint, and how it was made.

    Raises:
        ConfigError: a bone on which no wound shows that share of bone, or at a joint, no other bone near.
    """
    kind = kind or LookedAt()
    target, _ = specimen.sample(TARGET_POINTS, rng)
    setting_of, neighbour = partial(arrange, specimen), joint.next_to(specimen, others) if kind.at_joint else None
    if neighbour is not None:
        setting_of = partial(joint.at_joint, specimen, neighbour)
    setting, first = first_view(specimen, rng, SceneLevel(kind.bone_share), setting_of)
    radius = np.linalg.norm(first.points - setting.wound.centre, axis=1).max()
    views = [first, *(_from(setting, around, radius, rng) for around in _places_around(rng))]
    views = under_layers(views, rng) if kind.under_layers else views
    factor = 1.0 + rng.normal(0.0, kind.range_wrong) if kind.range_wrong else 1.0
    views = [_of_range(kind.errors(view, rng), factor) for view in views]
    views = [views[0], *(_tracked(view, rng) for view in views[1:])]
    pair = _as_pair(specimen, target, views, setting, rng)
    return pair if neighbour is None else replace(pair, metadata=pair.metadata | {"neighbour": neighbour.bone})


def _places_around(rng: np.random.Generator) -> Array:
    """Directions about the wound's axis, rad, evenly apart."""
    return rng.uniform(0.0, 2.0 * np.pi) + 2.0 * np.pi * np.arange(LOOKS - 1) / (LOOKS - 1)


def _from(setting: Setting, around: float, radius: float, rng: np.random.Generator) -> View:
    """View the same region from another place, at most `MOST_POINTS`; try again if hardly anything shows.

    Raises:
        ConfigError: no place shows some of it.
    """
    for _ in range(TRIES):
        view = _seen_from(setting, around, radius, rng)
        if len(view.points) >= FEWEST_POINTS:
            return view
        around = rng.uniform(0.0, 2.0 * np.pi)
    raise ConfigError("a wound that a camera sees from several places", "one hidden from all", "choose another seed")


def _seen_from(setting: Setting, around: float, radius: float, rng: np.random.Generator) -> View:
    view = see(setting.parts, camera_off(setting.wound, np.radians(rng.uniform(*OFF_DEG)), around, rng))
    inside = np.flatnonzero(np.linalg.norm(view.points - setting.wound.centre, axis=1) <= radius)
    return view.of(rng.permutation(inside)[:MOST_POINTS])


def _of_range(view: View, factor: float) -> View:
    """As a camera sees it whose range is wrong by a factor: the cloud is nearer or farther."""
    return replace(view, points=Range(factor, view.camera).of(view.points))


def _tracked(view: View, rng: np.random.Generator) -> View:
    """Moved as the tracker of the camera errs."""
    twist = np.concatenate([rng.normal(0.0, TRACKED_MM, 3), np.radians(rng.normal(0.0, TRACKED_DEG, 3))])
    T = se3.exp(twist, view.camera)
    return replace(view, points=se3.apply(T, view.points), camera=se3.apply(T, view.camera[None])[0])


def _as_pair(
    specimen: Specimen, target: Array, views: Sequence[View], setting: Setting, rng: np.random.Generator
) -> Pair:
    look = np.repeat(np.arange(len(views)), [len(view.points) for view in views])
    is_bone = np.concatenate([view.part == 0 for view in views])
    share = float(is_bone.mean())
    metadata = {**setting.facts, "look": look, "is_bone": is_bone, "bone_share": share, "outlier_share": 1.0 - share}
    points, places = np.concatenate([view.points for view in views]), np.array([view.camera for view in views])
    return place(specimen, points, target, se3.random_rotation(rng), metadata, rng, places[look])
