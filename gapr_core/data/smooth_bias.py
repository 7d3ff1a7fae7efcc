"""Smooth errors of a measured surface: one plane wave, a sum of waves, a Gaussian process; sized in three ways."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from gapr_core.geometry.sampling import random_directions

Array = NDArray[np.float64]
SmoothBias = Callable[[Array, float, np.random.Generator], Array]

WAVES, WAVELENGTH_MM = 4, (60.0, 120.0)
CORRELATION_MM = (15.0, 30.0)  # l of the process's correlation exp(-d^2 / 2 l^2)
FEATURES = 200  # random Fourier features of the process (Rahimi and Recht 2007)


def waves(points: Array, rng: np.random.Generator) -> Array:
    """Add plane waves of 60 to 120 mm with normal weights at points (N, 3), variance `WAVES` / 2."""
    wave_vectors = random_directions(WAVES, rng) * (2.0 * np.pi / rng.uniform(*WAVELENGTH_MM, (WAVES, 1)))
    phases, weights = rng.uniform(0.0, 2.0 * np.pi, WAVES), rng.normal(size=WAVES)
    return np.asarray(np.sin(points @ wave_vectors.T + phases) @ weights)


def wave(points: Array, rng: np.random.Generator) -> Array:
    """Draw one plane wave of 60 to 120 mm and amplitude 1 at points (N, 3), mm."""
    wave_vector = random_directions(1, rng)[0] * (2.0 * np.pi / rng.uniform(*WAVELENGTH_MM))
    return np.asarray(np.sin(points @ wave_vector + rng.uniform(0.0, 2.0 * np.pi)))


def process(points: Array, rng: np.random.Generator) -> Array:
    """(N,) a draw of a Gaussian process of variance 1 and correlation exp(-d^2 / 2 l^2) at points (N, 3), mm."""
    wave_vectors = rng.normal(0.0, 1.0 / rng.uniform(*CORRELATION_MM), (FEATURES, 3))
    phases = rng.uniform(0.0, 2.0 * np.pi, FEATURES)
    return np.asarray(np.sqrt(2.0 / FEATURES) * np.cos(points @ wave_vectors.T + phases).sum(axis=1))


def _peak(field: Array) -> float:
    return float(np.abs(field).max())


def _rms(field: Array) -> float:
    return float(np.sqrt((field**2).mean()))


SHAPES = {"wave": wave, "waves": waves, "gp": process}
SIZES = {"rms": _rms, "peak": _peak}  # what a size in mm is of: the root mean square or the peak over these very points


def _offsets(shape: str, size: str, points: Array, size_mm: float, rng: np.random.Generator) -> Array:
    field = SHAPES[shape](points, rng)
    return np.asarray(size_mm * field / max(SIZES[size](field), 1e-9))


def _plane_wave(points: Array, amplitude_mm: float, rng: np.random.Generator) -> Array:
    return amplitude_mm * wave(points, rng)


SMOOTH_BIASES: dict[str, SmoothBias] = {
    "wave": _plane_wave,  # its size is its amplitude, wherever the points are
    **{f"{shape}-{size}": partial(_offsets, shape, size) for shape in SHAPES for size in SIZES},
}
"""Offsets (N,), mm, along the normals at points (N, 3): `SMOOTH_BIASES["gp-rms"](points, size_mm, rng)`."""
