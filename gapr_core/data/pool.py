"""Where the bones of a list of pairs come from: subjects in a folder, a user's own meshes, or parametric subjects."""

from __future__ import annotations

from pathlib import Path

from gapr_core.data import anatomy
from gapr_core.data.parametric import make_bone
from gapr_core.data.specimen import Specimen
from gapr_core.errors import ConfigError

PARAMETRIC_SPLIT = {"train": (0, 1, 2), "val": (3,), "test": (4,)}  # of the subject's number modulo 5


def parametric_people(split: str, count: int) -> list[int]:
    """List the numbers (seeds of `make_bone`) of the first `count` subjects of a split; splits share none."""
    if split == "all":
        return list(range(count))
    if split not in PARAMETRIC_SPLIT:
        raise ConfigError(f"a split of {', '.join(PARAMETRIC_SPLIT)} or all", repr(split), "choose one of these")
    residues = PARAMETRIC_SPLIT[split]
    return [5 * (i // len(residues)) + residues[i % len(residues)] for i in range(count)]


def parametric_split(person: str) -> str | None:
    """Find the split of a parametric subject by name, "parametric_7"; None for anybody else."""
    prefix, _, number = person.rpartition("_")
    if prefix != "parametric" or not number.isdecimal():
        return None
    return next(split for split, residues in PARAMETRIC_SPLIT.items() if int(number) % 5 in residues)


def parametric_specimen(bone: str, number: int) -> Specimen:
    """Make the bone of parametric subject `number`; all bones of one number are of one subject."""
    return Specimen(make_bone(bone, number), bone, f"parametric_{number}", "parametric")


def specimens(
    bone: str,
    split: str = "all",
    people: int = 20,
    anatomy_folder: str | Path | None = None,
    meshes_folder: str | Path | None = None,
    units: str = "mm",
) -> list[Specimen]:
    """List the bones of one type to make pairs from.

    A `meshes_folder` or an `anatomy_folder` gives everybody of the split. Without one, or if the anatomy folder has no
    mesh of this bone in any split, the first `people` parametric ones are taken (cohort "parametric").
    """
    if meshes_folder is not None:
        return anatomy.meshes(meshes_folder, bone, split, units)
    if anatomy_folder is not None and anatomy.corresponded(anatomy_folder, bone):
        return anatomy.surfaces(anatomy_folder, bone, split)
    return [parametric_specimen(bone, number) for number in parametric_people(split, people)]


def bones_in(meshes_folder: str | Path, units: str = "mm") -> list[str]:
    """List the bone names that a folder of meshes in this unit holds."""
    return sorted({s.bone for s in anatomy.meshes(meshes_folder, units=units)})
