"""Numbers in text files: few bytes of memory for each, and no guess about missing ones."""

from __future__ import annotations

import codecs
import io
import re
from collections.abc import Iterable, Iterator
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from gapr_core.errors import InvalidPointCloudError

Array = NDArray[np.float64]

UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
NOT_A_NUMBER = re.compile(rb"[-+]?(nan\(\w*\)|1\.#(IND|QNAN|SNAN)\d*)", re.IGNORECASE)
LOOKED_AT = 64  # bytes at the beginning: enough to see that every other one is zero


def lines(data: bytes) -> Iterator[str]:
    """Yield the lines of a text file, without the byte order mark of Windows.

    Raises:
        InvalidPointCloudError: UTF-16.
        ValueError: the last line does not end.
    """
    check_end(data)
    return iter(io.TextIOWrapper(io.BytesIO(plain(data)), encoding="utf-8-sig", errors="replace"))


def plain(data: bytes) -> bytes:
    """Text with nan where C libraries of Windows write `-nan(ind)` or `1.#QNAN`."""
    return NOT_A_NUMBER.sub(b"nan", data) if b"nan(" in data or b"1.#" in data else data


def check_end(data: bytes) -> None:
    """Raise `ValueError` where the last line does not end: whether its last number is whole cannot be known.

    Raises:
        InvalidPointCloudError: UTF-16.
    """
    check_encoding(data)
    if not data.rstrip(b" \t").endswith((b"\n", b"\r")):
        raise ValueError("the last line does not end: the file is cut, or it is whole and lacks a line break")


def check_encoding(data: bytes) -> None:
    """Raise `InvalidPointCloudError` for text in UTF-16."""
    if is_utf_16(data):
        raise InvalidPointCloudError("UTF-8 text", "UTF-16 text", "save it as UTF-8")


def is_utf_16(data: bytes) -> bool:
    """Tell whether a file begins with UTF-16's byte order mark, or letters of two bytes."""
    even, odd = data[:LOOKED_AT:2], data[1:LOOKED_AT:2]
    return data.startswith(UTF_16) or any(len(a) > 1 and not any(a) and all(b) for a, b in ((even, odd), (odd, even)))


def table(rows: Iterable[str], columns: int | None = None, delimiter: str | None = None, quotes: bool = False) -> Array:
    """Return numbers (N, columns), one row a line, in quotes if asked for; (0, 0) without lines.

    Raises:
        ValueError: rows of different lengths, another number of columns, or something that is no number.
    """
    filled = (row for row in rows if row.strip())
    first = next(filled, None)
    if first is None:
        return np.empty((0, 0))
    values = np.loadtxt(chain([first], filled), ndmin=2, comments=None, delimiter=delimiter,
                        quotechar='"' if quotes else None)  # fmt: skip
    if columns is not None and values.shape[1] != columns:
        raise ValueError(f"{values.shape[1]} columns where {columns} are announced")
    return values
