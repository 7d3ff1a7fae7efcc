"""Public real data in the form in which it is published. None of it ships; docs/results/real.md says where it is.

Two forms are known. Pairs are NPZ with `source`, `target` and, if it is known, `transform`. Folders of UltraBones100k
hold `specimenNN/CT_bone_segmentations/BONE.stl` and tracked ultrasound in
`specimenNN/ultrasound_records/BONE/RECORD/3D_reconstructions/**/*.xyz`, in the frame of the CT.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gapr_core import clouds
from gapr_core.data.pair_files import load_pair
from gapr_core.errors import ConfigError
from gapr_core.surface import Surface

Array = NDArray[np.float64]
ENVIRONMENT_VARIABLE = "GAPR_REAL"
MOST_POINTS = 20_000  # of a source; reconstructions have a million
EXPECTED = "a folder with NAME.npz pairs, or specimen folders of UltraBones100k"


@dataclass(frozen=True, eq=False)
class RealPair:
    """A measured cloud and the whole bone.

    Attributes:
        name: which one it is.
        source: (N, 3) mm.
        target: the bone, mm.
        T_target_source: (4, 4), as far as it is known; None where nobody says it.
        truth: in words, how it is known.
    """

    name: str
    source: Array
    target: Surface
    T_target_source: Array | None
    truth: str


def default_folder() -> Path:
    """Find the folder named by GAPR_REAL, else `../shared/real` next to the repository; it may not exist."""
    named = os.environ.get(ENVIRONMENT_VARIABLE)
    return Path(named) if named else Path(__file__).resolve().parents[2].parent / "shared" / "real"


def pairs(folder: str | Path) -> Iterator[RealPair]:
    """Read every pair of a folder, one after the other.

    Raises:
        ConfigError: no such folder, or nothing of a known form in it.
        InvalidPointCloudError: a file that cannot be read.
    """
    folder = Path(folder)
    found, records = sorted(folder.glob("*.npz")), sorted(_records(folder))
    if not found and not records:
        raise ConfigError(EXPECTED, str(folder), "docs/results/real.md says what is public and how to lay it out")
    yield from map(_of_npz, found)
    for record, bone in records:
        yield _of_record(folder, record, bone)


def _of_npz(path: Path) -> RealPair:
    pair = load_pair(path)
    T = pair.T_target_source if pair.has_truth else None
    truth = str(pair.metadata.get("truth", "as the file says")) if pair.has_truth else ""
    return RealPair(path.stem, thinned(np.asarray(pair.source, dtype=np.float64)), Surface(pair.target), T, truth)


def _records(folder: Path) -> Iterator[tuple[Path, Path]]:
    """List the reconstructions of a data set, or of one specimen, each with its bone."""
    pattern = "ultrasound_records/*/*/3D_reconstructions/**/*.xyz"
    for record in {*folder.glob(pattern), *folder.glob(f"specimen*/{pattern}")}:
        records = next(parent for parent in record.parents if parent.name == "ultrasound_records")
        name = record.relative_to(records).parts[0]
        yield record, records.parent / "CT_bone_segmentations" / f"{name}.stl"


def _of_record(folder: Path, record: Path, bone: Path) -> RealPair:
    name = str(record.relative_to(folder).with_suffix(""))
    truth = "the tracker was registered to the CT"
    return RealPair(name, thinned(clouds.load(record).points), clouds.load(bone), np.eye(4), truth)


def thinned(points: Array) -> Array:
    """At most MOST_POINTS of the points, always the same ones."""
    if len(points) <= MOST_POINTS:
        return points
    return points[np.sort(np.random.default_rng(0).choice(len(points), MOST_POINTS, replace=False))]
