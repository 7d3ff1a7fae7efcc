"""A wound at a joint: the next bone of the same subject lies in it too, where the scan has it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.pair import Pair
from gapr_core.data.scenes import wound as wounds
from gapr_core.data.scenes.errors import seen_in_theatre
from gapr_core.data.scenes.scene import SceneLevel, Setting, arrange, draw
from gapr_core.data.scenes.wound import Shape, Wound
from gapr_core.data.specimen import Specimen
from gapr_core.errors import ConfigError
from gapr_core.surface import Surface

Array = NDArray[np.float64]
AT_A_JOINT = SceneLevel((0.10, 0.60))
IN_THEATRE = SceneLevel((0.10, 0.60), errors=seen_in_theatre)
NEAR_MM = 40.0  # of both bones: where a joint's wound is
MADE = ("parametric", "drawn")  # cohorts whose bones were not scanned together


def joint_scene(
    specimen: Specimen,
    rng: np.random.Generator,
    others: Sequence[Specimen],
    turn: int | None = None,
    level: SceneLevel = AT_A_JOINT,
) -> Pair:
    """Make a scene of a bone and its neighbour, one of `others`; `is_bone` is of the first.

    Raises:
        ConfigError: no other bone of this subject is near, or no wound shows that share of bone.
    """
    neighbour = next_to(specimen, others)
    pair = draw(specimen, rng, level, partial(at_joint, specimen, neighbour))
    return replace(pair, metadata=pair.metadata | {"neighbour": neighbour.bone})


def next_to(specimen: Specimen, others: Sequence[Specimen]) -> Specimen:
    """Find the nearest bone of the same scan."""
    same = () if specimen.cohort in MADE else (specimen.person, specimen.cohort)
    own = [other for other in others if (other.person, other.cohort) == same and other.bone != specimen.bone]
    apart = [float(specimen.distance(other.surface.points).min()) for other in own]
    if not own or min(apart) > NEAR_MM:
        raise ConfigError(
            f"another bone of {specimen.person} within {NEAR_MM:g} mm of the {specimen.bone}, of the same scan",
            f"none among {len(others)} other bones",
            "name the bones of one joint, as in --bones femur,tibia, of subjects that were scanned",
        )
    return own[int(np.argmin(apart))]


def at_joint(specimen: Specimen, neighbour: Specimen, rng: np.random.Generator, level: SceneLevel) -> Setting:
    """Open a wound where both bones are near."""
    setting = arrange(_together(specimen, neighbour), rng, level, partial(_between, specimen, neighbour))
    return setting._replace(parts=[specimen.surface, *setting.parts[1:], neighbour.surface])


@lru_cache(maxsize=32)
def _together(specimen: Specimen, neighbour: Specimen) -> Specimen:
    """Both bones as one, since one limb surrounds them."""
    first, second = specimen.surface, neighbour.surface
    faces = np.vstack([first.triangles, second.triangles + len(first.points)])
    return replace(specimen, surface=Surface(np.vstack([first.points, second.points]), faces))


def _between(specimen: Specimen, neighbour: Specimen, both: Specimen, rng: np.random.Generator, shape: Shape) -> Wound:
    def near(points: Array) -> NDArray[np.bool_]:
        return np.maximum(specimen.distance(points), neighbour.distance(points)) <= NEAR_MM

    return wounds.somewhere(both, rng, shape, near)
