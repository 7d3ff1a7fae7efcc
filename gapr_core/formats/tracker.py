"""Recordings of tracked tools: poses out of NDI Track's CSV, points of a pointer's tip, and its calibration."""

from __future__ import annotations

import csv
import io
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from gapr_core.errors import InvalidPointCloudError
from gapr_core.formats import columns
from gapr_core.formats.limits import FileLimits
from gapr_core.formats.text import check_end
from gapr_core.geometry import se3

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

QUATERNION, ANGLES, PLACE = ("q0", "qx", "qy", "qz"), ("rz", "ry", "rx"), ("tx", "ty", "tz")
RECORDINGS = "a recording by NDI Track (.csv) or PLUS (.igs.mha), or poses (N, 4, 4) as .npy"
COLUMNS = "columns Q0 Qx Qy Qz or Rz Ry Rx, then Tx Ty Tz"
SEEN = ("ok", "enabled", "valid")
TIP_MM = (1.0, 1000.0)  # from the marker of a pointer, by far; one in m is nearer
FARTHEST_MM = 1e6  # of a tool, by far; systems write numbers such as -3.7e28 where they have none
FEWEST_POSES = 10
SMALLEST_TURN_DEG = 20.0
SPREAD_MM, LIFTED_MM = 1.0, 3.0  # of tips in a dimple, about; a tip farther from the pivot had left it
FEWEST_IN_PLACE = 0.5  # of the poses
MOST_NAMES, LONGEST_NAME = 8, 40  # of the tools that an error lists, and characters of a name


@dataclass(frozen=True, eq=False)
class Tip:
    """Answer of a pivot calibration.

    Attributes:
        tip_mm: (3,) the tip in the frame of the tool's marker.
        pivot_mm: (3,) the point it stood on, in the frame of the poses: the tracker's or a reference's.
        residual_mm: root-mean-square distance of the tips to that point.
        poses: how many were used.
        left_out: of how many the tip had left its place.
    """

    tip_mm: Array
    pivot_mm: Array
    residual_mm: float
    poses: int
    left_out: int = 0


def is_recording(names: Sequence[str]) -> bool:
    """Tell whether column names, in lower case, are those of a tool's poses by NDI Track."""
    return PLACE[0] in names and (QUATERNION[0] in names or ANGLES[0] in names)


def read_poses(
    path: Path, limits: FileLimits | None = None, tool: int | None = None, reference: int | None = None
) -> Array:
    """Read poses (N, 4, 4) of one tool where seen, mm, in the tracker's or a reference's frame.

    Args:
        path: NDI Track's CSV: for each tool columns State, Q0 Qx Qy Qz (the scalar first) or Rz Ry Rx (degrees, the
            rotation Rz Ry Rx), and Tx Ty Tz.
        limits: how large it may be.
        tool: which of the recorded tools, from 0; None where there is one.
        reference: the tool in whose frame the poses are, row by row, where both were seen; None for the tracker's.

    Raises:
        InvalidPointCloudError: no such columns; several tools and none chosen; a reference that is not another tool; no
            row with all seen; a number not finite or far too large.
        ValueError: a file that is cut.
    """
    data = (limits or FileLimits.from_environment()).read(path)
    check_end(data)
    text = data.decode("utf-8-sig", "replace")
    rows = list(csv.reader(io.StringIO(text), delimiter=columns.delimiter_of(text.partition("\n")[0]) or ","))
    names = [name.strip().lower() for name in rows[0]] if rows else []
    starts = [i for i, name in enumerate(names) if name in (QUATERNION[0], ANGLES[0])]
    if not starts:
        raise InvalidPointCloudError(COLUMNS, f"{path.name} without them", "export it from NDI Track")
    called = [_tool_name(rows[0][:start], i) for i, start in enumerate(starts)]
    used = chosen_with(tool, reference, called, path)
    places = [_columns(names, starts[i], i, path) for i in used]
    seen = {i: row for i, row in enumerate(rows[1:], start=2) if row and all(_is_seen_in(row, s) for s, _ in places)}
    if not seen:
        raise never_seen(used, called, path)
    return relative([_poses_in(seen, wanted, path) for _, wanted in places])


def _columns(names: Sequence[str], start: int, tool: int, path: Path) -> tuple[int | None, slice]:
    """Find the columns of a tool's state, if any, and of its pose."""
    rotation = QUATERNION if names[start] == QUATERNION[0] else ANGLES
    wanted = [*rotation, *PLACE]
    if names[start : start + len(wanted)] != wanted:
        given = f"{path.name} with others"
        raise InvalidPointCloudError(f"{COLUMNS} of tool {tool}", given, "export it from NDI Track")
    state = max((i for i, name in enumerate(names[:start]) if name.startswith("state")), default=None)
    return state, slice(start, start + len(wanted))


def _poses_in(rows: Mapping[int, Sequence[str]], wanted: slice, path: Path) -> Array:
    """(N, 4, 4) of the rows by their numbers in the file, the line of names being row 1."""
    for number, row in rows.items():
        if len(row) < wanted.stop:
            raise ValueError(f"row {number} ends before its pose")
        if commas := [value for value in row[wanted] if "," in value]:
            how = "save it with a point; the cells may be separated by ;"
            raise InvalidPointCloudError("decimals with a point, such as 1.5", f"{path.name} with {commas[0]}", how)
        if wrong := [value.strip() for value in row[wanted] if not abs(float(value)) <= FARTHEST_MM]:
            given = f"{path.name} with {wrong[0][:LONGEST_NAME]} in row {number}"
            how = "take that row out, or record it again"
            raise InvalidPointCloudError(f"poses of finite numbers up to {FARTHEST_MM:g} mm", given, how)
    values = np.array([[float(value) for value in row[wanted]] for row in rows.values()])
    return poses_of(values[:, :-3], values[:, -3:])


def relative(poses: Sequence[Array]) -> Array:
    """(N, 4, 4) of the first tool, in the frame of the second, if any (T_reference_tracker @ T_tracker_tool)."""
    return poses[0] if len(poses) == 1 else np.linalg.inv(poses[1]) @ poses[0]


def _tool_name(before: Sequence[str], number: int) -> str:
    """Return NDI Track's name of a tool: the title of its port, before its columns."""
    ports = [name.strip() for name in before if name.strip().lower().startswith("port ")]
    return ports[-1] if ports else f"tool {number}"


def chosen_with(tool: int | None, reference: int | None, names: Sequence[str], path: Path) -> list[int]:
    """Return the places of the tool and, if named, of its reference.

    Raises:
        InvalidPointCloudError: as `chosen`, of either; or a reference that is the tool itself.
    """
    tool = chosen(tool, names, path)
    if reference is None:
        return [tool]
    if reference == tool or not 0 <= reference < len(names):
        expected, given = f"a reference other than tool {tool}", f"{reference} of {path.name} {_listed(names)}"
        raise InvalidPointCloudError(expected, given, "name another one with --reference")
    return [tool, reference]


def never_seen(used: Sequence[int], names: Sequence[str], path: Path) -> InvalidPointCloudError:
    """Build the error for a recording without a row to use."""
    if len(used) == 1:
        return InvalidPointCloudError("rows with the tool in view", f"none in {path.name}", "record it again")
    expected = f"rows with tool {used[0]} and its reference {used[1]} in view"
    given = f"none in {path.name} {_listed(names)}"
    return InvalidPointCloudError(expected, given, "name another --reference, or record it again")


def _listed(names: Sequence[str]) -> str:
    shown = [f"{i}: {name[:LONGEST_NAME]}" if name != f"tool {i}" else str(i) for i, name in enumerate(names)]
    listed = ", ".join(shown[:MOST_NAMES] + ["..."] * (len(names) > MOST_NAMES))
    return f"with {len(names)} ({listed})"


def chosen(tool: int | None, names: Sequence[str], path: Path) -> int:
    """Return the place of the chosen tool; never guess: a reference may be among them.

    Raises:
        InvalidPointCloudError: none of the recorded tools, or several and none chosen.
    """
    if tool is None and len(names) == 1:
        return 0
    if tool is None or not 0 <= tool < len(names):
        asked = "one tool" if tool is None else f"tool {tool}"
        raise InvalidPointCloudError(asked, f"{path.name} {_listed(names)}", "name one with --tool")
    return tool


def needs_tip(path: Path) -> InvalidPointCloudError:
    """Build the error for a tool's poses without its tip."""
    how = "give it with --tip X,Y,Z; gapr pivot finds it"
    return InvalidPointCloudError("the tip of the tool", f"{path.name}, a recording of its poses", how)


def given_tip(tip_mm: tuple[float, float, float] | None, path: Path) -> tuple[float, float, float]:
    """Return the tip of a recording's tool.

    Raises:
        InvalidPointCloudError: none is given.
    """
    if tip_mm is None:
        raise needs_tip(path)
    return tip_mm


def rigid_poses(array: Array, path: Path) -> Array:
    """(M, 4, 4) of the poses (N, 4, 4), mm, in which the tool was seen: those with a number that is NaN are left out.

    Raises:
        InvalidPointCloudError: none of them is left, or one is not rigid or far too large.
    """
    if array.dtype.kind not in "fiu":
        raise InvalidPointCloudError("poses of numbers", f"{path.name} of {array.dtype}", "save them as floats")
    poses = array[~np.isnan(array).any(axis=(1, 2))].astype(np.float64)
    if not len(poses):
        raise never_seen([0], ["tool 0"], path)
    for number, T in enumerate(poses):
        if not (np.abs(T) <= FARTHEST_MM).all() or (why := se3.why_not_rigid(T)):
            fault = f"pose {number} whose {why}" if (np.abs(T) <= FARTHEST_MM).all() else f"pose {number} far too large"
            raise InvalidPointCloudError("rigid poses in mm", f"{path.name} with {fault}", "leave it out, or set NaN")
    return np.stack([se3.nearest_rigid(T) for T in poses])


def _is_seen_in(row: Sequence[str], state: int | None) -> bool:
    return state is None or "".join(row[state : state + 1]).strip().lower() in SEEN


def poses_of(rotations: ArrayLike, translations: ArrayLike) -> Array:
    """Build (N, 4, 4) from quaternions (N, 4), scalar first, or angles (N, 3) about z y x, deg."""
    rotations = np.asarray(rotations, dtype=np.float64)
    poses = np.tile(np.eye(4), (len(rotations), 1, 1))
    poses[:, :3, :3] = _matrices(rotations)
    poses[:, :3, 3] = translations
    return poses


def _matrices(rotations: Array) -> Array:
    if rotations.shape[1] == len(ANGLES):
        return np.asarray(Rotation.from_euler("ZYX", rotations, degrees=True).as_matrix())
    norms = np.linalg.norm(rotations, axis=1)
    if not np.allclose(norms, 1.0, atol=0.05):
        raise ValueError(f"quaternions of length {norms.min():.2f} to {norms.max():.2f}")
    return np.asarray(Rotation.from_quat(rotations[:, [1, 2, 3, 0]]).as_matrix())


def tips(poses: Array, tip_mm: ArrayLike) -> Array:
    """(N, 3) where the tip was, in the frame of the poses."""
    return poses[:, :3, :3] @ np.asarray(tip_mm, dtype=np.float64) + poses[:, :3, 3]


def touched(poses: Array, tip_mm: ArrayLike) -> Array:
    """Return a pointer's tips (N, 3); warn of a tip at an unusual distance from its marker."""
    length = float(np.linalg.norm(tip_mm))
    if length and not TIP_MM[0] <= length <= TIP_MM[1]:
        log.warning(
            "the tip is %.3g mm from its marker, as of no pointer: is it in mm? (0,0,0: the tip is the origin)", length
        )
    return tips(poses, tip_mm)


def pivot(poses: Array) -> Tip:
    """Find the tip of a tool turned about it: least squares of R_i tip + t_i = pivot (Yaniv 2015, algebraic).

    Poses before the tip stood in its place, or after it was lifted, are left out: a robust fit (Cauchy's loss) finds
    them first.

    Args:
        poses: (N, 4, 4) of the tool's marker, mm.

    Raises:
        InvalidPointCloudError: fewer than ten poses, one that is not finite or far too large, too little turning to
            know the tip, or a tip that did not stay.
    """
    poses = np.asarray(poses, dtype=np.float64)
    if wrong := int(np.sum(~(np.abs(poses) <= FARTHEST_MM).all(axis=(1, 2)))):
        expected = f"poses of finite numbers up to {FARTHEST_MM:g} mm"
        raise InvalidPointCloudError(expected, f"{wrong} of {len(poses)} that are not", "leave them out")
    if len(poses) < FEWEST_POSES:
        expected = f"at least {FEWEST_POSES} poses"
        raise InvalidPointCloudError(expected, f"{len(poses)}", "turn the tool on its tip longer")
    _check_turning(poses)
    stayed = _in_place(poses)
    if np.mean(stayed) < FEWEST_IN_PLACE or np.sum(stayed) < FEWEST_POSES:
        given = f"{np.mean(stayed):.0%} of the poses within {LIFTED_MM:g} mm of one place"
        raise InvalidPointCloudError("a tool turned on its tip", given, "record it in a dimple, from start to end")
    used = poses[stayed]
    _check_turning(used)
    both = _least_squares(used)
    residual_mm = float(np.sqrt((_distances(both, used) ** 2).mean()))
    return Tip(both[:3], both[3:], residual_mm, len(used), len(poses) - len(used))


def _least_squares(poses: Array) -> Array:
    """(6,) the tip and the pivot."""
    A = np.hstack([poses[:, :3, :3].reshape(-1, 3), np.tile(-np.eye(3), (len(poses), 1))])
    return np.asarray(np.linalg.lstsq(A, -poses[:, :3, 3].reshape(-1), rcond=None)[0])


def _in_place(poses: Array) -> NDArray[np.bool_]:
    """(N,) whether the tip was where it was most of the time."""

    def residuals(both: Array) -> Array:
        return (tips(poses, both[:3]) - both[3:]).ravel()

    robust = least_squares(residuals, _least_squares(poses), loss="cauchy", f_scale=SPREAD_MM)
    return _distances(robust.x, poses) <= LIFTED_MM


def _distances(both: Array, poses: Array) -> Array:
    return np.asarray(np.linalg.norm(tips(poses, both[:3]) - both[3:], axis=1))


def _check_turning(poses: Array) -> None:
    """Turned about at least two axes: about one, the tip may be anywhere along it."""
    turns = Rotation.from_matrix(poses[0, :3, :3].T @ poses[:, :3, :3]).as_rotvec(degrees=True)
    spread = np.linalg.svd(turns - turns.mean(axis=0), compute_uv=False)[1] * 2.0 / np.sqrt(len(poses))
    if spread < 0.25 * SMALLEST_TURN_DEG:
        given = f"turns of {spread:.1f} deg about the second axis"
        how = f"tilt it {SMALLEST_TURN_DEG:g} deg each way"
        raise InvalidPointCloudError("a tool turned about two axes", given, how)
