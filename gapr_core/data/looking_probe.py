"""Small looks at a bone at rest: a probe that shows one patch at a time, wherever it is asked to. All in mm, seeded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.specimen import Specimen
from gapr_core.geometry import se3

Array = NDArray[np.float64]
SURFACE_POINTS = 30_000  # from which looks are drawn
SAME_SIDE = 0.3  # least cosine between a point's normal and that of the middle


@dataclass(frozen=True)
class LookSize:
    """Extent of a look.

    Attributes:
        patch_mm: diameter.
        points: how many.
        noise_mm: white noise per axis.
        bias_mm: standard deviation of an error along the normals that all points of a look share.
    """

    patch_mm: float = 30.0
    points: int = 60
    noise_mm: float = 1.5
    bias_mm: float = 0.7


class LookingProbe:
    """A tracked probe in front of a bone that rests.

    Args:
        specimen: the bone.
        seed: where the bone is, and the errors of the looks.
        size: of the looks.
    """

    def __init__(self, specimen: Specimen, seed: int, size: LookSize | None = None) -> None:
        self.specimen, self._seed, self._size = specimen, seed, size or LookSize()
        rng = np.random.default_rng([seed, 61])
        self._surface, self._normals = specimen.sample(SURFACE_POINTS, rng)
        T_source_target = se3.from_rotation_translation(se3.random_rotation(rng), rng.uniform(-150.0, 150.0, 3))
        self.T_target_source = se3.inverse(T_source_target)
        self.anywhere = self._surface[rng.integers(SURFACE_POINTS)]  # (3,) bone frame: a random place to begin

    def look(self, centre: Array, number: int) -> Array:
        """Measure the points of one look.

        Args:
            centre: (3,) in the bone's frame; the middle of the look is the nearest point of the surface.
            number: of the look, for its errors.

        Returns:
            (N, 3) in the tracker's frame, at most as many as the size says.
        """
        rng, size = np.random.default_rng([self._seed, number]), self._size
        middle = int(((self._surface - centre) ** 2).sum(axis=1).argmin())
        inside = ((self._surface - self._surface[middle]) ** 2).sum(axis=1) < (size.patch_mm / 2.0) ** 2
        inside &= self._normals @ self._normals[middle] > SAME_SIDE
        seen = rng.permutation(np.flatnonzero(inside))[: size.points]
        points = self._surface[seen] + rng.normal(0.0, size.noise_mm, (len(seen), 3))
        points += rng.normal(0.0, size.bias_mm) * self._normals[seen]
        return se3.apply(se3.inverse(self.T_target_source), points)
