"""Frames of a camera that circles a wound while the bone moves, with the true pose. Seeded."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.pair import TARGET_POINTS, TRANSLATION_MM, Pair
from gapr_core.data.scenes.camera import Camera, View, measured, see, upright
from gapr_core.data.scenes.scene import MOST_POINTS, SCENE_LEVELS, TRIES, Setting, arrange, shown
from gapr_core.data.specimen import Specimen
from gapr_core.errors import ConfigError
from gapr_core.geometry import se3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SceneMotion:
    """Settings of a stream of scenes.

    Attributes:
        frames: clouds of the stream.
        level: a name of `SCENE_LEVELS`; the region of interest rests in the room and has the bone's share of this level
            in the first frame; "scene-image" has none.
        distance_mm, off_deg: of the camera from the wound and its axis, which it circles once.
        sway_mm, sway_deg: how far the bone moves to either side, about the wound, twice in the stream.
        in_room: the frames are in one frame at rest; else in the camera's own, with the viewpoint at the origin.
    """

    frames: int = 200
    level: str = "scene-C2"
    distance_mm: float = 450.0
    off_deg: float = 20.0
    sway_mm: float = 10.0
    sway_deg: float = 5.0
    in_room: bool = False


class _Stage(NamedTuple):
    """Parts that stay the same over a stream; the scene is arranged in the bone's frame of the first image."""

    setting: Setting
    region_mm: float  # radius
    sway: Array  # (6,) twist of the bone at the end of its way to one side
    T_room_scene: Array
    target: Array


def simulate(specimen: Specimen, seed: int, motion: SceneMotion | None = None) -> Iterator[Pair]:
    """Simulate frames as pairs of one common target, protocol `scene-stream`, with the metadata of a scene.

    Raises:
        ConfigError: a bone on which no wound shows the level's share of bone.
    """
    motion = motion or SceneMotion()
    rng = np.random.default_rng([seed, 29])
    stage = _prepare(specimen, rng, motion)
    for frame in range(motion.frames):
        at = 2.0 * np.pi * frame / motion.frames
        camera, T_scene_bone = _camera(stage.setting, motion, at), _moved(stage, at)
        view = _view(stage, camera, T_scene_bone, rng)
        T_source_scene = stage.T_room_scene if motion.in_room else _to_camera(camera)
        name = f"scene-stream_{specimen.bone}_{specimen.person}_{seed}_{frame:03d}"
        yield _pair(name, specimen, stage.target, view, T_source_scene @ T_scene_bone, rng)


def _prepare(specimen: Specimen, rng: np.random.Generator, motion: SceneMotion) -> _Stage:
    target, _ = specimen.sample(TARGET_POINTS, rng)
    shift, turn = (axis / np.linalg.norm(axis) for axis in rng.normal(size=(2, 3)))
    sway = np.concatenate([motion.sway_mm * shift, np.radians(motion.sway_deg) * turn])
    at = rng.uniform(-TRANSLATION_MM, TRANSLATION_MM, 3)
    T_room_scene = se3.from_rotation_translation(se3.random_rotation(rng), at)
    setting, radius = _first(specimen, rng, motion)
    return _Stage(setting, radius, sway, T_room_scene, target)


def _first(specimen: Specimen, rng: np.random.Generator, motion: SceneMotion) -> tuple[Setting, float]:
    """Draw a wound whose first image shows the level's share of bone, and the region's radius, mm."""
    level = SCENE_LEVELS[motion.level]
    for _ in range(TRIES):
        setting = arrange(specimen, rng, level)
        view = see(setting.parts, _camera(setting, motion, 0.0))
        chosen = shown(view, setting.wound.centre, level, rng)
        if chosen is not None:
            reach = np.linalg.norm(view.points[chosen] - setting.wound.centre, axis=1).max()
            return setting, np.inf if level.whole_image else float(reach)
    raise ConfigError(
        f"a bone of which a wound shows the share of {motion.level}",
        f"{specimen.bone} of {specimen.person}: none in {TRIES} wounds",
        "choose another bone, level or seed",
    )


def _camera(setting: Setting, motion: SceneMotion, at: float) -> Camera:
    """`at` radians on its circle about the wound as it was in the first frame."""
    off, wound = np.radians(motion.off_deg), setting.wound
    direction = np.array([np.sin(off) * np.cos(at), np.sin(off) * np.sin(at), np.cos(off)])
    return upright(wound.centre, wound.at(motion.distance_mm * direction), wound.axes[0])


def _moved(stage: _Stage, at: float) -> Array:
    """T_scene_bone: to one side, to the other and back, twice; the identity in the first frame."""
    return se3.exp(np.sin(2.0 * at) * stage.sway, stage.setting.wound.centre)


def _to_camera(camera: Camera) -> Array:
    """T_camera_scene."""
    return se3.from_rotation_translation(camera.axes, -camera.axes @ camera.position)


def _view(stage: _Stage, camera: Camera, T_scene_bone: Array, rng: np.random.Generator) -> View:
    """View the region of interest, at most 8000 points, in the bone's frame."""
    T_bone_scene = se3.inverse(T_scene_bone)
    position, middle = se3.apply(T_bone_scene, np.stack([camera.position, stage.setting.wound.centre]))
    view = see(stage.setting.parts, Camera(position, camera.axes @ T_scene_bone[:3, :3]))
    inside = np.flatnonzero(np.linalg.norm(view.points - middle, axis=1) <= stage.region_mm)
    return view.of(rng.permutation(inside)[:MOST_POINTS])


def _pair(
    name: str, specimen: Specimen, target: Array, view: View, T_source_bone: Array, rng: np.random.Generator
) -> Pair:
    origin, is_bone = target.mean(axis=0), view.part == 0
    T_bone_target = se3.from_rotation_translation(np.eye(3), origin)
    return Pair(
        source=se3.apply(T_source_bone, measured(view, rng)),
        target=target - origin,
        T_target_source=se3.inverse(T_source_bone @ T_bone_target),
        name=name,
        bone=specimen.bone,
        person=specimen.person,
        protocol="scene-stream",
        metadata={
            "viewpoint": se3.apply(T_source_bone, view.camera[None])[0],
            "is_bone": is_bone,
            "bone_share": float(is_bone.mean()) if len(is_bone) else 0.0,
            "origin_mm": origin,
        },
    )
