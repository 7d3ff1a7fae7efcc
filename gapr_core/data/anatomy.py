"""Bones of real subjects: corresponded meshes with splits by subject, CT surfaces, and a folder of one's own meshes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gapr_core.clouds import check_extent, load
from gapr_core.data.specimen import Specimen
from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_core.formats.reading import ending_of
from gapr_core.geometry.extent import is_point
from gapr_core.runtime import files
from gapr_core.surface import Surface, check_faces

Array = NDArray[np.float64]
BONES = ("femur", "tibia", "pelvis", "thoracic")
SPLITS = ("train", "val", "test")
MESHES = (".ply", ".stl", ".obj", ".vtk", ".vtp", ".npz", ".nii", ".nii.gz", ".nrrd", ".mha", ".dcm")  # they give faces


@dataclass(frozen=True)
class Corresponded:
    """Meshes in vertex correspondence: points (P, N, 3) mm, faces (F, 3), `person` (P,), and the cohort's name."""

    points: Array
    faces: NDArray[np.int64]
    person: tuple[str, ...]
    bone: str
    cohort: str

    def of(self, people: Iterable[str]) -> Corresponded:
        """Only the meshes of these subjects."""
        wanted = set(people)
        rows = [row for row, person in enumerate(self.person) if person in wanted]
        kept = tuple(self.person[row] for row in rows)
        return Corresponded(self.points[rows], self.faces, kept, self.bone, self.cohort)

    def specimens(self) -> list[Specimen]:
        """Make one specimen for each subject."""
        return [
            Specimen(Surface(points, self.faces), self.bone, person, self.cohort)
            for points, person in zip(self.points, self.person, strict=True)
        ]


def splits(folder: str | Path) -> dict[str, list[str]]:
    """Subjects of train, val and test from `splits.json`; a subject stands in one split only, over all bones.

    Raises:
        ConfigError: no such file, a damaged one, another key, or a subject in two splits.
    """
    path, expected = Path(folder) / "splits.json", "splits.json with subjects of train, val and test"
    if not path.is_file():
        raise ConfigError(expected, f"none in {folder}", "write one")
    people = files.read_json(path, expected)
    how = 'write {"train": [NAME, ...], "val": [...], "test": [...]}'
    if not isinstance(people, dict):
        raise ConfigError(expected, f"{path} ({type(people).__name__})", how)
    if set(people) != set(SPLITS):
        raise ConfigError(f"the keys {', '.join(SPLITS)}", f"{', '.join(people)} in {path}", "rename them")
    if not all(isinstance(names, list) and all(isinstance(name, str) for name in names) for names in people.values()):
        raise ConfigError(expected, f"{path} (a key without a list of names)", how)
    everybody = [person for split in SPLITS for person in people[split]]
    twice = sorted({person for person in everybody if everybody.count(person) > 1})
    if twice:
        raise ConfigError("each subject once over all splits", f"{', '.join(twice)} more than once", "keep one of them")
    return {split: list(people[split]) for split in SPLITS}


def corresponded(folder: str | Path, bone: str) -> list[Corresponded]:
    """Read all `<bone>_<cohort>.npz` of the folder (points (P, N, 3), faces (F, 3), `person` (P,)); may be empty.

    Raises:
        ConfigError: no such folder.
        InvalidPointCloudError: a file that cannot be read, has other arrays, or a subject twice.
    """
    if not Path(folder).is_dir():
        raise ConfigError("a folder with anatomy", f"{folder}, which does not exist", "name it with --anatomy")
    return [_corresponded(path, bone) for path in sorted(Path(folder).glob(f"{bone}_*.npz"))]


def _corresponded(path: Path, bone: str) -> Corresponded:
    try:
        with np.load(path, allow_pickle=False) as data:
            points, faces = data["points"].astype(np.float64), data["faces"].astype(np.int64)
            person = tuple(str(p) for p in data["person"])
    except KeyError as error:
        raise _unreadable(path, f"no array {error}") from error
    except Exception as error:  # NumPy, zipfile and zlib raise many kinds
        raise _unreadable(path, " ".join(str(error).split())) from error
    if points.ndim != 3 or points.shape[::2] != (len(person), 3) or faces.ndim != 2 or faces.shape[1] != 3:
        raise _unreadable(path, f"points {points.shape}, faces {faces.shape} and {len(person)} subjects")
    if twice := sorted({name for name in person if person.count(name) > 1}):
        raise _unreadable(path, f"{', '.join(twice)} more than once in `person`")
    return Corresponded(points, faces, person, bone, path.stem.removeprefix(f"{bone}_"))


def _unreadable(path: Path, why: str) -> InvalidPointCloudError:
    wanted = "an .npz with points (P, N, 3), faces (F, 3) and `person` (P,)"
    return InvalidPointCloudError(wanted, f"{path} ({why})", "write it again")


def surfaces(folder: str | Path, bone: str, split: str = "all", cohort: str | None = None) -> list[Specimen]:
    """List the bones of one type of the subjects of one split, by cohort and subject.

    Args:
        folder: layout as in `../shared/anatomy`.
        bone: "femur", "tibia", "pelvis" or any other name that the folder has.
        split: "train", "val", "test" or "all".
        cohort: None for every corresponded set; "gias2" and the like for single meshes, `surfaces/<bone>/<cohort>_*`,
            which carry the ids of the same subjects ("gias2_2008_0051_l.ply" is subject "llp26_2008_0051").

    Raises:
        ConfigError: no such folder or an unknown split.
        InvalidPointCloudError: a damaged file of meshes, or a mesh of the split that is no bone in mm.
    """
    folder = Path(folder)
    sets = corresponded(folder, bone)
    specimens = [s for c in sets for s in c.specimens() if cohort in (None, c.cohort)]
    if cohort is not None and not specimens:
        specimens = _single_meshes(folder, bone, cohort)
    chosen = specimens if split == "all" else _of_split(specimens, split, splits(folder))
    for specimen in chosen:
        _check_mesh(specimen)
    return chosen


def _check_mesh(specimen: Specimen) -> None:
    """Raise `InvalidPointCloudError` where a mesh has points or faces that are none, or is not in mm."""
    surface, name = specimen.surface, f"{specimen.bone} of {specimen.person} ({specimen.cohort})"
    if not is_point(surface.points).all():
        raise InvalidPointCloudError("finite points", f"NaN or infinity in the {name}", "leave the subject out")
    if surface.faces is not None and len(surface.faces):
        check_faces(surface, f"the {name}")
    check_extent(surface.extent_mm, "mm", f"the {name}", "convert it to mm")


def _single_meshes(folder: Path, bone: str, cohort: str) -> list[Specimen]:
    paths = sorted((folder / "surfaces" / bone).glob(f"{cohort}_*.ply"))
    return [Specimen(load(path), bone, _person_of(path.stem), cohort) for path in paths]


def _person_of(stem: str) -> str:
    """gias2_<id>_l and llp26_<id> are scans of the same subject."""
    return stem.removesuffix("_l").removesuffix("_r").replace("gias2_", "llp26_")


def meshes(folder: str | Path, bone: str | None = None, split: str = "all", units: str = "mm") -> list[Specimen]:
    """Read a user's own meshes, one file per subject, in any format with faces (`MESHES`); ignore other files.

    `folder/<person>.stl` are all of one bone, named `bone` or after the folder; `folder/<bone>/<person>.stl` are of
    several. With `splits.json` in the folder subjects are split by it, else 60/20/20 in an order drawn once from a
    fixed seed (adding subjects changes it: write `splits.json` to freeze it).

    Raises:
        ConfigError: no such folder, no meshes there, two files of one subject, or an unknown split.
        InvalidPointCloudError: an unreadable file, one without faces, or one of a size that no bone has.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ConfigError("a folder with meshes", f"{folder}, which does not exist", "check the path")
    flat, nested = _mesh_files(folder), {d.name: _mesh_files(d) for d in sorted(folder.glob("*")) if d.is_dir()}
    if flat and any(nested.values()):
        names = ", ".join([flat[0].name, *(name for name, found in nested.items() if found)][:4])
        raise ConfigError("meshes of one bone, or a folder for each bone", f"both ({names})", "move the files")
    of_bone = {bone or folder.resolve().name: flat} if flat else {b: f for b, f in nested.items() if bone in (None, b)}
    for found in of_bone.values():
        _check_alone(found)
    specimens = [Specimen(load(f, units), b, _stem(f), "meshes") for b, found in of_bone.items() for f in found]
    if not specimens:
        raise ConfigError(
            f"meshes ({' '.join(MESHES)})",
            f"none for {bone or 'any bone'} in {folder}",
            "put one mesh per subject there, or one sub-folder per bone",
        )
    if split == "all":
        return specimens
    known = splits(folder) if (folder / "splits.json").is_file() else _draw_splits({s.person for s in specimens})
    return _of_split(specimens, split, known)


def meshes_hash(folder: str | Path, bones: Sequence[str], split: str = "all") -> str:
    """sha256 over names and contents of the files that `meshes` reads for these bones, and of their split."""
    folder = Path(folder)
    found = _mesh_files(folder) or [file for bone in sorted(bones) for file in _mesh_files(folder / bone)]
    if split != "all" and (folder / "splits.json").is_file():
        found = [*found, folder / "splits.json"]
    return _hash_of(found, folder)


def is_flat(folder: str | Path) -> bool:
    """Check whether `meshes` takes the files of a folder for one bone."""
    return bool(_mesh_files(Path(folder)))


def corresponded_hash(folder: str | Path) -> str:
    """sha256 over names and contents of the files that `surfaces` reads by default, of all bones, and splits.json."""
    folder = Path(folder)
    found = [*sorted(folder.glob("*.npz")), *folder.glob("splits.json")]
    return _hash_of(found, folder)


def _hash_of(found: Sequence[Path], folder: Path) -> str:
    digest = sha256()
    for file in found:
        digest.update(f"{file.relative_to(folder).as_posix()} {sha256(file.read_bytes()).hexdigest()}\n".encode())
    return digest.hexdigest()


def _mesh_files(folder: Path) -> list[Path]:
    """Those that are not hidden: macOS leaves `._NAME` of each on other disks."""
    return sorted(p for p in folder.glob("*") if ending_of(p) in MESHES and not p.name.startswith("."))


def _check_alone(files: Sequence[Path]) -> None:
    """Raise `ConfigError` for two files of one subject, such as .stl and .ply: it would count twice."""
    whose: dict[str, Path] = {}
    for file in files:
        if (other := whose.setdefault(_stem(file), file)) != file:
            given = f"{other.name} and {file.name}"
            raise ConfigError("one mesh for each subject and bone", given, "take one of them out, or rename it")


def _stem(path: Path) -> str:
    """Whose mesh a file holds."""
    return path.name[: -len(ending_of(path))]


def _draw_splits(people: set[str]) -> dict[str, list[str]]:
    order = [str(p) for p in np.random.default_rng(0).permutation(sorted(people))]
    held_out = max(1, round(0.2 * len(order)))
    return {"test": order[:held_out], "val": order[held_out : 2 * held_out], "train": order[2 * held_out :]}


def _of_split(specimens: list[Specimen], split: str, people: dict[str, list[str]]) -> list[Specimen]:
    if split not in people:
        raise ConfigError(f"a split of {', '.join(SPLITS)} or all", repr(split), "choose one of these")
    wanted = set(people[split])
    return [specimen for specimen in specimens if specimen.person in wanted]


def mirrored(specimen: Specimen) -> Specimen:
    """Mirror a bone to the other side of the same subject."""
    return replace(specimen, surface=specimen.surface.mirrored())
