"""STL, binary and text: triangles that each repeat their corners."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from gapr_core.formats import text
from gapr_core.formats.options import ReadOptions
from gapr_core.surface import Array, Surface

HEADER_BYTES, FACET_BYTES = 84, 50
SOLID = re.compile(rb"(\xef\xbb\xbf)?\s*solid", re.IGNORECASE)  # a text file, with or without a byte order mark
BEGINNING = re.compile(rb"^[ \t]*facet[ \t]+normal\b", re.MULTILINE)
END = re.compile(rb"^(?![ \t]*(?:end)?solid\b).*\bendfacet\b", re.MULTILINE)  # in a line that is no name
FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("colour", "<u2")])


def read(path: Path, options: ReadOptions) -> Surface:
    """Vertices that facets share become one."""
    data = options.limits.read(path)
    is_text = SOLID.match(data) is not None
    if len(data) < HEADER_BYTES and not is_text:
        raise ValueError(f"{len(data)} bytes, less than a header")
    facets = int.from_bytes(data[80:84], "little")
    if len(data) == HEADER_BYTES + FACET_BYTES * facets:
        options.limits.check_counts(0, facets)
        corners = np.frombuffer(data, FACET, offset=HEADER_BYTES)["corners"].reshape(-1, 3).astype(np.float64)
    elif is_text:
        corners = _corners_of_text(data)
    else:
        expected = HEADER_BYTES + FACET_BYTES * facets
        raise ValueError(f"{len(data)} bytes where its {facets} facets take {expected}")
    return share_vertices(corners)


def _corners_of_text(data: bytes) -> Array:
    """(3 F, 3) corners of the facets of a text file that ends as it should."""
    lower = data.lower()
    if not lower.rstrip().split(b"\n")[-1].lstrip().startswith(b"endsolid"):
        raise ValueError("no endsolid at the end: the file is cut")
    vertices = (line.split("vertex", 1)[1] for line in text.lines(lower + b"\n") if line.lstrip().startswith("vertex"))
    corners = text.table(vertices, 3)
    begun, ended = (sum(1 for _ in words.finditer(lower)) for words in (BEGINNING, END))
    if len(corners) != 3 * ended or ended != begun:
        raise ValueError("facets that do not have three vertices each")
    return corners


def share_vertices(corners: Array) -> Surface:
    """Join equal corners (3 F, 3) to shared vertices of a mesh."""
    if len(corners) == 0:
        raise ValueError("no facets in it")
    order = np.lexsort(corners.T)
    new = np.ones(len(corners), dtype=bool)
    new[1:] = (np.diff(corners[order], axis=0) != 0.0).any(axis=1)
    vertex = np.empty(len(corners), dtype=np.int64)
    vertex[order] = np.cumsum(new) - 1
    return Surface(corners[order[new]], vertex.reshape(-1, 3))
