"""Which columns of a text file are the coordinates, and which axes their names say: x y z, l p s or r a s."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from gapr_core.errors import InvalidPointCloudError

DELIMITERS = ",;\t"
COMMENTS = ("#", "//", "sep=")  # the last as Excel begins a file with, such as sep=;
ENDINGS = (".csv", ".txt", ".xyz")
UNITS = {
    "mm": "mm", "millimeter": "mm", "millimeters": "mm", "millimetre": "mm", "millimetres": "mm",
    "cm": "cm", "centimeter": "cm", "centimeters": "cm", "centimetre": "cm", "centimetres": "cm",
    "m": "m", "meter": "m", "meters": "m", "metre": "m", "metres": "m",
    "in": "in", "inch": "in", "inches": "in",
}  # fmt: skip
OTHER_UNITS = (
    "um",
    "\u00b5m",
    "\u03bcm",
    "micron",
    "microns",
    "nm",
    "dm",
    "ft",
    "feet",
    "yd",
    "km",
)
IN_BRACKETS = re.compile(r"\b([xyzlpsra])\s*[(\[]\s*(\w+)\s*[)\]]", re.IGNORECASE)  # x (mm), x[inch]
OUTSIDE = "|".join(name for name in (*UNITS, *OTHER_UNITS) if name not in ("m", "in"))
BY_ITSELF = re.compile(rf"\b([xyzlpsra])[\s_/]+(?:in\s+)?({OUTSIDE})\b", re.IGNORECASE)  # x_mm, x in cm
AXES = {"xyz": None, "lps": "lps", "ras": "ras"}  # names of three columns -> the axes that they say


class Header(NamedTuple):
    """Lines before the first point.

    Attributes:
        delimiter: between two cells; None for white space.
        names: of the columns, or the words of the last comment.
        is_line: whether they stand in a line of their own, which is no comment.
        cells: how many are in the first line that is neither empty nor a comment.
        line: in which the names stand.
    """

    delimiter: str | None
    names: list[str]
    is_line: bool
    cells: int
    line: str


class Columns(NamedTuple):
    """Where the coordinates are, and the axes that the names say: "lps", "ras" or none."""

    places: list[int]
    space: str | None = None


FIRST = Columns([0, 1, 2])


def header_of(lines: Iterable[str]) -> Header:
    """Read the header from lines up to the first one with data."""
    comment = first = ""
    for line in lines:
        if line.lstrip().startswith(COMMENTS):
            comment = line
        elif line.strip():
            first = line
            break
    delimiter = delimiter_of(first)
    cells, commented = _cells(first, delimiter), words(comment.lstrip(" #/"), delimiter)
    if not first or are_numbers(cells) or _is_point(cells, found_in_comment(commented, len(cells))):
        return Header(delimiter, commented, False, len(cells), comment)
    return Header(delimiter, words(first, delimiter), True, len(cells), first)


def delimiter_of(line: str) -> str | None:
    """Find the delimiter of a line; None for white space."""
    return next((d for d in DELIMITERS if d in line), None)


def words(line: str, delimiter: str | None) -> list[str]:
    """Return the names in a line, without empty ones at its end or between spaces."""
    if delimiter is None:
        return [word for word in line.split() if axis(word)]
    names = _cells(line.lstrip("\ufeff"), delimiter)
    while names and not names[-1].strip():
        names.pop()
    return names


def axis(name: str) -> str:
    """Strip the unit from a name, in lower case: x of `X (mm)` and `x_mm`."""
    return re.sub(r"[\s(\[_/].*", "", name.strip(' "\ufeff').lower())


def kinds_in(short: list[str]) -> list[str]:
    """Return the kinds of axes with all three names, once each."""
    return [kind for kind in AXES if all(short.count(letter) == 1 for letter in kind)]


def found(names: list[str]) -> Columns | None:
    """Find the columns x y z, l p s or r a s, with units or not; None unless complete.

    Raises:
        InvalidPointCloudError: names of several kinds.
    """
    for short in ([name.strip(' "\ufeff').lower() for name in names], [axis(name) for name in names]):
        kinds = kinds_in(short)
        if len(kinds) > 1:
            given = f"columns {' and '.join(' '.join(kind) for kind in kinds)}"
            raise InvalidPointCloudError("one kind of coordinates", given, "leave out or rename the others")
        if kinds:
            return Columns([short.index(letter) for letter in kinds[0]], AXES[kinds[0]])
    return None


def found_in_comment(names: list[str], count: int) -> Columns | None:
    """By a comment that names every column, or that begins with the names of the first three."""
    if len(names) == count and (all_named := found(names)) is not None:
        return all_named
    kind = "".join(axis(name) for name in names[:3])
    return Columns(FIRST.places, AXES[kind]) if kind in AXES else None


def space(path: Path) -> str | None:
    """Return the axes in the names of the columns, "lps" or "ras"; None without.

    Raises:
        InvalidPointCloudError: names of several kinds.
    """
    columns = _used(_header(path))
    return columns.space if columns else None


def unit(path: Path) -> str | None:
    """Return the unit in the coordinates' names, "mm", "cm" or "m", as in `x (cm)`; None without.

    Raises:
        InvalidPointCloudError: several units or another one, or as `space`.
    """
    if not path.is_file() or path.suffix.lower() not in ENDINGS:
        return None
    header = _header(path)
    if (used := _used(header)) is None:
        return None
    named = [pair for way in (IN_BRACKETS, BY_ITSELF) for pair in way.findall(header.line)]
    words = {word.lower() for letter, word in named if letter.lower() in (used.space or "xyz")}
    stated = {UNITS[word] for word in words if word in UNITS}
    if others := sorted(words.intersection(OTHER_UNITS)):
        given = f"{path.name} with columns in {' and '.join(others)}"
        raise InvalidPointCloudError("coordinates in mm, cm, m or in", given, "convert them, and name the columns so")
    if not stated:
        return None
    if len(stated) > 1:
        raise InvalidPointCloudError("one unit of all coordinates", " and ".join(sorted(stated)), "correct the names")
    return stated.pop()


def unnamed(path: Path) -> int:
    """Count the columns of a text file whose first three are taken without names; 0 for others."""
    if not path.is_file() or path.suffix.lower() not in ENDINGS:
        return 0
    header = _header(path)
    return 0 if header.is_line or _used(header) else header.cells


def _header(path: Path) -> Header:
    with path.open("rb") as file:
        return header_of(io.TextIOWrapper(file, encoding="utf-8-sig", errors="replace"))


def _used(header: Header) -> Columns | None:
    """Choose columns by their names."""
    return found(header.names) if header.is_line else found_in_comment(header.names, header.cells)


def _cells(line: str, delimiter: str | None) -> list[str]:
    return line.split() if delimiter is None else next(csv.reader([line.strip("\r\n ")], delimiter=delimiter), [])


def _is_point(cells: list[str], columns: Columns | None) -> bool:
    """Tell whether the cells of a comment are numbers."""
    return columns is not None and len(cells) >= 3 and are_numbers([cells[place] for place in columns.places])


def are_numbers(cells: list[str]) -> bool:
    """Tell whether all cells are numbers, quoted or not; some may be missing."""
    filled = [cell for cell in (cell.strip(' \t"') for cell in cells) if cell]
    try:
        return len([float(cell) for cell in filled]) > 0
    except ValueError:
        return False
