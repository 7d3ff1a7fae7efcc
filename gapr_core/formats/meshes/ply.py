"""PLY, by plyfile, once its header fits the file's length."""

from __future__ import annotations

import io
import re
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.formats import text
from gapr_core.formats.limits import FileLimits
from gapr_core.formats.meshes.polygons import fans, strips
from gapr_core.formats.options import ReadOptions
from gapr_core.surface import Array, Surface

BYTES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
SHORTEST_TEXT = 2  # bytes of a number and what follows it
FEWEST_CORNERS = 3
CORNERS = ("vertex_indices", "vertex_index")
END = re.compile(rb"[\r\n]end_header(?=[\r\n])")
IS_TEXT = re.compile(rb"[\r\n]format[ \t]+ascii\b")
STRIPS = "tristrips"
GRID = re.compile(rb"[\r\n]+element[ \t]+range_grid\b(?![\s\S]*[\r\n]element[ \t])[\s\S]*$")
MOST_LISTS = 3  # of one element: vertices, texture coordinates, and one more


def read(path: Path, options: ReadOptions) -> Surface:
    """Read a mesh, or a cloud with its normals."""
    data = options.limits.read(path)
    _check_header(data, options.limits)
    ply = _parse(_with_ascii_header(_without_grid(data)))
    columns = ply["vertex"].data
    points = _columns(columns, "xyz")
    for element, triangles in (("face", _triangles), (STRIPS, _of_strips)):
        if element in ply and ply[element].count:
            name = next(n for n in ply[element].data.dtype.names if n in CORNERS)
            return Surface(points, triangles(ply[element].data[name]))
    normals = ("nx", "ny", "nz")
    return Surface(points, None, _columns(columns, normals) if set(normals) <= set(columns.dtype.names) else None)


def _parse(data: bytes) -> Any:
    from plyfile import PlyData, PlyParseError

    with TemporaryFile() as file:  # what it can map plyfile reads at once; no one else can cut this file
        file.write(data)
        file.seek(0)
        try:
            return PlyData.read(file, known_list_len={"face": {"vertex_indices": 3, "vertex_index": 3}})
        except (PlyParseError, ValueError):  # other polygons, row by row; old NumPy maps nothing after the last page
            return PlyData.read(io.BytesIO(data))


def _without_grid(data: bytes) -> bytes:
    """Without the last element, if that is which pixel of a scanner each point is (Stanford's range grids)."""
    header, body = _halves(data)
    start = GRID.search(header)
    line_end = b"\r\n" if b"\r\n" in header else b"\n"
    return data if start is None else header[: start.start()] + line_end + b"end_header" + body


def _with_ascii_header(data: bytes) -> bytes:
    """Put a question mark for each non-ASCII byte in a comment, which plyfile refuses."""
    header, body = _halves(data)
    return data if header.isascii() else re.sub(rb"[\x80-\xff]", b"?", header) + body


def _halves(data: bytes) -> tuple[bytes, bytes]:
    """Up to the line end_header, and after it.

    Raises:
        ValueError: no header.
    """
    end = END.search(data)
    if not data.startswith(b"ply") or not end:
        raise ValueError("no PLY header")
    return data[: end.end()], data[end.end() :]


def _columns(table: Any, names: Any) -> Array:
    return np.stack([table[name] for name in names], axis=1).astype(np.float64)


def _check_header(data: bytes, limits: FileLimits) -> None:
    """Check the file's size against every row of the header.

    Raises:
        ValueError: no header, or a file that is shorter.
    """
    header, body = _halves(_without_grid(data))
    is_text = IS_TEXT.search(header) is not None
    if is_text:
        text.lines(data)
    shortest, elements = 0, _elements(header.decode("ascii", "replace"))
    _check_layout({name: (count, properties) for name, count, properties in elements})
    for name, count, properties in elements:
        limits.check_counts(*((0, count) if name == "face" else (count, 0)))
        shortest += count * _shortest_row(name, properties, is_text)
    if shortest > len(body):
        raise ValueError(f"{len(body)} bytes where the header announces at least {shortest}")


def _check_layout(elements: dict[str, tuple[int, list[list[str]]]]) -> None:
    """Raise `ValueError` where the points or the corners of the faces are missing."""
    if "vertex" not in elements:
        raise ValueError(f"elements {', '.join(elements)[:60] or 'missing'} and no vertex: a mesh or cloud has one")
    named = {words[-1] for words in elements["vertex"][1]}
    if missing := [axis for axis in "xyz" if axis not in named]:
        raise ValueError(f"vertices without {' '.join(missing)}")
    for element, called in (("face", "faces"), (STRIPS, STRIPS)):
        count, properties = elements.get(element, (0, []))
        if count and not any(words[0] == "list" and words[-1] in CORNERS for words in properties):
            raise ValueError(f"{called} without a list {' or '.join(CORNERS)}")


def _elements(header: str) -> list[tuple[str, int, list[list[str]]]]:
    """Name, count and properties (their words) of each element."""
    elements: list[tuple[str, int, list[list[str]]]] = []
    for words in map(str.split, header.splitlines()):
        if words[:1] == ["element"]:
            if len(words) != 3 or not words[2].isdecimal():
                raise ValueError(f"a line {' '.join(words)[:40]!r} where an element has a name and a count")
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            _check_property(words, bool(elements))
            elements[-1][2].append(words[1:])
    return elements


def _check_property(words: list[str], has_element: bool) -> None:
    is_list = words[1:2] == ["list"]
    kinds = words[2:4] if is_list else words[1:2]
    if not has_element or len(words) != (5 if is_list else 3) or not set(kinds) <= BYTES.keys():
        known = ", ".join(kind for kind in BYTES if not kind[-1].isdigit())
        raise ValueError(f"a line {' '.join(words)[:40]!r} where a property of an element has a type ({known})")


def _shortest_row(name: str, properties: list[list[str]], is_text: bool) -> int:
    """Bytes that a row takes at least; a list of corners has three."""
    lists = [words for words in properties if words[0] == "list"]
    if (lists and name not in ("face", STRIPS)) or len(lists) > MOST_LISTS:
        raise ValueError(f"lists in the element {name}, which are not read")
    size = sum(SHORTEST_TEXT if is_text else BYTES[words[1 if words[0] == "list" else 0]] for words in properties)
    corners = [words for words in lists if words[-1] in CORNERS]
    size += sum(FEWEST_CORNERS * (SHORTEST_TEXT if is_text else BYTES[words[2]]) for words in corners)
    return max(size, 1)


def _of_strips(lists: Any) -> NDArray[np.int64]:
    """(F, 3) triangles of strips; a -1 in a list begins another strip."""
    corners = np.concatenate([[*corners, -1] for corners in lists]).astype(np.int64)
    breaks = np.flatnonzero(corners == -1)
    ends = np.concatenate([[0], breaks - np.arange(len(breaks))])
    triangles = strips(ends, corners[corners != -1])
    a, b, c = triangles.T
    return triangles[(a != b) & (b != c) & (c != a)]  # a strip turns a corner by one that has no area


def _triangles(polygons: Any) -> NDArray[np.int64]:
    """(F, 3) triangles of an (F, 3) array, or of one array of corners for each polygon."""
    if polygons.dtype != object:
        return np.asarray(polygons, dtype=np.int64)
    ends = np.cumsum([0, *map(len, polygons)])
    return fans(ends, np.concatenate(polygons).astype(np.int64))
