"""Smooth displacement of surfaces: individual variation that no named parameter and no shape mode describes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gapr_core.geometry.sampling import random_directions
from gapr_core.surface import Surface

Array = NDArray[np.float64]
SHAPE_MM, TEXTURE_MM = 1.2, 0.25  # root-mean-square displacements


def smooth_field(
    points: Array, rng: np.random.Generator, rms_mm: float, wavelength_mm: tuple[float, float], waves: int = 12
) -> Array:
    """(N, 3) displacements: plane waves in random directions, of root-mean-square length `rms_mm` over space."""
    lengths = rng.uniform(*wavelength_mm, (waves, 1))
    wave_vectors = random_directions(waves, rng) * (2.0 * np.pi / lengths)
    amplitudes = random_directions(waves, rng) * rms_mm * np.sqrt(2.0 / waves)
    return np.sin(points @ wave_vectors.T + rng.uniform(0.0, 2.0 * np.pi, waves)) @ amplitudes


def deform(surface: Surface, rng: np.random.Generator) -> Surface:
    """Move the surface by waves of 80-250 mm (shape) and 15-50 mm (texture); drop normals, keep faces."""
    moved = surface.points + smooth_field(surface.points, rng, SHAPE_MM, (80.0, 250.0))
    moved = moved + smooth_field(surface.points, rng, TEXTURE_MM, (15.0, 50.0), waves=24)
    return replace(surface, points=moved, normals=None)
