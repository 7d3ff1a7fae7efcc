"""Tracked ultrasound: PLUS/IGS sequences (.igs.mha), and folders of slices with a pose each."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gapr_core.formats import text, tracker
from gapr_core.formats.options import ReadOptions
from gapr_core.surface import Surface

Array = NDArray[np.float64]

HEADER_BYTES = 64 << 20
FRAME = re.compile(r"^Seq_Frame(\d+)_(\w+?)(Transform|TransformStatus)\s*=\s*(.+)$", re.MULTILINE)
SLICE_ENDINGS = (".csv", ".txt", ".xyz", ".npy")


def read_igs(path: Path, options: ReadOptions) -> Surface:
    """Tips of the tracked tool of a sequence: one point for each valid frame, in the tracker's frame, mm.

    Raises:
        InvalidPointCloudError: no tip is given, or several tools and none chosen.
        ValueError: no frame is valid.
    """
    if options.tip_mm is None:
        raise tracker.needs_tip(path)
    poses = pose_of(transforms(path, options), options.tool, path)
    return Surface(poses[:, :3, :3] @ np.asarray(options.tip_mm) + poses[:, :3, 3])


def pose_of(poses: dict[str, Array], tool: int | None, path: Path) -> Array:
    """(N, 4, 4) of one transform by its place in the list of their names.

    Raises:
        InvalidPointCloudError: none of them, or several and none chosen.
    """
    names = list(poses)
    return poses[names[tracker.chosen(tool, names, path)]]


def transforms(path: Path, options: ReadOptions | None = None) -> dict[str, Array]:
    """(N, 4, 4) poses of the valid frames by the transform's name, such as `ProbeToTracker` (PLUS sequence format).

    Raises:
        ValueError: no transform in any valid frame, one with a number that is not finite, or a header that is cut.
    """
    data = (options or ReadOptions()).limits.read(path)
    end = data.find(b"ElementDataFile")
    if not 0 <= end < HEADER_BYTES:
        raise ValueError("no ElementDataFile at the end of its header: the file is cut, or no sequence")
    head = data[:end].decode("ascii", "replace")
    values: dict[tuple[str, int], Array] = {}
    invalid = set()
    for number, name, kind, value in FRAME.findall(head):
        if kind == "TransformStatus":
            invalid |= {(name, int(number))} if value.strip().upper() != "OK" else set()
        else:
            values[name, int(number)] = _matrix(value)
    names = sorted({name for name, _ in values})
    poses = {name: [T for key, T in sorted(values.items()) if key[0] == name and key not in invalid] for name in names}
    found = {name: np.stack(matrices) for name, matrices in poses.items() if matrices}
    if not found:
        raise ValueError("no valid transform in its header")
    return found


def _matrix(numbers: str) -> Array:
    T = np.array(numbers.split(), dtype=np.float64).reshape(4, 4)
    if not np.isfinite(T).all():
        raise ValueError("a transform with a number that is not finite")
    return T


def read_folder(path: Path, options: ReadOptions) -> Surface:
    """The slices of a folder as one cloud, in mm.

    Each slice is a file of points (x y z) in one common frame; or, where `poses.csv` gives a 4x4 matrix in 16 numbers
    for each slice in the order of their names, of points in the slice's own frame.

    Raises:
        ValueError: no slices, or another number of poses.
    """
    files = sorted(f for f in path.iterdir() if f.suffix.lower() in SLICE_ENDINGS and f.stem != "poses")
    if not files:
        raise ValueError(f"no slices ({' '.join(SLICE_ENDINGS)}) in it")
    from gapr_core.formats.reading import read

    slices = [read(file, options).points for file in files]
    if (path / "poses.csv").is_file():
        slices = _placed(slices, path / "poses.csv", options)
    return Surface(np.vstack(slices))


def _placed(slices: list[Array], path: Path, options: ReadOptions) -> list[Array]:
    poses = text.table(text.lines(options.limits.read(path)), 16, ",").reshape(-1, 4, 4)
    if len(poses) != len(slices):
        raise ValueError(f"{len(poses)} poses of {len(slices)} slices")
    return [points @ T[:3, :3].T + T[:3, 3] for points, T in zip(slices, poses, strict=True)]
