"""Tracked ultrasound: PLUS/IGS sequences (.igs.mha), and folders of slices with a pose each."""

from __future__ import annotations

import logging
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gapr_core.errors import InvalidPointCloudError
from gapr_core.formats import axes, columns, signatures, text, tracker
from gapr_core.formats.options import ReadOptions
from gapr_core.geometry import se3
from gapr_core.surface import Surface

Array = NDArray[np.float64]
Frames = dict[int, Array]  # (4, 4) by the number of the frame
log = logging.getLogger(__name__)

HEADER_BYTES = 64 << 20
FRAME = re.compile(r"^Seq_Frame(\d+)_(\w+?)(Transform|TransformStatus)\s*=\s*(.+)$", re.MULTILINE)
FROM_TRACKER = re.compile("TrackerTo[A-Z]")  # the inverse of a tool's pose
POSES = "poses.csv"
NEAR_POSES = re.compile(r"(?<![a-z])poses?(?![a-z])")
SMALLEST_SLICE_MM = 1.0  # of the largest slice of a folder, and of the way between their poses
SLICE_ENDINGS = (".csv", ".txt", ".xyz", ".npy")


def read_igs(path: Path, options: ReadOptions) -> Surface:
    """Tips of the tracked tool of a sequence: one point for each valid frame, in the frame of the tracker or of
    a reference, mm.

    Raises:
        InvalidPointCloudError: no tip is given, or as `pose_of`.
        ValueError: no frame is valid.
    """
    recorded = transforms(path, options)
    if options.tip_mm is None:
        raise tracker.needs_tip(path)
    poses = pose_of(recorded, options.tool, path, options.reference)
    return Surface(tracker.touched(poses, options.tip_mm), joined=True)


def pose_of(poses: dict[str, Frames], tool: int | None, path: Path, reference: int | None = None) -> Array:
    """Return poses (N, 4, 4) of one named transform, in the frame of another if one is named.

    Raises:
        InvalidPointCloudError: none or several to choose from, or one from the tracker to a tool. Two without a common
    frame or time, or one that is not rigid (of pixels).
    """
    names, valid = list(poses), [i for i, frames in enumerate(poses.values()) if frames]
    if tool is None and len(valid) == 1:
        tool = valid[0]
    used = tracker.chosen_with(tool, reference, names, path)
    if turned := next((names[i] for i in used if FROM_TRACKER.match(names[i])), None):
        how = "record it the other way round, as ProbeToTracker, or name another one with --tool"
        raise InvalidPointCloudError("a pose of a tool in the frame of the tracker", f"{turned} of {path.name}", how)
    ends = {names[i].rpartition("To")[2] for i in used if "To" in names[i]}
    if len(ends) > 1:
        given = f"{' and '.join(names[i] for i in used)} of {path.name}"
        raise InvalidPointCloudError("a tool and a reference in one frame", given, "name another --reference")
    both = [number for number in poses[names[used[0]]] if all(number in poses[names[i]] for i in used)]
    if not both:
        raise tracker.never_seen(used, names, path)
    return tracker.relative([_rigid(poses[names[i]], both, names[i], path) for i in used])


def _rigid(frames: Frames, numbers: list[int], name: str, path: Path) -> Array:
    """(N, 4, 4) of one transform in these frames, without the rounding of its rotation."""
    for number in numbers:
        if why := se3.why_not_rigid(frames[number]):
            given = f"{path.name} with {name} of frame {number}, whose {why}"
            how = "name poses of tools with --tool and --reference, or record it again"
            raise InvalidPointCloudError("rigid poses, without scale or reflection", given, how)
    return np.stack([se3.nearest_rigid(frames[number]) for number in numbers])


def transforms(path: Path, options: ReadOptions | None = None) -> dict[str, Frames]:
    """Poses of the valid frames by the transform's name, such as `ProbeToTracker` (PLUS sequence format).

    A transform that is never valid has no poses; the places of the others do not depend on it.

    Raises:
        ValueError: no transform in any valid frame, one in a valid frame with a number that is not finite, or a header
            that is cut.
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
            values[name, int(number)] = np.array(value.split(), dtype=np.float64).reshape(4, 4)
    names = sorted({name for name, _ in values})
    poses: dict[str, Frames] = {name: {} for name in names}
    for (name, number), T in sorted(values.items()):
        if (name, number) in invalid:
            continue
        if not np.isfinite(T).all():
            raise ValueError(f"{name} of frame {number} with a number that is not finite")
        poses[name][number] = T
    if not any(poses.values()):
        raise ValueError("no valid transform in its header")
    return poses


def read_folder(path: Path, options: ReadOptions) -> Surface:
    """Read the slices of a folder as one cloud, in mm.

    Each slice is a file of points (x y z) in one common frame. With `poses.csv`, points are in the slice's own frame:
    it gives 16 numbers for each slice in the order of names (slice_2 before slice_10). Axes turn the whole cloud, and
    no slice before its pose.

    Raises:
        InvalidPointCloudError: poses in another file than `poses.csv`, or one that is not rigid; a slice in RAS or
            another unit; slices that all are too small; DICOM files alone.
        ValueError: no slices, or another number of poses.
    """
    files = [f for f in path.iterdir() if f.name != POSES and not f.name.startswith(".")]
    if near := sorted(f.name for f in files if NEAR_POSES.search(f.stem.lower())):
        how = f"rename it to {POSES}, 16 numbers a line, or take it out of the folder"
        raise InvalidPointCloudError(f"poses in {POSES}", near[0], how)
    others, files = files, sorted((f for f in files if f.suffix.lower() in SLICE_ENDINGS), key=_by_numbers)
    if not files:
        if any(map(signatures.is_dicom, others)):
            raise signatures.dicom_images("a folder of DICOM files")
        raise ValueError(f"no slices ({' '.join(SLICE_ENDINGS)}) in it")
    from gapr_core.formats.reading import read

    _check_said(files)
    slices = [read(file, replace(options, axes="as_is")).points for file in files]
    if len(files) > 1:
        log.warning("%d files of %s are joined, %s to %s; the bone must not have moved in their frame",
                    len(files), path.name, files[0].name, files[-1].name)  # fmt: skip
    if (path / POSES).is_file():
        _say_order(files)
        _check_unit(slices)
        slices = _placed(slices, path / POSES, options)
    return Surface(np.vstack(slices), joined=True)


def _check_said(slices: list[Path]) -> None:
    """Raise for a slice in RAS or another unit: what its pose or the other slices are in would be a guess."""
    for path in slices:
        if (unit := columns.unit(path)) not in (None, "mm"):
            given = f"{path.name} with coordinates in {unit} by their names"
            raise InvalidPointCloudError("slices in mm", given, "convert them")
        if path.is_file() and axes.stated(path) == "ras":
            how = "turn it to the frame of the others or of its pose, and take out what says so"
            given = f"{path.name}, which says that it is in RAS"
            raise InvalidPointCloudError("slices in the frame of a tracker or a probe", given, how)


def _check_unit(slices: list[Array]) -> None:
    """Raise for slices that all are too small for a bone's: in m, each would be one point at its pose."""
    sizes = [float(np.linalg.norm(np.ptp(points, axis=0))) for points in slices if len(points) > 1]
    if sizes and max(sizes) < SMALLEST_SLICE_MM:
        given = f"slices that are {max(sizes):.2g} mm across at most"
        raise InvalidPointCloudError("slices in mm", given, f"convert them if they are in m, and {POSES} as well")


def _by_numbers(path: Path) -> tuple[list[str | int], str]:
    """Sort names with numbers by value; words and numbers alternate."""
    parts = re.split(r"([0-9]+)", path.name)
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], path.name


def _say_order(files: list[Path]) -> None:
    """Poses may have been written in the other order."""
    if files != sorted(files):
        log.warning("%s: the first line of %s is of %s, the last of %s: numbers in names count as numbers",
                    files[0].parent.name, POSES, files[0].name, files[-1].name)  # fmt: skip


def _placed(slices: list[Array], path: Path, options: ReadOptions) -> list[Array]:
    poses = text.table(text.lines(options.limits.read(path)), 16, ",").reshape(-1, 4, 4)
    if len(poses) != len(slices):
        raise ValueError(f"{len(poses)} poses of {len(slices)} slices")
    for number, T in enumerate(poses, start=1):
        _check_rigid(T, number)
    if 0.0 < (spread := float(np.linalg.norm(np.ptp(poses[:, :3, 3], axis=0)))) < SMALLEST_SLICE_MM:
        log.warning("all places in %s are within %.2g mm: are they in m? They are read as mm", POSES, spread)
    return [se3.apply(se3.nearest_rigid(T), points) for points, T in zip(slices, poses, strict=True)]


def _check_rigid(T: Array, number: int) -> None:
    """Raise for a matrix that is transposed, scaled or reflected, or has a number that is not finite."""
    if not np.isfinite(T).all():
        given, how = f"pose {number} with a number that is not finite", "take it and its slice out"
        raise InvalidPointCloudError(f"rigid 4x4 matrices in {POSES}", given, how)
    if se3.why_not_rigid(T):
        row = " ".join(f"{value:.8g}" for value in T[3])
        with np.errstate(over="ignore"):
            determinant = np.linalg.det(T[:3, :3])
        given = f"pose {number} with last row {row} and determinant {determinant:.3g} of its 3x3 part"
        how = "write it row by row, in mm, with last row 0 0 0 1, without scale or reflection"
        raise InvalidPointCloudError(f"rigid 4x4 matrices in {POSES}", given, how)
