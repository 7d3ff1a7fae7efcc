"""OBJ: vertices and polygons; texture, normals and materials stay behind."""

from __future__ import annotations

import logging
import re
from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gapr_core.formats import text
from gapr_core.formats.meshes.polygons import fans
from gapr_core.formats.meshes.stl import share_vertices
from gapr_core.formats.options import ReadOptions
from gapr_core.surface import Surface, check_faces

log = logging.getLogger(__name__)

ANNOUNCED = re.compile(r"#.*?(vertices|triangles|faces)\s*:\s*(\d+)\s*$", re.IGNORECASE)
FEWEST_USED = 0.95  # share of the vertices that belong to a face; the file ends too early, where fewer do


def read(path: Path, options: ReadOptions) -> Surface:
    """Read a mesh. The format states no length, so a file without faces or with unused vertices is refused.

    A cut at the end of a line that leaves every vertex with a face cannot be known: an open mesh is logged.
    """
    vertices, corners, ends, announced = array("d"), array("q"), array("q", [0]), {}
    lines = text.lines(options.limits.read(path))
    for line in lines:
        kind, rest = (*line.split(None, 1), "", "")[:2]
        if kind == "v":
            vertices.extend(_coordinates(_words(rest, lines)))
        elif kind == "f":
            corners.extend(_vertex(corner, len(vertices) // 3) for corner in _words(rest, lines))
            ends.append(len(corners))
        elif found := ANNOUNCED.match(line):
            announced[found[1].lower()] = int(found[2])
    triangles = len(corners) - 2 * (len(ends) - 1)  # of a face with n corners n - 2
    options.limits.check_counts(len(vertices) // 3, max(triangles, 0))
    surface = Surface(np.array(vertices).reshape(-1, 3), fans(np.array(ends), np.array(corners)))
    if len(surface.triangles) == 0:
        raise ValueError("no faces in it: the file is cut; clouds go into PLY or NPY files")
    check_faces(surface, path.name)
    _check_whole(surface, len(ends) - 1, announced)
    if not announced and (open_edges := _open_edges(surface)):
        log.warning("%s is open at %d edges: compare it with what was exported, it may be cut", path.name, open_edges)
    return surface


def _words(rest: str, lines: Iterator[str]) -> list[str]:
    """Without a comment, and with those of the next line where a backslash is the last one.

    Raises:
        ValueError: no next line.
    """
    words = rest.partition("#")[0].split()
    while words and words[-1].endswith("\\"):
        if (following := next(lines, None)) is None:
            raise ValueError("a backslash at the end: the file is cut")
        words = [*words[:-1], *f"{words[-1][:-1]} {following}".partition("#")[0].split()]
    return words


def _coordinates(words: list[str]) -> list[float]:
    values = [float(word) for word in words[:3]]
    if len(values) < 3:
        raise ValueError("a vertex with fewer than three coordinates")
    return values


def _vertex(corner: str, count: int) -> int:
    """Vertex index from 0 of `7`, `7/1/3` or `-1`, counted from the last one so far."""
    number = int(corner.split("/")[0])
    index = number - 1 if number > 0 else count + number
    if number == 0 or not 0 <= index:
        raise ValueError(f"a face with vertex {number}")
    return index


def _check_whole(surface: Surface, polygons: int, announced: dict[str, int]) -> None:
    present = {"vertices": len(surface.points), "faces": polygons, "triangles": polygons}
    for name, count in announced.items():
        if present[name] != count:
            raise ValueError(f"{present[name]} {name} where its comment announces {count}")
    used = len(np.unique(surface.triangles))
    if used < FEWEST_USED * len(surface.points):
        raise ValueError(f"{len(surface.points) - used} vertices belong to no face: the file is cut")


def _open_edges(surface: Surface) -> int:
    """Number of edges that belong to one triangle only, whether or not triangles share their vertices."""
    faces = share_vertices(surface.points[surface.triangles].reshape(-1, 3)).triangles
    edges = np.sort(np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    _, uses = np.unique(edges[:, 0] * (faces.max() + 1) + edges[:, 1], return_counts=True)
    return int((uses == 1).sum())
