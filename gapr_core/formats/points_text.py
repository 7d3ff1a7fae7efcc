"""XYZ, TXT and CSV: a point a line, and NDI Track's recordings of a tool."""

from __future__ import annotations

import csv
import itertools
import re
from pathlib import Path

import numpy as np

from gapr_core.errors import InvalidPointCloudError
from gapr_core.formats import text, tracker
from gapr_core.formats.limits import FileLimits
from gapr_core.formats.options import ReadOptions
from gapr_core.surface import Surface

DELIMITERS = ",;\t"
COMMENTS = ("#", "//")
LONGEST_NAMES = 80  # characters of a line that an error quotes
DECIMAL_COMMAS = re.compile(r"-?\d+,\d+([;\s]+-?\d+,\d+)+[;\s]*")
SPLIT_DECIMALS = re.compile(r"-?\d+,\d+(,-?\d+,\d+){2}")  # as x,y,z: six whole numbers


def read(path: Path, limits: FileLimits) -> Surface:
    """X y z, or x y z nx ny nz, in the first columns or where a line of names says.

    Raises:
        InvalidPointCloudError: names that do not say which columns are x y z, numbers of the points in the first one,
            or decimal commas.
    """
    return _surface(limits.read(path))


def read_csv(path: Path, options: ReadOptions) -> Surface:
    """Columns named x y z (any case), or the first three; of a recording of a tracked tool, where its tip was.

    Raises:
        InvalidPointCloudError: a recording of a tracked tool without the tip, or of several tools and none chosen; a
            tip, a tool or a reference for a file that is no such recording; columns as in `read`.
    """
    data = options.limits.read(path)
    header = next(text.lines(data), "")
    names = [name.strip().lower() for name in _words(header, ",")]
    if tracker.is_recording(names) and options.tip_mm is not None:
        poses = tracker.read_poses(path, options.limits, options.tool, options.reference)
        return Surface(tracker.tips(poses, options.tip_mm), joined=True)
    if tracker.is_recording(names):
        raise tracker.needs_tip(path)
    if (options.tip_mm, options.tool, options.reference) != (None, None, None):
        given = f"{path.name} without columns Q0 or Rz, and Tx"
        expected = "a recording by NDI Track for --tip, --tool and --reference"
        raise InvalidPointCloudError(expected, given, "leave them out for points")
    return _surface(data)


def _surface(data: bytes) -> Surface:
    lines = [line for line in text.lines(data) if line.strip()]
    rows = [line for line in lines if not line.lstrip().startswith(COMMENTS)]
    delimiter = next((d for d in DELIMITERS if rows and d in rows[0]), None)
    named = bool(rows) and not _is_numbers(rows[0], delimiter)
    names = _words(rows[0] if named else _comment_above(lines), delimiter)
    rows = rows[1:] if named else rows
    if rows and DECIMAL_COMMAS.fullmatch(rows[0].strip()):
        raise _decimal_commas(rows[0])
    values = text.table(rows, delimiter=delimiter)
    if values.shape[1] < 3:
        raise ValueError(f"{values.shape[1]} columns, not x y z")
    has_normals = values.shape[1] == 6 and _are_units(values[:, 3:])
    if not (named or has_normals) and all(SPLIT_DECIMALS.fullmatch(row.strip()) for row in rows):
        raise _decimal_commas(rows[0])
    if not (named or has_normals):
        _check_first(names, values)
    columns = _columns(names, values.shape[1], delimiter, has_normals) if named else _said(names, values.shape[1])
    has_normals = has_normals and columns == [0, 1, 2]
    return Surface(values[:, columns], None, values[:, 3:] if has_normals else None)


def _decimal_commas(row: str) -> InvalidPointCloudError:
    given = f"decimal commas ({row.strip()[:LONGEST_NAMES]})"
    how = "write them with a point; columns of whole numbers need a line of names"
    return InvalidPointCloudError("decimals with a point, such as 1.5", given, how)


def _words(line: str, delimiter: str | None) -> list[str]:
    """The names in a line; those that are empty, at its end or between spaces, are left out."""
    if delimiter is None:
        return [word for word in line.split() if _axis(word)]
    words = next(csv.reader([line.strip().lstrip("\ufeff")], delimiter=delimiter), [])
    while words and not words[-1].strip():
        words.pop()
    return words


def _comment_above(lines: list[str]) -> str:
    """The last comment before the first point, which may name the columns."""
    above = list(itertools.takewhile(lambda line: line.lstrip().startswith(COMMENTS), lines))
    return above[-1].lstrip(" #/") if above else ""


def _axis(name: str) -> str:
    """A name in lower case without its unit: x of `X (mm)` and `x_mm`."""
    return re.sub(r"[\s(\[_/].*", "", name.strip(' "\ufeff').lower())


def _columns(names: list[str], count: int, delimiter: str | None, has_normals: bool) -> list[int]:
    """Where x y z are, by a line of names that is no comment; a title over x y z alone names nothing."""
    short = [_axis(name) for name in names]
    given = f"columns {' '.join(names)[:LONGEST_NAMES]}"
    if len(names) != count:
        no_axes = set("xyz").isdisjoint(short)
        if (no_axes and (count == 3 or has_normals)) or (short[:3] == [*"xyz"] and delimiter != ","):
            return [0, 1, 2]
        given = f"{len(names)} names" if no_axes else f"{len(names)} ({given})"  # a title may name a patient
        how = "give each column one name of one word; write decimals with a point, not a comma"
        raise InvalidPointCloudError(f"a name for each of {count} columns", given, how)
    if (found := _places(names)) is not None:
        return found
    if set("xyz") <= set(short):
        how = "name those that are meant x y z, and the others otherwise"
        raise InvalidPointCloudError("one column each for x y z", given, how)
    raise InvalidPointCloudError("columns x y z", given, "name them x y z, or leave that line out")


def _said(names: list[str], count: int) -> list[int]:
    """Where x y z are by a comment that names every column, else the first three."""
    found = _places(names) if len(names) == count else None
    return found or [0, 1, 2]


def _check_first(names: list[str], values: np.ndarray) -> None:
    """Raise where the first column is no x, but the number of each point, and no comment says so."""
    is_said = len(names) == values.shape[1] and _places(names) is not None
    if not is_said and values.shape[1] > 3 and len(values) > 2 and (np.diff(values[:, 0]) == 1.0).all():
        given = "a first column that counts the points"
        raise InvalidPointCloudError("x y z in the first columns", given, "leave it out, or begin with a line of names")


def _places(names: list[str]) -> list[int] | None:
    """The columns named x y z, or with a unit where none is; None unless there is one of each."""
    for words in ([name.strip(' "\ufeff').lower() for name in names], [_axis(name) for name in names]):
        if all(words.count(axis) == 1 for axis in "xyz"):
            return [words.index(axis) for axis in "xyz"]
    return None


def _is_numbers(line: str, delimiter: str | None) -> bool:
    try:
        [float(word) for word in line.split(delimiter)]
    except ValueError:
        return False
    return True


def _are_units(vectors: np.ndarray) -> bool:
    return bool(np.allclose(np.linalg.norm(vectors, axis=1), 1.0, atol=0.01))
