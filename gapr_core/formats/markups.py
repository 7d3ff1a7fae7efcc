"""Points that were placed by hand in 3D Slicer: .mrk.json, and .fcsv of all its versions."""

from __future__ import annotations

import csv
import json
import logging
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.errors import GaprError, InvalidPointCloudError
from gapr_core.formats import axes, signatures
from gapr_core.formats.limits import FileLimits
from gapr_core.formats.options import ReadOptions
from gapr_core.formats.reading import reason_of, unreadable
from gapr_core.formats.text import check_encoding, check_end
from gapr_core.geometry.extent import BEYOND
from gapr_core.runtime.files import write_json
from gapr_core.surface import Surface

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

NUMBERED = {"0": "ras", "1": "lps", "ras": "ras", "lps": "lps"}  # Slicer before 4.11 wrote a number
STATUS, PLACED = ("0", "1", "2", "3"), "2"  # of a position in .fcsv: undefined, preview, placed, missing
MM_PER_UNIT = {"mm": 1.0, "m": 1000.0, "cm": 10.0, "um": 0.001}
LONGEST_TYPE = 20  # characters of a list's type that a warning shows
SCHEMA = "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/markups-schema-v1.0.3.json#"


@dataclass(frozen=True, eq=False)
class Markups:
    """Named points.

    Attributes:
        points: (N, 3) LPS, mm.
        labels: their N names.
        lists: how many points of which type each list of a file has, such as "40 Fiducial"; empty lists are left out.
    """

    points: Array
    labels: tuple[str, ...]
    lists: tuple[str, ...] = ()


def read(path: Path, options: ReadOptions) -> Surface:
    """Read the points alone, LPS mm; several lists are joined, with a warning."""
    found = _load(path, options.limits)
    if len(found.lists) > 1:
        log.warning("%s: %d lists are joined (%s); save one by itself if they are not points of one bone",
                    path.name, len(found.lists), ", ".join(found.lists))  # fmt: skip
    return Surface(found.points)


def load(path: Path) -> Markups:
    """Points and names of a .mrk.json or .fcsv file.

    Raises:
        InvalidPointCloudError: not there, damaged, empty, or without its coordinate system.
    """
    if not path.exists():
        raise InvalidPointCloudError("a file that exists", str(path), "check the path")
    if not path.is_file() or not path.name.lower().endswith((".mrk.json", ".fcsv")):
        how = signatures.hint_of_markups(path) or "save the points from 3D Slicer"
        raise InvalidPointCloudError("markups: a .mrk.json or .fcsv file", str(path), how)
    signatures.check_packed(path, path.suffix.lower())
    try:
        found = _load(path, FileLimits.from_environment())
    except GaprError:
        raise
    except Exception as error:  # whatever a damaged file leads to: the sentence is the same
        raise unreadable(path, reason_of(error)) from error
    if len(found.points) == 0:
        raise unreadable(path, "no points in it")
    return found


def _load(path: Path, limits: FileLimits) -> Markups:
    data = limits.read(path)
    check_encoding(data)
    markups = _of_fcsv(data) if path.suffix.lower() == ".fcsv" else _of_json(json.loads(data.decode("utf-8-sig")))
    if not (np.abs(markups.points) < BEYOND).all():
        given = f"{path.name} with others"
        raise InvalidPointCloudError(f"coordinates of finite numbers below {BEYOND:g}", given, "place the points again")
    return markups


def save(path: Path, markups: Markups, descriptions: list[str] | None = None) -> None:
    """Write a point list that 3D Slicer loads."""
    texts = descriptions or [""] * len(markups.labels)
    points = [
        {"id": str(i), "label": label, "description": text, "position": point.tolist(), "positionStatus": "defined"}
        for i, (point, label, text) in enumerate(zip(markups.points, markups.labels, texts, strict=True), start=1)
    ]
    node = {"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": points}
    write_json(path, {"@schema": SCHEMA, "markups": [node]})


def _of_json(content: Any) -> Markups:
    points, labels, lists = [], [], []
    for node in _nodes(content):
        space = _space(node.get("coordinateSystem"))
        mm = _mm_per_unit(node.get("coordinateUnits", "mm"))
        if "controlPoints" not in node:
            raise ValueError(f"a {node.get('type', 'node')} without points")
        placed = [p for p in _objects(node, "controlPoints") if p.get("positionStatus", "defined") == "defined"]
        positions = np.array([_position(p) for p in placed], dtype=np.float64).reshape(-1, 3)
        points.append(axes.to_lps(positions * mm, space))
        labels += [str(p.get("label") or "") for p in placed]
        lists += [f"{len(placed)} {str(node.get('type', 'points'))[:LONGEST_TYPE]}"] if placed else []
    if not points:
        raise ValueError("no markups in it")
    return Markups(np.vstack(points), tuple(labels), tuple(lists))


def _nodes(content: Any) -> list[dict[str, Any]]:
    if not isinstance(content, dict) or "markups" not in content:
        raise ValueError("JSON without the list `markups`: save control points from 3D Slicer")
    return _objects(content, "markups")


def _objects(holder: dict[str, Any], name: str) -> list[dict[str, Any]]:
    """Return the list of this name, which holds objects alone."""
    listed = holder[name]
    if not isinstance(listed, list) or not all(isinstance(item, dict) for item in listed):
        raise ValueError(f"`{name}` that is no list of objects")
    return listed


def _position(point: dict[str, Any]) -> list[float]:
    position = point.get("position")
    if isinstance(position, list) and len(position) == 3 and all(type(value) in (int, float) for value in position):
        return [float(value) for value in position]
    raise ValueError("a position that is not x y z")


def _of_fcsv(data: bytes) -> Markups:
    check_end(data)
    text = data.decode("utf-8-sig")
    spaces = {_space(word) for word in re.findall(r"^#\s*CoordinateSystem\s*=\s*(\w+)", text, re.MULTILINE) or [None]}
    if len(spaces) > 1:
        raise ValueError("lines CoordinateSystem that contradict each other: several files in one, split them")
    columns = re.search(r"^#\s*columns\s*=\s*(.+)$", text, re.MULTILINE)
    names = [name.strip() for name in (columns[1] if columns else "id,x,y,z").split(",")]
    lines = re.sub(r"\r+(?=,)", "", text).splitlines()  # some versions keep a CR within the row
    rows = [row for row in csv.reader(lines) if row and not row[0].startswith("#")]
    if columns:
        rows = [row for row in rows if _is_placed(row, len(names))]
    if not set("xyz") <= set(names):
        raise ValueError(f"columns {' '.join(names)[:60]}, not x y z")
    at = [names.index(axis) for axis in "xyz"]
    if any(len(row) <= max(at) for row in rows):
        raise ValueError("a row that ends before its x y z")
    points = np.array([[float(row[i]) for i in at] for row in rows]).reshape(-1, 3)
    label = names.index("label") if "label" in names else 0
    return Markups(axes.to_lps(points, spaces.pop()), tuple(row[label] if label < len(row) else "" for row in rows))


def _is_placed(row: list[str], count: int) -> bool:
    """Tell whether the point of a row under `count` names was placed.

    Some versions add two cells without a name: the status of the position, and the type of the point.
    """
    more = [cell.strip() for cell in row[count:]]
    if more and not (len(more) == 2 and more[0] in STATUS and more[1].isdecimal()):
        counts, start = f"a row of {len(row)} values under {count} names", ",".join(row)[:50]
        raise ValueError(f"{counts}, {start!r}: quote texts and numbers with a comma, and end no row with one")
    return not more or more[0] == PLACED


def _mm_per_unit(stated: object) -> float:
    """Look up a unit, alone, with its code (mm, UCUM, millimeter; schema 1.0.3) or once per axis."""
    if isinstance(stated, list) and len(stated) in (2, 3) and stated[1] == "UCUM":
        stated = stated[0]
    units = set(map(str, stated)) if isinstance(stated, list) else {str(stated)}
    if len(units) != 1 or not units <= MM_PER_UNIT.keys():
        raise ValueError(f"coordinateUnits {stated!r}, none of {' '.join(MM_PER_UNIT)}")
    return MM_PER_UNIT[units.pop()]


def _space(stated: object) -> str:
    """Look up axes by name; never guess: wrong ones turn every point by 180 deg."""
    known = NUMBERED.get(str(stated).strip().lower())
    if known is None:
        raise ValueError(f"coordinateSystem {stated!r}, neither LPS nor RAS")
    return known
