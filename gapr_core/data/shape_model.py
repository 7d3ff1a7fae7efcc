"""Shape models from meshes in vertex correspondence: new bones within the spread of the people they were built from."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.clouds import Surface
from gapr_core.data import anatomy
from gapr_core.data.deformation import deform
from gapr_core.errors import ConfigError
from gapr_core.geometry import se3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ShapeModel:
    """Mean shape and principal modes of a bone (Cootes et al. 1995, point distribution model).

    Attributes:
        mean: (N, 3) mm, rigidly aligned.
        modes: (K, N, 3) orthonormal over all N x 3 coordinates, the strongest first.
        deviations: (K,) standard deviation of each mode's coefficient, mm.
        faces: (F, 3).
        people: whom it was built from.
    """

    mean: Array
    modes: Array
    deviations: Array
    faces: NDArray[np.int64]
    people: tuple[str, ...] = ()

    @classmethod
    def fit(
        cls, points: ArrayLike, faces: ArrayLike, people: Iterable[str] = (), explained: float = 0.98
    ) -> ShapeModel:
        """Build the model from (P, N, 3) corresponded vertices and their (F, 3) faces.

        Meshes are aligned rigidly (size is part of shape); the modes kept explain `explained` of the variance.

        Raises:
            ConfigError: fewer than three meshes, or another shape of array.
        """
        shapes = np.asarray(points, dtype=np.float64)
        if shapes.ndim != 3 or shapes.shape[2] != 3 or len(shapes) < 3:
            raise ConfigError("at least three meshes as (P, N, 3)", str(shapes.shape), "stack corresponded vertices")
        aligned = _align(shapes)
        mean = aligned.mean(axis=0)
        _, singular, modes = np.linalg.svd((aligned - mean).reshape(len(shapes), -1), full_matrices=False)
        variance = singular**2 / (len(shapes) - 1)
        kept = int(np.searchsorted(np.cumsum(variance) / variance.sum(), explained)) + 1
        kept = min(kept, len(shapes) - 1)
        modes = modes[:kept].reshape(kept, *mean.shape)
        return cls(mean, modes, np.sqrt(variance[:kept]), np.asarray(faces, dtype=np.int64), tuple(people))

    def shape(self, coefficients: ArrayLike) -> Surface:
        """The mesh at `coefficients` (K,), in standard deviations of the modes; zeros give the mean."""
        weights = np.asarray(coefficients, dtype=np.float64) * self.deviations
        return Surface(self.mean + np.tensordot(weights, self.modes, axes=1), self.faces)

    def coefficients(self, points: ArrayLike) -> Array:
        """(K,) standard deviations at which the model is nearest to an aligned corresponded mesh (N, 3)."""
        shape = np.asarray(points, dtype=np.float64)
        offset = se3.apply(se3.kabsch(shape, self.mean), shape) - self.mean
        return np.tensordot(self.modes, offset, axes=2) / self.deviations

    def sample(
        self, rng: np.random.Generator, within: float = 2.0, large_mm: float = 1.0, small_mm: float = 0.2
    ) -> Surface:
        """A new bone: normal coefficients, none beyond `within` standard deviations, then smooth local variation.

        Args:
            rng: the only source of chance.
            within: the data's spread, in standard deviations.
            large_mm: root mean square of waves of 80-250 mm, `small_mm` of 15-50 mm; zeros leave the model's shape.
            small_mm: see `large_mm`.
        """
        coefficients = rng.normal(size=len(self.deviations))
        while (outside := np.abs(coefficients) > within).any():
            coefficients[outside] = rng.normal(size=int(outside.sum()))
        return deform(self.shape(coefficients), rng, large_mm, small_mm)


def from_anatomy(folder: str | Path, bone: str) -> list[ShapeModel]:
    """One model for each corresponded set of the bone, of the people of `train` in `splits.json` and of nobody else.

    Raises:
        ConfigError: no such folder or splits, or too few train people.
    """
    people = anatomy.splits(folder)
    held_out = set(people["val"]) | set(people["test"])
    models = []
    for meshes in (c.of(people["train"]) for c in anatomy.corresponded(folder, bone)):
        assert not held_out & set(meshes.person)
        models.append(ShapeModel.fit(meshes.points, meshes.faces, meshes.person))
    return models


def _align(shapes: Array, rounds: int = 3) -> Array:
    """Rigid generalised Procrustes: every shape laid on the mean of all, a few times."""
    mean = shapes[0] - shapes[0].mean(axis=0)
    for _ in range(rounds):
        aligned = np.stack([se3.apply(se3.kabsch(shape, mean), shape) for shape in shapes])
        mean = aligned.mean(axis=0)
    return aligned
