"""VTP, the XML form of polygonal data: inline and appended, text, base64 and raw, zlib and LZMA (VTK file formats)."""

from __future__ import annotations

import base64
import binascii
import lzma
import re
import zlib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from gapr_core.formats.limits import FileLimits
from gapr_core.formats.meshes.polygons import fans, integers, strips
from gapr_core.formats.options import ReadOptions
from gapr_core.surface import Array, Surface

TYPES = {f"{name}{8 * n}": f"{letter}{n}" for name, letter in (("Int", "i"), ("UInt", "u")) for n in (1, 2, 4, 8)}
TYPES |= {"Float32": "f4", "Float64": "f8"}
DECOMPRESSORS = {"vtkZLibDataCompressor": zlib.decompressobj, "vtkLZMADataCompressor": lzma.LZMADecompressor}
RAW = re.compile(rb'<AppendedData\s+encoding="raw"\s*>\s*_')


def read(path: Path, options: ReadOptions) -> Surface:
    """Read a mesh, or a cloud without polygons: XML marks its own end, so a cut file fails."""
    file = _File(options.limits.read(path), options.limits)
    points, faces, start = [], [], 0
    for piece in file.pieces():
        count = int(piece.get("NumberOfPoints", "0"))
        points.append(file.numbers(piece.find("Points/DataArray"), 3 * count).reshape(-1, 3))
        for name, triangles in (("Polys", fans), ("Strips", strips)):
            faces.append(triangles(*file.cells(piece, name)) + start)
        start += count
    if not points:
        raise ValueError("no piece in it")
    joined = np.concatenate(faces)
    options.limits.check_counts(start, len(joined))
    return Surface(np.concatenate(points), joined if len(joined) else None)


def space(path: Path, limits: FileLimits) -> str:
    """Read 3D Slicer's axes in the field array SPACE; empty without three letters.

    Raises:
        ValueError, ElementTree.ParseError: a damaged file.
    """
    return _File(limits.read(path), limits).text("SPACE", letters=3)


class _File:
    def __init__(self, data: bytes, limits: FileLimits) -> None:
        if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
            raise ValueError("document types, which are not read")
        self._limits, self._raw = limits, b""
        if raw := RAW.search(data):
            end = data.rfind(b"</AppendedData>")
            data, self._raw = data[: raw.end()] + data[end:], data[raw.end() : end]
        self._root = ElementTree.fromstring(data)
        if self._root.tag != "VTKFile" or self._root.get("type") != "PolyData":
            raise ValueError("no polygonal data in it")
        order = "<" if self._root.get("byte_order") == "LittleEndian" else ">"
        self._order, self._size = order, _type(order, self._root.get("header_type", "UInt32"))
        appended = self._root.find("AppendedData")
        self._appended = "" if appended is None else (appended.text or "").strip().removeprefix("_")

    def pieces(self) -> list[ElementTree.Element]:
        return self._root.findall("PolyData/Piece")

    def cells(self, piece: ElementTree.Element, name: str) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Offsets, from 0, and corners."""
        said = piece.get(f"NumberOf{name}")
        if said is None and piece.find(f"{name}/DataArray") is not None:
            raise ValueError(f"no NumberOf{name} in it")
        count = 0 if said is None else int(said)
        if count == 0:
            return np.zeros(1, dtype=np.int64), np.empty(0, dtype=np.int64)
        arrays = {array.get("Name"): array for array in piece.findall(f"{name}/DataArray")}
        ends = integers(self.numbers(arrays.get("offsets"), count))
        corners = integers(self.numbers(arrays.get("connectivity"), int(ends[-1])))
        return np.concatenate([[0], ends]), corners

    def numbers(self, element: ElementTree.Element | None, count: int) -> Array:
        """Read a given count of numbers of a DataArray."""
        if element is None:
            raise ValueError("an array that is missing")
        if count < 0:
            raise ValueError(f"{count} numbers announced")
        self._limits.check_unpacked(8 * count)
        values = self._values(element, count)
        if len(values) != count:
            raise ValueError(f"{len(values)} numbers where {count} are announced")
        return values

    def text(self, name: str, letters: int) -> str:
        """Read the first string of a field array; VTK ends each with a zero."""
        element = self._root.find(f"PolyData/FieldData/Array[@Name='{name}']")
        if element is None:
            return ""
        if element.get("format") == "ascii":
            data = bytes(int(code) for code in (element.text or "").split()[: letters + 1])
        else:
            stream, compressor = self._stream(element), self._root.get("compressor")
            try:
                data = stream.block() if compressor is None else self._blocks(stream, compressor, letters + 1)
            except ValueError:  # of another length
                return ""
        return data.rstrip(b"\0").decode("ascii") if len(data) <= letters + 1 else ""

    def _values(self, element: ElementTree.Element, count: int) -> Array:
        if element.get("format") == "ascii":
            return np.array((element.text or "").split(), dtype=np.float64)
        dtype = _type(self._order, element.get("type", ""))
        stream = self._stream(element)
        compressor = self._root.get("compressor")
        data = stream.block() if compressor is None else self._blocks(stream, compressor, count * dtype.itemsize)
        return np.frombuffer(data, dtype).astype(np.float64)

    def _stream(self, element: ElementTree.Element) -> Any:
        if element.get("format") == "binary":
            return _Base64((element.text or "").strip(), self._size)
        offset = int(element.get("offset", "0"))
        if element.get("format") != "appended" or offset < 0:
            raise ValueError(f"an array of format {str(element.get('format'))[:20]}")
        return _Raw(self._raw[offset:], self._size) if self._raw else _Base64(self._appended[offset:], self._size)

    def _blocks(self, stream: Any, compressor: str, size: int) -> bytes:
        """Blocks of known sizes, none of which may unpack to more."""
        if compressor not in DECOMPRESSORS:
            raise ValueError(f"compression by {compressor[:40]}, which is not read: save it with zlib")
        blocks, block_size, last, *packed = stream.block_sizes(size)
        sizes = [block_size] * (blocks - bool(last)) + [last] * bool(last)
        if sum(sizes) != size or len(sizes) != blocks:
            raise ValueError(f"{sum(sizes)} packed bytes where {size} are announced")
        return b"".join(_unpacked(part, n, compressor) for part, n in zip(stream.parts(packed), sizes, strict=True))


def _type(order: str, name: str) -> np.dtype:
    if name not in TYPES:
        raise ValueError(f"numbers of type {name[:20]!r}, which are not read: save them as Float32 or Float64")
    return np.dtype(order + TYPES[name])


def _unpacked(part: bytes, size: int, compressor: str) -> bytes:
    stream = DECOMPRESSORS[compressor]()  # type: ignore[operator]
    data = stream.decompress(part, size + 1)
    if len(data) != size or not stream.eof:  # at the end it has compared the checksum
        raise ValueError("packed data that are cut, or longer than announced")
    return bytes(data)


class _Raw:
    """Sizes, then data."""

    def __init__(self, data: bytes, size: np.dtype) -> None:
        self._data, self._size = data, size

    def _sizes(self, count: int) -> list[int]:
        if count * self._size.itemsize > len(self._data):
            raise ValueError("sizes beyond the end of the file")
        return [int(n) for n in np.frombuffer(self._data, self._size, count)]

    def _after(self, count: int, length: int) -> bytes:
        start = count * self._size.itemsize
        if start + length > len(self._data):
            raise ValueError("data beyond the end of the file")
        return self._data[start : start + length]

    def block(self) -> bytes:
        return self._after(1, self._sizes(1)[0])

    def block_sizes(self, most: int) -> list[int]:
        blocks = self._sizes(1)[0]
        if blocks > most:
            raise ValueError(f"{blocks} blocks of {most} bytes")
        self._head = 3 + blocks
        return self._sizes(self._head)

    def parts(self, packed: list[int]) -> list[bytes]:
        ends = np.cumsum([0, *packed])
        data = self._after(self._head, int(ends[-1]))
        return [data[a:b] for a, b in zip(ends, ends[1:], strict=False)]


class _Base64(_Raw):
    """The same in base64; VTK encodes the sizes by themselves, others together with the data."""

    def __init__(self, data: str, size: np.dtype) -> None:
        super().__init__(b"", size)
        self._text = data

    def _sizes(self, count: int) -> list[int]:
        self._data = self._decoded(0, count * self._size.itemsize)
        return super()._sizes(count)

    def _after(self, count: int, length: int) -> bytes:
        head = count * self._size.itemsize
        letters = _letters(head)
        if head % 3 == 0 or self._text[letters - 1 : letters] == "=":
            data = self._decoded(letters, length)
        else:
            data = self._decoded(0, head + length)[head:]
        if len(data) != length:
            raise ValueError("data beyond the end of the file")
        return data

    def _decoded(self, start: int, length: int) -> bytes:
        try:
            return base64.b64decode(self._text[start : start + _letters(length)], validate=True)[:length]
        except binascii.Error as error:
            raise ValueError(f"damaged base64 ({error})") from error


def _letters(length: int) -> int:
    return 4 * -(-length // 3)
