"""A tracked probe that sweeps along a bone: the one-sided cloud it has collected, frame by frame. All in mm, seeded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gapr_core.data import degradation
from gapr_core.data.specimen import Specimen
from gapr_core.geometry import extent, se3
from gapr_core.geometry.sampling import random_directions

Array = NDArray[np.float64]

ANTERIOR = np.array([0.0, -1.0, 0.0])  # the patient lies on the back: x to the left, y backwards, z up


@dataclass(frozen=True)
class Acquisition:
    """How the probe moves and how well it measures.

    Attributes:
        frames: clouds in the sweep; each holds all points so far.
        width_mm, slab_mm: extent of the probe's view at one place, across and along its way.
        swing_deg: how far the probe swings around the bone's axis, to either side, on its way.
        points_per_frame: new points of each frame at most.
        noise_mm, bias_mm: white noise per axis, and smooth error along the normals (its peak).
        outlier_share: share of the points that lie 3 to 15 mm off the bone.
    """

    frames: int = 24
    width_mm: float = 45.0
    slab_mm: float = 25.0
    swing_deg: float = 50.0
    points_per_frame: int = 220
    noise_mm: float = 0.7
    bias_mm: float = 0.5
    outlier_share: float = 0.05


@dataclass(frozen=True)
class Sweep:
    """Clouds of a probe: `clouds[k]` (N_k, 3) mm in the tracker's frame, and the truth."""

    clouds: tuple[Array, ...]
    T_target_source: Array


def simulate(specimen: Specimen, seed: int, how: Acquisition | None = None) -> Sweep:
    """Sweep a probe from one end of the bone to the other, on the side that faces the surgeon."""
    how = how or Acquisition()
    rng = np.random.default_rng(seed)
    points, normals = specimen.sample(60_000, rng)
    pieces = [_seen_at(specimen, points, normals, step, how, rng) for step in np.linspace(0.0, 1.0, how.frames)]
    kept = np.concatenate(pieces)
    ends = np.cumsum([len(piece) for piece in pieces])
    measured = _measure(specimen, points[kept], normals[kept], how, rng)
    T_source_target = se3.from_rotation_translation(se3.random_rotation(rng), rng.uniform(-300.0, 300.0, 3))
    in_tracker = se3.apply(T_source_target, measured)
    return Sweep(tuple(in_tracker[:end] for end in ends), se3.inverse(T_source_target))


def _seen_at(
    specimen: Specimen, points: Array, normals: Array, step: float, how: Acquisition, rng: np.random.Generator
) -> NDArray[np.intp]:
    """Indices of the surface points (N, 3) that the probe sees at `step` (0 to 1) of its way."""
    axis = _long_axis(points)
    along = points @ axis
    place = along.min() + step * np.ptp(along)
    swing = Rotation.from_rotvec(axis * np.radians(how.swing_deg) * np.sin(3.0 * np.pi * step))
    towards_probe = swing.apply(ANTERIOR - axis * (axis @ ANTERIOR))
    towards_probe /= np.linalg.norm(towards_probe)
    slab = np.flatnonzero((np.abs(along - place) < how.slab_mm / 2.0) & (np.abs(normals @ towards_probe) > 0.3))
    seen = slab[specimen.visible_from(points[slab], towards_probe)] if len(slab) else slab
    if len(seen) == 0:
        return seen
    across = points[seen] @ np.cross(axis, towards_probe)
    seen = seen[np.abs(across - np.median(across)) < how.width_mm / 2.0]
    return rng.permutation(seen)[: how.points_per_frame]


def _long_axis(points: Array) -> Array:
    """Find the direction (3,) of greatest extent, towards smaller z or x."""
    axis = extent.principal(points).axes[0]
    return -axis * np.sign(axis[np.argmax(np.abs(axis))])


def _measure(specimen: Specimen, points: Array, normals: Array, how: Acquisition, rng: np.random.Generator) -> Array:
    dirty = points + rng.normal(0.0, how.noise_mm, points.shape)
    dirty += degradation.bias_along_normals(points, normals, how.bias_mm, rng)
    outlier = np.flatnonzero(rng.random(len(points)) < how.outlier_share)
    off = rng.uniform(3.0, 15.0, (len(outlier), 1)) * random_directions(len(outlier), rng)
    dirty[outlier] = points[outlier] + off
    return dirty
