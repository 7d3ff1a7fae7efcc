"""New subjects for training: a statistical shape model of the corresponded meshes of the training split."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.anatomy import Corresponded
from gapr_core.data.deformation import deform
from gapr_core.geometry import se3
from gapr_core.surface import Surface

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ShapeModel:
    """Mean and deviations of P aligned subjects: `mean` (N, 3) mm, `deviations` (P, N, 3) mm, `faces` (F, 3)."""

    mean: Array
    deviations: Array
    faces: NDArray[np.int64]

    @classmethod
    def of(cls, people: Corresponded, rounds: int = 3) -> ShapeModel:
        """Generalised Procrustes alignment without scaling: size is part of the shape."""
        points = np.asarray(people.points, dtype=np.float64)
        mean = points[0]
        for _ in range(rounds):
            points = np.stack([se3.apply(se3.kabsch(p, mean), p) for p in points])
            mean = points.mean(axis=0)
        return cls(mean, points - mean, np.asarray(people.faces, dtype=np.int64))

    def draw(self, rng: np.random.Generator) -> Surface:
        """Draw a subject of the Gaussian over the subjects, equal to drawing every principal component."""
        weights = rng.normal(size=len(self.deviations)) / np.sqrt(max(len(self.deviations) - 1, 1))
        return Surface(self.mean + np.tensordot(weights, self.deviations, axes=1), self.faces, None)


def vary(surface: Surface, rng: np.random.Generator) -> Surface:
    """Vary a bone to another subject's: up to 10 % in size, other waves and texture, either side."""
    changed = deform(replace(surface, points=surface.points * rng.uniform(0.9, 1.1)), rng)
    return changed if rng.random() < 0.5 else changed.mirrored()
