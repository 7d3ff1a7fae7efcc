"""Numbers in text files: few bytes of memory for each, and no guess about what is missing."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator
from itertools import chain

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def lines(data: bytes) -> Iterator[str]:
    """The lines of a text file, one at a time, without the byte order mark that Windows puts before them.

    Raises:
        ValueError: the last line does not end.
    """
    check_end(data)
    return iter(io.TextIOWrapper(io.BytesIO(data), encoding="utf-8-sig", errors="replace"))


def check_end(data: bytes) -> None:
    """Raise `ValueError` where the last line does not end: whether its last number is whole cannot be known."""
    if not data.rstrip(b" \t").endswith((b"\n", b"\r")):
        raise ValueError("the last line does not end: the file is cut, or it is whole and lacks a line break")


def table(rows: Iterable[str], columns: int | None = None, delimiter: str | None = None) -> Array:
    """(N, columns) numbers, one row a line; (0, 0) without any line.

    Raises:
        ValueError: rows of different lengths, another number of columns, or something that is no number.
    """
    filled = (row for row in rows if row.strip())
    first = next(filled, None)
    if first is None:
        return np.empty((0, 0))
    values = np.loadtxt(chain([first], filled), ndmin=2, comments=None, delimiter=delimiter)
    if columns is not None and values.shape[1] != columns:
        raise ValueError(f"{values.shape[1]} columns where {columns} are announced")
    return values
