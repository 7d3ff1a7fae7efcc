"""XYZ, TXT and CSV: a point a line, and NDI Track's recordings of a tool."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path

import numpy as np

from gapr_core.errors import InvalidPointCloudError
from gapr_core.formats import text, tracker
from gapr_core.formats.limits import FileLimits
from gapr_core.formats.options import ReadOptions
from gapr_core.surface import Surface

DELIMITERS = ",;\t"


def read(path: Path, limits: FileLimits) -> Surface:
    """X y z, or x y z nx ny nz, in the first columns; one line of names and lines that start with # are left out."""
    return _surface(limits.read(path))


def read_csv(path: Path, options: ReadOptions) -> Surface:
    """Columns named x y z (any case), or the first three; of a recording of a tracked tool, where its tip was.

    Raises:
        InvalidPointCloudError: a recording of a tracked tool without the tip, or of several tools and none chosen; or
            a tip or a tool for a file that is no such recording.
    """
    data = options.limits.read(path)
    header = next(text.lines(data), "")
    names = [name.strip().lower() for name in next(csv.reader(io.StringIO(header)), [])]
    if "q0" in names and "tx" in names and options.tip_mm is not None:
        return Surface(tracker.tips(tracker.read_poses(path, options.limits, options.tool), options.tip_mm))
    if "q0" in names and "tx" in names:
        raise tracker.needs_tip(path)
    if options.tip_mm is not None or options.tool is not None:
        given = f"{path.name} without columns q0 and tx"
        raise InvalidPointCloudError(
            "a recording by NDI Track for --tip and --tool", given, "leave both out for points"
        )
    return _surface(data, [names.index(axis) for axis in "xyz"] if set("xyz") <= set(names) else None)


def _surface(data: bytes, columns: list[int] | None = None) -> Surface:
    rows = [line for line in text.lines(data) if line.strip() and not line.lstrip().startswith(("#", "//"))]
    delimiter = next((d for d in DELIMITERS if rows and d in rows[0]), None)
    names: list[str] = []
    if rows and not _is_numbers(rows[0], delimiter):
        names = [re.sub(r"[\s(\[_/].*", "", name.strip(' "\ufeff').lower()) for name in rows[0].split(delimiter)]
        rows = rows[1:]
    values = text.table(rows, delimiter=delimiter)
    if values.shape[1] < 3:
        raise ValueError(f"{values.shape[1]} columns, not x y z")
    if columns is None and len(names) == values.shape[1] and names[:3] != list("xyz"):
        if not set("xyz") <= set(names):
            raise ValueError(f"columns {' '.join(names)}: name them x y z, or leave that line out")
        columns = [names.index(axis) for axis in "xyz"]
    points = values[:, columns or [0, 1, 2]]
    has_normals = columns is None and values.shape[1] == 6 and _are_units(values[:, 3:])
    return Surface(points, None, values[:, 3:] if has_normals else None)


def _is_numbers(line: str, delimiter: str | None) -> bool:
    try:
        [float(word) for word in line.split(delimiter)]
    except ValueError:
        return False
    return True


def _are_units(vectors: np.ndarray) -> bool:
    return bool(np.allclose(np.linalg.norm(vectors, axis=1), 1.0, atol=0.01))
