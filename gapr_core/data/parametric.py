"""Bones that need no data: thousands of different ones, each from a seed, watertight, in mm.

Frame of every bone: x to the subject's left, y backwards, z up.
"""

from __future__ import annotations

from collections.abc import Callable
from zlib import crc32

import numpy as np

from gapr_core.data import deformation
from gapr_core.data.bones.femur import FemurParameters, femur_surface
from gapr_core.data.bones.pelvis import PelvisParameters, pelvis_surface
from gapr_core.data.bones.thoracic import ThoracicParameters, thoracic_surface
from gapr_core.data.bones.tibia import TibiaParameters, tibia_surface
from gapr_core.data.parameters import draw
from gapr_core.data.solid import simplify
from gapr_core.errors import ConfigError
from gapr_core.surface import Surface


def make_bone(name: str, seed: int) -> Surface:
    """Make one bone of subject `seed`: a closed mesh in mm, the same one for the same arguments.

    Args:
        name: a key of `BONES`. Femur and tibia are a left or a right one, as the seed decides.
        seed: the subject, any non-negative integer.

    Raises:
        ConfigError: an unknown bone.
    """
    if name not in BONES:
        raise ConfigError(f"a bone of {', '.join(BONES)}", repr(name), "choose one of these")
    return BONES[name](np.random.default_rng([seed, crc32(name.encode())]))


def _femur(rng: np.random.Generator) -> Surface:
    return _either_side(_finish(femur_surface(draw(FemurParameters, rng)), rng), rng)


def _tibia(rng: np.random.Generator) -> Surface:
    return _either_side(_finish(tibia_surface(draw(TibiaParameters, rng)), rng), rng)


def _pelvis(rng: np.random.Generator) -> Surface:
    return _finish(pelvis_surface(draw(PelvisParameters, rng), rng), rng, faces=24_000)


def _thoracic(rng: np.random.Generator) -> Surface:
    return _finish(thoracic_surface(draw(ThoracicParameters, rng), rng), rng, faces=20_000)


def _finish(surface: Surface, rng: np.random.Generator, faces: int = 14_000) -> Surface:
    """Individual form and texture that no parameter describes, then a mesh of a size that files and trees like."""
    return simplify(deformation.deform(surface, rng), faces)


def _either_side(left: Surface, rng: np.random.Generator) -> Surface:
    return left if rng.random() < 0.5 else left.mirrored()


BONES: dict[str, Callable[[np.random.Generator], Surface]] = {
    "femur": _femur,
    "tibia": _tibia,
    "pelvis": _pelvis,
    "thoracic": _thoracic,
}
