"""XYZ, TXT and CSV: a point a line, and NDI Track's recordings of a tool."""

from __future__ import annotations

import csv
import re
from array import array
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from gapr_core.errors import InvalidPointCloudError
from gapr_core.formats import columns, text, tracker
from gapr_core.formats.columns import COMMENTS, FIRST, Columns, Header
from gapr_core.formats.options import ReadOptions
from gapr_core.surface import Array, Surface

Row = tuple[int, list[str]]  # the number of its line in the file, from 1, and its cells

MOST_OF_POINT = 12  # numbers in a row: more, in three rows, are the coordinates of as many points
MANY_ROWS = 12  # of a column that rises all the time by chance one in 12!
LONGEST_NAMES = 80  # characters of a line that an error quotes
FEWEST_OF_POINT = 2  # numbers among the words of a first line, which is no title then, but a point
DECIMAL_COMMA = re.compile(r"-?\d+,\d+")
DECIMAL_COMMAS = re.compile(r"-?\d+,\d+([;\s]+-?\d+,\d+)+[;\s]*")
SPLIT_DECIMALS = re.compile(r"-?\d+,\d+(,-?\d+,\d+){2}")  # as x,y,z: six whole numbers
DEFINED, UNDEFINED = "defined", ("0", "false")  # of a control point of 3D Slicer that was never placed


def read(path: Path, options: ReadOptions) -> Surface:
    """Read x y z, or x y z nx ny nz, from the first columns or those named.

    Raises:
        InvalidPointCloudError: names without coordinates, numbers of the points in the first column, decimal commas, a
    cell that is no number, or a row for each coordinate.
    """
    return _surface(options.limits.read(path))


def read_csv(path: Path, options: ReadOptions) -> Surface:
    """Read named columns x y z, l p s or r a s, the first three, or tracked tips.

    Raises:
        InvalidPointCloudError: a recording without the tip, or of several tools and none chosen; a tip, a tool or a
    reference for another kind of file; columns as in `read`.
    """
    data = options.limits.read(path)
    header = next(text.lines(data), "")
    names = [name.strip().lower() for name in columns.words(header, columns.delimiter_of(header) or ",")]
    if tracker.is_recording(names) and options.tip_mm is not None:
        poses = tracker.read_poses(path, options.limits, options.tool, options.reference)
        return Surface(tracker.touched(poses, options.tip_mm), joined=True)
    if tracker.is_recording(names):
        raise tracker.needs_tip(path)
    if (options.tip_mm, options.tool, options.reference) != (None, None, None):
        given = f"{path.name} without columns Q0 or Rz, and Tx"
        expected = f"{tracker.RECORDINGS} for --tip, --tool and --reference"
        raise InvalidPointCloudError(expected, given, "leave them out for points")
    return _surface(data)


def read_pts(path: Path, options: ReadOptions) -> Surface:
    """Read a count, then as many lines of x y z, often with an intensity and a colour.

    Raises:
        ValueError: another count, or fewer than three columns.
    """
    first, *rows = [line for line in text.lines(options.limits.read(path)) if line.strip()] or [""]
    values = text.table(rows)
    if first.strip() != str(len(values)):
        raise ValueError(f"{len(values)} points where its first line announces {first.strip()[:20]!r}")
    if len(values) and values.shape[1] < 3:
        raise ValueError(f"{values.shape[1]} columns, not x y z")
    return Surface(values[:, :3])


def _surface(data: bytes) -> Surface:
    lines = [line for line in text.lines(data) if line.strip()]
    header = columns.header_of(lines)
    rows = [line for line in lines if not line.lstrip().startswith(COMMENTS)][header.is_line :]
    if rows and DECIMAL_COMMAS.fullmatch(rows[0].strip()):
        raise _decimal_commas(rows[0], bool(columns.kinds_in([columns.axis(name) for name in header.names])))
    if _defined(header) is not None:
        return Surface(_by_cells(data, header))
    try:
        values = text.table(rows, delimiter=header.delimiter, quotes=header.delimiter is not None)
    except ValueError as error:
        return Surface(_by_cells(data, header, error))
    return _of_numbers(values, header, rows)


def _of_numbers(values: Array, header: Header, rows: list[str]) -> Surface:
    """Read a file with numbers alone below its names."""
    if values.shape[1] < 3:
        raise ValueError(f"{values.shape[1]} columns, not x y z")
    if len(values) == 3 and values.shape[1] > MOST_OF_POINT and len(header.names) != values.shape[1]:
        given, how = f"3 rows of {values.shape[1]} numbers", "is it transposed? Write one point a row"
        raise InvalidPointCloudError("a point a row", given, how)
    has_normals = values.shape[1] == 6 and _are_units(values[:, 3:])
    if not (header.is_line or has_normals):
        if all(SPLIT_DECIMALS.fullmatch(row.strip()) for row in rows):
            raise _decimal_commas(rows[0])
        _check_first(header.names, values)
    places = _columns(header, values.shape[1], has_normals).places
    has_normals = has_normals and places == FIRST.places
    return Surface(values[:, places], None, values[:, 3:] if has_normals else None)


def _by_cells(data: bytes, header: Header, error: ValueError | None = None) -> Array:
    """Read (N, 3) points beside text and empty cells; a missing number is NaN.

    Raises:
        InvalidPointCloudError: a file without names of its columns, one that is no number, or a row of another length.
        ValueError: the error given, where no line explains it.
    """
    rows = _rows(data, header)
    first = next(rows, None)
    if first is None:
        raise ValueError("a line of names and no points")
    count = len(first[1])
    is_named = header.is_line or columns.found_in_comment(header.names, count) is not None
    places = _columns(header, count, has_normals=False).places if is_named else list(range(count))
    values = array("d")
    for line, cells in _placed(_chained(first, rows), _defined(header)):
        if len(cells) != count:
            given = f"{len(cells)} in line {line}"
            raise InvalidPointCloudError(f"{count} columns in every line", given, "correct it, or quote its texts")
        values.extend(_number(cells, place, line, is_named) for place in places)
    if not is_named:
        raise error or ValueError("no names of its columns")
    return np.array(values).reshape(-1, 3)


def _rows(data: bytes, header: Header) -> Iterator[Row]:
    """Return the rows below the names, without empty cells beyond the last name."""
    kept = ((n, line) for n, line in enumerate(text.lines(data), start=1) if _is_row(line))
    if header.is_line:
        next(kept, None)
    for line, cells in _split(kept, header.delimiter):
        while len(cells) > len(header.names) and header.is_line and not cells[-1].strip():
            cells.pop()
        yield line, cells


def _is_row(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith(COMMENTS)


def _split(lines: Iterator[tuple[int, str]], delimiter: str | None) -> Iterator[Row]:
    """Split numbered lines into cells; a quoted cell may hold the delimiter, but no end of line."""
    if delimiter is None:
        yield from ((number, [cell.strip('"') for cell in line.split()]) for number, line in lines)
        return
    at = 0

    def taken() -> Iterator[str]:
        nonlocal at
        for at, line in lines:  # noqa: B007  the number of the line that the reader took last
            yield line

    reader = csv.reader(taken(), delimiter=delimiter, skipinitialspace=True)
    for count, cells in enumerate(reader, start=1):
        if reader.line_num != count:
            given = f"a quotation mark that is not closed in its line, before line {at}"
            raise InvalidPointCloudError("a point a line", given, "take it out, or close it")
        yield at, cells


def _chained(first: Row, rows: Iterable[Row]) -> Iterator[Row]:
    yield first
    yield from rows


def _defined(header: Header) -> int | None:
    """Find 3D Slicer's column of the state of a control point."""
    short = [name.strip().lower() for name in header.names]
    is_slicer = header.is_line and short.count(DEFINED) == 1 and columns.kinds_in(short) in (["lps"], ["ras"])
    return short.index(DEFINED) if is_slicer else None


def _placed(rows: Iterable[Row], defined: int | None) -> Iterator[Row]:
    """Without control points that were never placed."""
    for line, cells in rows:
        if defined is None or "".join(cells[defined : defined + 1]).strip().lower() not in UNDEFINED:
            yield line, cells


def _number(cells: list[str], place: int, line: int, may_be_empty: bool) -> float:
    cell = cells[place].strip()
    if not cell and may_be_empty:
        return np.nan
    try:
        return float(cell if "_" not in cell else "")  # Python takes 1_0 for 10
    except ValueError as error:
        if DECIMAL_COMMA.fullmatch(cell):
            raise _decimal_commas(cell, may_be_empty) from error
        given = f"{'text' if cell else 'nothing'} in column {place + 1} of line {line}"
        how = "correct it" + ("" if may_be_empty else ", or begin with a line of names, x y z and others for the rest")
        raise InvalidPointCloudError("a number", given, how) from error


def _decimal_commas(row: str, is_named: bool = False) -> InvalidPointCloudError:
    given = f"decimal commas ({row.strip()[:LONGEST_NAMES]})"
    how = "write them with a point" + ("" if is_named else "; columns of whole numbers need a line of names")
    return InvalidPointCloudError("decimals with a point, such as 1.5", given, how)


def _columns(header: Header, count: int, has_normals: bool) -> Columns:
    """Find the coordinates by the line of names, or a comment, else take the first three."""
    if not header.is_line:
        return columns.found_in_comment(header.names, count) or FIRST
    if len(header.names) != count:
        return _of_title(header, count, has_normals)
    if (found := columns.found(header.names)) is not None:
        return found
    given = f"columns {' '.join(header.names)[:LONGEST_NAMES]}"
    if set("xyz") <= {columns.axis(name) for name in header.names}:
        how = "name those that are meant x y z, and the others otherwise"
        raise InvalidPointCloudError("one column each for x y z", given, how)
    how = "name them x y z, or leave that line out"
    raise InvalidPointCloudError("columns x y z, l p s or r a s", given, how)


def _of_title(header: Header, count: int, has_normals: bool) -> Columns:
    """By words that are more or fewer than the columns; a title over x y z alone names nothing.

    Raises:
        InvalidPointCloudError: the words are a point with other words, or do not say which columns are the coordinates.
    """
    numbers = sum(columns.are_numbers([word]) for word in header.names)
    if numbers >= FEWEST_OF_POINT:
        given = f"a first line with {numbers} numbers among its {len(header.names)} words"
        how = "take out the other words if it is a point, or the line if it is a title"
        raise InvalidPointCloudError(f"{count} numbers, names of {count} columns or a title", given, how)
    short = [columns.axis(name) for name in header.names]
    no_axes = set("xyz").isdisjoint(short) and not any(set(kind) <= set(short) for kind in columns.AXES)
    if no_axes and (count == 3 or has_normals):
        return FIRST
    if "".join(short[:3]) in columns.AXES and header.delimiter != "," and (found := columns.found(header.names)):
        return found
    named = f"{len(header.names)} (columns {' '.join(header.names)[:LONGEST_NAMES]})"
    given = f"{len(header.names)} names" if no_axes else named  # a title may name a patient
    how = "give each column one name of one word; write decimals with a point, not a comma"
    raise InvalidPointCloudError(f"a name for each of {count} columns", given, how)


def _check_first(names: list[str], values: Array) -> None:
    """Raise where the first column counts points or time, and no comment names it.

    Numbers of frames have gaps, and times are no whole numbers: a column that rises from each of many rows to the next
    is one. So is a whole number that never turns back, where the columns behind it are none: several points of each
    frame.
    """
    if values.shape[1] <= 3 or len(names) == values.shape[1] and columns.found(names) is not None:
        return
    steps, is_whole = np.diff(values[:, 0]), (values == np.round(values)).all(axis=0)
    counts = len(steps) > 1 and (steps == 1.0).all()
    if len(values) >= MANY_ROWS:
        frames = is_whole[0] and not is_whole[1:3].all() and len(np.unique(values[:, 0])) > 2
        counts |= (steps > 0.0).all() or frames and ((steps >= 0.0).all() or (steps <= 0.0).all())
    if counts:
        given = "a first column that counts the points, or their times"
        raise InvalidPointCloudError("x y z in the first columns", given, "leave it out, or begin with a line of names")


def _are_units(vectors: Array) -> bool:
    return bool(np.allclose(np.linalg.norm(vectors, axis=1), 1.0, atol=0.01))
