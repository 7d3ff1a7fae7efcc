"""Endless new bones to learn from: of train people only, deformed, mirrored half of the time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from gapr_core.clouds import Surface
from gapr_core.data import anatomy, pool
from gapr_core.data.deformation import deform
from gapr_core.data.parametric import make_bone
from gapr_core.data.shape_model import ShapeModel, from_anatomy
from gapr_core.data.specimen import Specimen
from gapr_core.errors import ConfigError

Draw = Callable[[np.random.Generator], Surface]
CORRESPONDED_FROM = 5  # meshes with the same faces that make a shape model


class BoneSampler:
    """Draws new specimens of one bone: `sampler(rng)`; all chance comes from `rng`."""

    def __init__(self, bone: str, draws: Sequence[Draw], people: Sequence[str] = ()) -> None:
        if not draws:
            raise ConfigError(f"at least one source of {bone}", "none", "name a folder that has this bone")
        self.bone, self.people, self._draws = bone, tuple(people), tuple(draws)

    def __call__(self, rng: np.random.Generator) -> Specimen:
        """A bone that nobody has, left or right with even chance (a pair made from it has both clouds mirrored)."""
        surface = self._draws[rng.integers(len(self._draws))](rng)
        specimen = Specimen(surface, self.bone, f"drawn_{rng.integers(2**62)}", "drawn")
        return anatomy.mirrored(specimen) if rng.random() < 0.5 else specimen


def parametric_sampler(bone: str) -> BoneSampler:
    """New parametric people of the train split; needs no data, a second or more for each bone."""

    def draw(rng: np.random.Generator) -> Surface:
        return make_bone(bone, pool.parametric_people("train", 3)[rng.integers(3)] + 5 * int(rng.integers(2**40)))

    return BoneSampler(bone, [draw])


def anatomy_sampler(folder: str | Path, bone: str) -> BoneSampler:
    """Shape models of the train people of a folder like `../shared/anatomy`, one for each corresponded set.

    Raises:
        ConfigError: the folder has no corresponded meshes of this bone.
    """
    models = from_anatomy(folder, bone)
    return BoneSampler(bone, [model.sample for model in models], [p for model in models for p in model.people])


def mesh_sampler(folder: str | Path, bone: str | None = None, units: str = "mm") -> BoneSampler:
    """The train people of a user's own folder: a shape model where meshes share their faces, else each one varied."""
    specimens = anatomy.meshes(folder, bone, "train", units)
    names = sorted({s.bone for s in specimens})
    if len(names) != 1:
        raise ConfigError("one bone to draw", ", ".join(names), "name it")
    return BoneSampler(names[0], _draws_of([s.surface for s in specimens]), [s.person for s in specimens])


def _draws_of(surfaces: list[Surface]) -> list[Draw]:
    faces = surfaces[0].faces
    if faces is not None and len(surfaces) >= CORRESPONDED_FROM and _same_faces(surfaces):
        return [ShapeModel.fit(np.stack([s.points for s in surfaces]), faces).sample]
    return [lambda rng, s=surface: _varied(s, rng) for surface in surfaces]  # type: ignore[misc]


def _same_faces(surfaces: list[Surface]) -> bool:
    first = surfaces[0].faces
    return first is not None and all(s.faces is not None and np.array_equal(s.faces, first) for s in surfaces)


def _varied(surface: Surface, rng: np.random.Generator) -> Surface:
    """One person's mesh, up to 6 % larger or smaller along each axis, deformed more than a shape model's."""
    centre = surface.points.mean(axis=0)
    stretched = centre + (surface.points - centre) * (1.0 + rng.uniform(-0.04, 0.04) + rng.uniform(-0.02, 0.02, 3))
    return deform(Surface(stretched, surface.faces), rng, large_mm=2.0, small_mm=0.25)
