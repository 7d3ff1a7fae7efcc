"""The protocols `scene-C1`, `scene-C2`, `scene-C3` and their variants: a depth camera's view of a bone in a wound.

The limb is the bone grown by 12-35 mm, the wound a hole in it with a lobed edge above a point of the bone, with up to
two retractors. The camera is 350-550 mm away and up to 25 degrees off the wound's axis. The source is what it sees in
a region around the wound that is so large that the bone's share of the points is 60-90, 30-60 or 10-30 %.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.pair import TARGET_POINTS, Pair, place
from gapr_core.data.scenes import limb, things
from gapr_core.data.scenes import wound as wounds
from gapr_core.data.scenes.camera import Camera, View, looking_at, see, seen_in_depth
from gapr_core.data.scenes.errors import seen_by_a_poor_camera, seen_in_stereo, seen_on_layers
from gapr_core.data.scenes.wound import Shape, Wound
from gapr_core.data.specimen import Specimen
from gapr_core.errors import ConfigError
from gapr_core.geometry import se3
from gapr_core.geometry.sampling import random_directions
from gapr_core.surface import Surface

Array = NDArray[np.float64]
Thing = Callable[[Wound, float, np.random.Generator], Surface]  # of a wound and the thickness of its tissue, mm
Errors = Callable[[View, np.random.Generator], View]  # of a camera
DISTANCE_MM = (350.0, 550.0)
FARTHEST_OFF_DEG = 25.0
AIM_MM = 20.0  # farthest of what the camera aims at from the wound's centre
MOST_RETRACTORS = 2
FLOOR_MM = (5.0, 25.0)  # depth of a packed wound below its centre
MOST_POINTS = 8000
FEWEST_BONE_POINTS = 400  # in the region, before thinning; a view with fewer is drawn again
SMALLEST_REGION_MM = 20.0
OFF_CENTRE_MM = 6.0  # standard deviation of the region's centre from the wound's, along each axis
BOX_MM, BOX_OFF_MM = 200.0, 30.0  # edge of the box of interest of a whole image, and how far off its middle may be
TRIES = 60


@dataclass(frozen=True)
class SceneLevel:
    """Things in the picture, and the share of bone.

    Attributes:
        bone_share: of the points of the source.
        opening: shape of the wound.
        packed: the wound has walls and a floor of tissue; else the limb is a thin skin.
        things: other things that lie there.
        whole_image: the source is all that the camera sees; else a region about the wound.
        errors: of the camera, and of layers on the bone.
    """

    bone_share: tuple[float, float] = (0.10, 0.90)
    opening: Shape = wounds.lobed
    packed: bool = False
    things: tuple[Thing, ...] = ()
    whole_image: bool = False
    errors: Errors = seen_in_depth


SCENE_LEVELS = {
    "scene-C1": SceneLevel((0.60, 0.90)),
    "scene-C2": SceneLevel((0.30, 0.60)),
    "scene-C3": SceneLevel((0.10, 0.30)),
    "scene-slit": SceneLevel(opening=wounds.slit),
    "scene-windows": SceneLevel(opening=wounds.windows),
    "scene-packed": SceneLevel(packed=True),
    "scene-hand": SceneLevel((0.10, 0.60), things=(things.hand,)),
    "scene-drape": SceneLevel((0.10, 0.60), things=(things.drape,)),
    "scene-image": SceneLevel((0.03, 0.12), things=(things.hand,), whole_image=True),
    "scene-stereo": SceneLevel(errors=seen_in_stereo),
    "scene-noisy": SceneLevel(errors=seen_by_a_poor_camera),
    "scene-layers": SceneLevel(errors=seen_on_layers),
}


class Setting(NamedTuple):
    """A wound of a bone with its surroundings: `parts` are the surfaces, the bone first."""

    wound: Wound
    parts: list[Surface]
    facts: dict[str, Any]


def scene(specimen: Specimen, rng: np.random.Generator, level: SceneLevel) -> Pair:
    """Make one wound of one bone as a camera sees it.

    Its metadata hold `viewpoint` (3,) mm in the source's frame, `is_bone` (N,), `bone_share` and how it was made. A
    whole image also has `crop_min` and `crop_max` (3,) mm, a box of interest in the source's frame.

    Raises:
        ConfigError: a bone on which no wound shows that share of bone.
    """
    return draw(specimen, rng, level, partial(arrange, specimen))


def draw(
    specimen: Specimen,
    rng: np.random.Generator,
    level: SceneLevel,
    setting_of: Callable[[np.random.Generator, SceneLevel], Setting],
) -> Pair:
    """As `scene`, of wounds that are drawn by `setting_of` until one shows that share of bone."""
    target, _ = specimen.sample(TARGET_POINTS, rng)
    setting, view = first_view(specimen, rng, level, setting_of)
    return _as_pair(specimen, target, view, setting, level, rng)


def first_view(
    specimen: Specimen,
    rng: np.random.Generator,
    level: SceneLevel,
    setting_of: Callable[[np.random.Generator, SceneLevel], Setting],
) -> tuple[Setting, View]:
    """Draw a wound with the level's share of bone, and the view of a camera above it, without errors.

    Raises:
        ConfigError: none does.
    """
    for _ in range(TRIES):
        setting = setting_of(rng, level)
        view = see(setting.parts, camera_above(setting.wound, rng))
        chosen = shown(view, setting.wound.centre, level, rng)
        if chosen is not None:
            return setting, view.of(chosen)
    raise ConfigError(
        f"a bone of which a wound shows {level.bone_share[0]:.0%} to {level.bone_share[1]:.0%}",
        f"{specimen.bone} of {specimen.person}: none in {TRIES} wounds",
        "check that its faces surround a solid of a bone's size",
    )


def arrange(
    specimen: Specimen,
    rng: np.random.Generator,
    level: SceneLevel,
    place_of: Callable[[Specimen, np.random.Generator, Shape], Wound] = wounds.somewhere,
) -> Setting:
    """Open a wound on the bone, at random or at `place_of`, in a limb, with the things around it."""
    growth = int(rng.integers(limb.GROWTH_MM[0], limb.GROWTH_MM[1] + 1))
    wound = place_of(specimen, rng, level.opening)
    retractors = [things.retractor(wound, growth, rng) for _ in range(rng.integers(MOST_RETRACTORS + 1))]
    others = [thing(wound, growth, rng) for thing in level.things]
    if level.packed:
        tissue = limb.carved(specimen, growth, wound, rng.uniform(*FLOOR_MM))
    else:
        tissue = wounds.opened(limb.skin(specimen, growth), wound)
    facts = {
        "growth_mm": growth,
        "wound_centre": wound.centre,
        "wound_axis": wound.axes[2],
        "wound_radius_mm": wound.radius_mm,
        "retractors": len(retractors),
    }
    return Setting(wound, [specimen.surface, tissue, *retractors, *others], facts)


def camera_above(wound: Wound, rng: np.random.Generator) -> Camera:
    """Somewhere in a cone about the wound's axis, its image's middle within 20 mm of the wound's."""
    off = np.arccos(rng.uniform(np.cos(np.radians(FARTHEST_OFF_DEG)), 1.0))
    return camera_off(wound, off, rng.uniform(0.0, 2.0 * np.pi), rng)


def camera_off(wound: Wound, off: float, around: float, rng: np.random.Generator) -> Camera:
    """Move the camera `off` radians off the wound's axis and `around` radians about it."""
    direction = np.array([np.sin(off) * np.cos(around), np.sin(off) * np.sin(around), np.cos(off)])
    position = wound.at(rng.uniform(*DISTANCE_MM) * direction)
    aim = wound.centre + rng.uniform(0.0, AIM_MM) * random_directions(1, rng)[0]
    return looking_at(aim, position, rng.uniform(0.0, 2.0 * np.pi))


def shown(view: View, centre: Array, level: SceneLevel, rng: np.random.Generator) -> NDArray[np.intp] | None:
    """Choose at most 8000 points of the source; None if the bone's share or size is out of range."""
    low, high = level.bone_share
    inside = np.arange(len(view.points)) if level.whole_image else _region(view, centre, level.bone_share, rng)
    kept = rng.permutation(inside)[:MOST_POINTS]
    enough = (view.part[inside] == 0).sum() >= FEWEST_BONE_POINTS
    return kept if enough and low <= np.mean(view.part[kept] == 0) <= high else None


def _region(view: View, centre: Array, share: tuple[float, float], rng: np.random.Generator) -> NDArray[np.intp]:
    """Grow a ball about the wound until the bone's share falls to one within the level's range.

    Empty where the share is never reached or the ball then holds too little of the bone.
    """
    low, high = share
    wanted = rng.uniform(low, high)
    apart = np.linalg.norm(view.points - centre - rng.normal(0.0, OFF_CENTRE_MM, 3), axis=1)
    order = apart.argsort(kind="stable")
    bone, count = np.cumsum(view.part[order] == 0), np.arange(1, len(order) + 1)
    fits = (bone >= low * count) & (bone <= wanted * count)
    fits &= (bone >= FEWEST_BONE_POINTS) & (apart[order] >= SMALLEST_REGION_MM)
    return order[: fits.argmax() + 1] if fits.any() else order[:0]


def _as_pair(
    specimen: Specimen, target: Array, view: View, setting: Setting, level: SceneLevel, rng: np.random.Generator
) -> Pair:
    view = level.errors(view, rng)
    is_bone = view.part == 0
    share = float(is_bone.mean())
    metadata = {**setting.facts, "is_bone": is_bone, "bone_share": share, "outlier_share": 1.0 - share}
    pair = place(specimen, view.points, target, se3.random_rotation(rng), metadata, rng, view.camera)
    if level.whole_image:
        pair.metadata.update(_box_of_interest(pair, rng))
    return pair


def _box_of_interest(pair: Pair, rng: np.random.Generator) -> dict[str, Array]:
    """Draw a box of 200 mm along the source's axes, its middle within 30 mm of the wound's."""
    centre = pair.metadata["wound_centre"] - pair.metadata["origin_mm"]
    off = BOX_OFF_MM * np.cbrt(rng.random()) * random_directions(1, rng)[0]
    middle = se3.apply(se3.inverse(pair.T_target_source), centre[None])[0] + off
    return {"crop_min": middle - BOX_MM / 2.0, "crop_max": middle + BOX_MM / 2.0}
