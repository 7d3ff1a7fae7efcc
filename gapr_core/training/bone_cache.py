"""Bones in use as files of one folder, so that all workers of all processes draw each of them once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gapr_core.data.specimen import Specimen
from gapr_core.model.pyramid import Frame
from gapr_core.model.types import Cloud, Level, Neighborhood
from gapr_core.runtime import files
from gapr_core.surface import Surface

Array = NDArray[np.float64]
NAMES = ("bone", "person", "cohort")


@dataclass
class PooledBone:
    """A bone in use.

    Attributes:
        specimen: the bone.
        points: (8192, 3) mm, the sample of it that the target is made of.
        frame, target: the target's pyramid in a frame of its own.
        turn: (4, 4) takes the scan's frame to the target's.
        subjects: whose bones it was made of.
    """

    specimen: Specimen
    points: Array
    frame: Frame
    target: Cloud
    turn: Array
    subjects: tuple[str, ...]


def save(path: Path, bone: PooledBone) -> None:
    """Write one bone; the file appears whole or not at all."""
    surface = bone.specimen.surface
    arrays: dict[str, Any] = {
        "vertices": surface.points, "faces": surface.triangles, "points": bone.points, "turn": bone.turn,
        "frame": np.array([bone.frame.scale_mm, bone.frame.voxel]), "subjects": np.array(bone.subjects, dtype=str),
        "names": np.array([getattr(bone.specimen, name) for name in NAMES]),
        "cloud.fine_stage": np.array(bone.target.fine_stage), "cloud.stages": np.array(len(bone.target.levels)),
    }  # fmt: skip
    for name in ("patches", "patches_valid", "centre_mm", "scale_mm"):
        arrays[f"cloud.{name}"] = getattr(bone.target, name).numpy()
    for stage, level in enumerate(bone.target.levels):
        arrays |= _level_arrays(f"{stage}.", level)
    with files.replacing(path) as partial, partial.open("wb") as file:
        np.savez(file, **arrays)


def load(path: Path) -> PooledBone:
    """Load the stored bone, bit by bit."""
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    specimen = Specimen(Surface(arrays["vertices"], arrays["faces"]), *(str(name) for name in arrays["names"]))
    names = ("patches", "patches_valid", "centre_mm", "scale_mm")
    tensors = {name: torch.from_numpy(arrays[f"cloud.{name}"]) for name in names}
    levels = tuple(_level(f"{stage}.", arrays) for stage in range(int(arrays["cloud.stages"])))
    target = Cloud(levels=levels, fine_stage=int(arrays["cloud.fine_stage"]), **tensors)
    frame = Frame(*(float(value) for value in arrays["frame"]))
    subjects = tuple(str(name) for name in arrays["subjects"])
    return PooledBone(specimen, arrays["points"], frame, target, arrays["turn"], subjects)


def prune(folder: Path, first: int) -> None:
    """Delete the bones with numbers below `first`, which no pair will ask for again."""
    for path in folder.glob("*.npz"):
        if path.stem.isdecimal() and int(path.stem) < first:
            path.unlink(missing_ok=True)


def _level_arrays(prefix: str, level: Level) -> dict[str, Any]:
    arrays = {f"{prefix}{name}": getattr(level, name).numpy() for name in ("points", "normals", "certainty")}
    for name, hood in (("within", level.within), ("below", level.below)):
        if hood is not None:
            arrays |= {f"{prefix}{name}.{f.name}": getattr(hood, f.name).numpy() for f in fields(hood)}
    return arrays if level.up is None else arrays | {f"{prefix}up": level.up.numpy()}


def _level(prefix: str, arrays: Mapping[str, Any]) -> Level:
    points, normals, certainty = (torch.from_numpy(arrays[f"{prefix}{n}"]) for n in ("points", "normals", "certainty"))
    within, below = (_hood(f"{prefix}{name}.", arrays) for name in ("within", "below"))
    up = torch.from_numpy(arrays[f"{prefix}up"]) if f"{prefix}up" in arrays else None
    assert within is not None
    return Level(points, normals, certainty, (len(points),), within, below, up)


def _hood(prefix: str, arrays: Mapping[str, Any]) -> Neighborhood | None:
    if f"{prefix}index" not in arrays:
        return None
    return Neighborhood(*(torch.from_numpy(arrays[f"{prefix}{f.name}"]) for f in fields(Neighborhood)))
