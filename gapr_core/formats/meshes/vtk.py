"""Legacy VTK files with polygonal data, text and binary, versions 1 to 5.1 (VTK file formats, Kitware)."""

from __future__ import annotations

from array import array
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gapr_core.errors import InvalidPointCloudError
from gapr_core.formats.limits import FileLimits
from gapr_core.formats.meshes.polygons import fans, integers, offsets_of_counted, strips
from gapr_core.formats.options import ReadOptions
from gapr_core.surface import Array, Surface

TYPES = {
    "char": "i1", "signed_char": "i1", "unsigned_char": "u1", "short": ">i2", "unsigned_short": ">u2", "int": ">i4",
    "unsigned_int": ">u4", "long": ">i8", "unsigned_long": ">u8", "float": ">f4", "double": ">f8", "vtkidtype": ">i4",
    "vtktypeint64": ">i8", "vtktypeint32": ">i4",
}  # fmt: skip
CELLS = ("VERTICES", "LINES", "POLYGONS", "TRIANGLE_STRIPS")
DONE = ("POINT_DATA", "CELL_DATA")
CLOUD = "save a cloud as PLY, NPY or VTP, or with VERTICES; export a mesh again"


def read(path: Path, options: ReadOptions) -> Surface:
    """Read a mesh; a cloud has its points as VERTICES.

    Raises:
        InvalidPointCloudError: points without cells, as those of a mesh that is cut.
        ValueError: a file that is damaged or cut.
    """
    file = _File(options.limits.read(path), options.limits)
    points, cells = np.empty((0, 3)), {}
    while (words := file.words()) and words[0] not in DONE:
        if words[0] == "POINTS":
            (count,) = _counts(words, 3, 1)
            options.limits.check_counts(count)
            points = file.numbers(3 * count, words[2]).reshape(-1, 3)
        elif words[0] in CELLS:
            first, second = _counts(words, 3, 1, 2)
            cells[words[0]] = file.cells(first, second)
        else:
            file.skip(words)
    if not cells:
        given = f"{len(points)} points without a cell, as in a cut file"
        raise InvalidPointCloudError("points and cells", given, CLOUD)
    faces = [fans(*cells["POLYGONS"])] if "POLYGONS" in cells else []
    faces += [strips(*cells["TRIANGLE_STRIPS"])] if "TRIANGLE_STRIPS" in cells else []
    triangles = np.concatenate(faces) if faces else np.empty((0, 3), dtype=np.int64)
    return Surface(points, triangles if len(triangles) else None)


def space(path: Path, limits: FileLimits) -> str:
    """Read 3D Slicer's axes in the field array SPACE before the points; empty without one.

    Raises:
        ValueError: a damaged file.
    """
    file = _File(limits.read(path), limits)
    while (words := file.words()) and words[0] in ("FIELD", "METADATA"):
        file.skip(words)
    return file.space


class _File:
    """Reads on from one place; every number is checked to be there before it is taken."""

    def __init__(self, data: bytes, limits: FileLimits) -> None:
        self._data, self._limits, self._at = data, limits, 0
        self.space = ""  # what a field array of this name said, as far as it was read
        if not self.line().startswith("# vtk DataFile"):
            raise ValueError("no VTK header")
        self.line()  # the title
        self._is_text = self.line().strip().upper() == "ASCII"
        if self.words() != ["DATASET", "POLYDATA"]:
            raise ValueError("no polygonal data in it")

    def line(self) -> str:
        """Read the next line; empty at the end of the file."""
        end = self._data.find(b"\n", self._at)
        end = len(self._data) if end < 0 else end
        line, self._at = self._data[self._at : end], end + 1
        return line.decode("ascii", "replace")

    def words(self) -> list[str]:
        """Words of the next line that has any; none at the end of the file."""
        while self._at < len(self._data):
            if words := self.line().split():
                return [words[0].upper(), *words[1:]]
        return []

    def numbers(self, count: int, kind: str) -> Array:
        """So many numbers of the type named."""
        if kind.lower() not in TYPES:
            raise ValueError(f"numbers of type {kind[:20]}, which are not read: save them as float or double")
        dtype = np.dtype(TYPES[kind.lower()])
        self._limits.check_unpacked(8 * max(count, 0))
        if self._is_text:
            return self._numbers_of_text(count)
        if count < 0 or self._at + count * dtype.itemsize > len(self._data):
            raise ValueError(f"less data than the {count} numbers announced")
        values = np.frombuffer(self._data, dtype, count, self._at)
        self._at += count * dtype.itemsize
        return values.astype(np.float64)

    def _numbers_of_text(self, count: int) -> Array:
        values = array("d")
        while len(values) < count and self._at < len(self._data):
            values.extend(map(float, self.line().split()))
        if len(values) != count or self._at > len(self._data):
            raise ValueError(f"{len(values)} whole numbers where {count} are announced")
        return np.array(values)

    def cells(self, first: int, second: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Offsets and corners, written with their sizes between them (versions to 4.2) or as two arrays (5.1)."""
        before = self._at
        words = self.words()
        if words[:1] != ["OFFSETS"]:
            self._at = before
            return offsets_of_counted(integers(self.numbers(second, "int")), first)
        _counts(words, 2)
        offsets = integers(self.numbers(first, words[1]))
        words = self.words()
        if words[:1] != ["CONNECTIVITY"] or len(words) < 2:
            raise ValueError("offsets without corners")
        return offsets, integers(self.numbers(second, words[1]))

    def skip(self, words: list[str]) -> None:
        """Pass over METADATA (to the next empty line) or FIELD arrays."""
        if words[0] == "METADATA":
            while self._at < len(self._data) and self.line().strip():
                pass
        elif words[0] == "FIELD":
            for _ in range(*_counts(words, 3, 2)):
                words = self.words()
                if words == ["METADATA"]:  # of the array before
                    self.skip(words)
                    words = self.words()
                self._skip_array(words)
        else:
            raise ValueError(f"a section {words[0][:30]!r}")

    def _skip_array(self, words: list[str]) -> None:
        components, tuples = _counts(words, 4, 1, 2)
        count = components * tuples
        if words[3] != "string":
            self.numbers(count, words[3])
        for _ in range(min(count, len(self._data)) if words[3] == "string" else 0):
            found = self.line() if self._is_text else self._string()
            if words[0] == "SPACE":
                self.space = found.strip()

    def _string(self) -> str:
        """Its length comes first, in as many bytes as the upper two bits of the first one say."""
        kind = self._data[self._at] >> 6 if self._at < len(self._data) else 3
        size = {3: 1, 2: 2, 1: 4, 0: 8}[kind]
        length = int.from_bytes(self._data[self._at : self._at + size], "big") & ((1 << (8 * size - 2)) - 1)
        begin = self._at + size
        self._at = begin + length
        if self._at > len(self._data):
            raise ValueError("a text that ends beyond the file")
        return self._data[begin : self._at].decode("ascii", "replace")


def _counts(words: list[str], length: int, *places: int) -> list[int]:
    """Read the counts in the line of a section with a minimum of words.

    Raises:
        ValueError: a line that is shorter, or something else at these places.
    """
    if len(words) < length or not all(words[place].isdecimal() for place in places):
        raise ValueError(f"a line {' '.join(words)[:40]!r} without the counts or the type of its section")
    return [int(words[place]) for place in places]
