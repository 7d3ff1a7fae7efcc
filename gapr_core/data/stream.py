"""A probe that wanders over a bone which moves: one-sided views, frame by frame, with the true pose of each. Seeded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gapr_core.data import degradation
from gapr_core.data.pair import TARGET_POINTS, TRANSLATION_MM, Pair
from gapr_core.data.specimen import Specimen
from gapr_core.geometry import extent, se3
from gapr_core.geometry.sampling import random_directions

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """Settings of a stream.

    Attributes:
        frames: clouds of the stream.
        share: of the whole surface, in one view.
        points: of one view at most.
        noise_mm, bias_mm, outlier_share: as in `protocols.Level`.
        smooth_bias: its kind, a key of `smooth_bias.SMOOTH_BIASES`.
        bias_stays: the smooth bias is the same in all frames, as that of soft tissue; else each frame has its own.
        step_mm, step_deg: largest motion of the bone from frame to frame, about its own centre.
        jump_every: after so many frames the bone is somewhere else altogether; 0: never.
        swing_deg: how far the probe goes around the bone, to either side.
    """

    frames: int = 24
    share: float = 0.2
    points: int = 1500
    noise_mm: float = 1.0
    bias_mm: float = 0.7
    outlier_share: float = 0.05
    smooth_bias: str = "waves-peak"
    bias_stays: bool = False
    step_mm: float = 3.0
    step_deg: float = 2.0
    jump_every: int = 0
    swing_deg: float = 40.0


def simulate(specimen: Specimen, seed: int, motion: Motion | None = None) -> list[Pair]:
    """Simulate the stream's frames as pairs of one common target, protocol `stream`."""
    motion = motion or Motion()
    rng = np.random.default_rng([seed, 23])
    target, _ = specimen.sample(TARGET_POINTS, rng)
    origin = target.mean(axis=0)
    bone, normals = specimen.sample(20_000, rng)
    points, axis = bone, extent.principal(bone).axes[0]
    towards = np.cross(axis, random_directions(1, rng)[0])
    towards /= np.linalg.norm(towards)
    pose = _anywhere(rng)
    if motion.bias_stays:
        points = points + degradation.bias_along_normals(points, normals, motion.bias_mm, rng, motion.smooth_bias)
    pairs = []
    for frame in range(motion.frames):
        if frame:
            pose = _next_pose(pose, frame, motion, rng)
        at = frame / max(motion.frames - 1, 1)
        seen = rng.permutation(_view(specimen, bone, axis, towards, at, motion))[: motion.points]
        source = se3.apply(pose, _measured(specimen, points[seen], normals[seen], motion, rng) - origin)
        name = f"stream_{specimen.bone}_{specimen.person}_{seed}_{frame:03d}"
        facts = specimen.bone, specimen.person, "stream", {"origin_mm": origin}
        pairs.append(Pair(source, target - origin, se3.inverse(pose), name, *facts))
    return pairs


def _measured(specimen: Specimen, points: Array, normals: Array, motion: Motion, rng: np.random.Generator) -> Array:
    """Points of one frame with its errors; a smooth bias that stays is in the points already."""
    bias_mm = 0.0 if motion.bias_stays else motion.bias_mm
    return degradation.measured(
        specimen, points, normals, motion.noise_mm, bias_mm, motion.outlier_share, rng, motion.smooth_bias
    )


def _view(
    specimen: Specimen, points: Array, axis: Array, towards: Array, at: float, motion: Motion
) -> NDArray[np.intp]:
    """Find the surface points in view at `at` (0 to 1) of the probe's way along the bone and back."""
    swing = Rotation.from_rotvec(axis * np.radians(motion.swing_deg) * np.sin(4.0 * np.pi * at))
    seen = np.flatnonzero(specimen.visible_from(points, swing.apply(towards)))
    along = points[seen] @ axis
    place = along.min() + np.ptp(along) * (0.5 - 0.4 * np.cos(2.0 * np.pi * at))
    centre = points[seen[np.abs(along - place).argmin()]]
    nearest = ((points[seen] - centre) ** 2).sum(axis=1).argsort(kind="stable")
    return seen[nearest[: round(motion.share * len(points))]]


def _anywhere(rng: np.random.Generator) -> Array:
    """T_source_target of a bone somewhere in the room."""
    return se3.from_rotation_translation(se3.random_rotation(rng), rng.uniform(-TRANSLATION_MM, TRANSLATION_MM, 3))


def _next_pose(pose: Array, frame: int, motion: Motion, rng: np.random.Generator) -> Array:
    """T_source_target of a frame after `pose`, that of the one before: a step further, or somewhere else altogether."""
    jumps = motion.jump_every and frame % motion.jump_every == 0
    return _anywhere(rng) if jumps else pose @ _step(motion, rng)


def _step(motion: Motion, rng: np.random.Generator) -> Array:
    turn = np.radians(rng.uniform(0.0, motion.step_deg)) * random_directions(1, rng)[0]
    shift = rng.uniform(0.0, motion.step_mm) * random_directions(1, rng)[0]
    return se3.exp(np.concatenate([shift, turn]))
