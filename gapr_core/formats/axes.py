"""Patient axes: LPS (left, posterior, superior) inside, and RAS (right, anterior, superior) as some files have it.

The change is a turn by 180 deg about the long axis of the body: a rigid motion, so that no residual shows a wrong one.
"""

from __future__ import annotations

import logging
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gapr_core.errors import ConfigError
from gapr_core.surface import Surface

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

LPS_RAS = np.array([-1.0, -1.0, 1.0])  # the same both ways
FACTORS = {"lps": np.ones(3), "as_is": np.ones(3), "ras": LPS_RAS, "lps_to_ras": LPS_RAS}
CHOICES = ("auto", *FACTORS)
COMMENT = re.compile(rb"SPACE=(LPS|RAS)\b")
CODES = re.compile(rb'<Array[^>]*Name="SPACE"[^>]*format="ascii"[^>]*>([\d\s]+)</')  # VTP: letters by their codes
COMMENT_BYTES = 8192


def turned(surface: Surface, path: Path, axes: str) -> Surface:
    """The surface of a file in LPS, as far as the axes are known.

    Args:
        surface: as it is in the file.
        path: the file, whose comment may say SPACE=LPS or SPACE=RAS, as those of 3D Slicer do.
        axes: see `ReadOptions`.

    Raises:
        ConfigError: unknown axes.
    """
    if axes not in CHOICES:
        raise ConfigError(f"axes {' '.join(CHOICES)}", repr(axes), "name one of them")
    said = stated(path)
    if axes in ("lps", "ras") and said not in (None, axes):
        log.warning("%s says SPACE=%s and is read as %s", path.name, said.upper(), axes.upper())
    if axes == "auto" and said == "ras":
        log.warning("%s says SPACE=RAS: x and y are negated, to LPS", path.name)
    return scaled(surface, FACTORS[said or "as_is" if axes == "auto" else axes])


def scaled(surface: Surface, factors: Array) -> Surface:
    """Points and normals times factors (3,) of 1 and -1 that are a rotation."""
    normals = None if surface.normals is None else surface.normals * factors
    return Surface(surface.points * factors, surface.faces, normals)


def stated(path: Path) -> str | None:
    """What a comment in the file's beginning says, "lps" or "ras"; None without one."""
    with path.open("rb") as file:
        head = file.read(COMMENT_BYTES)
    if found := COMMENT.search(head):
        return found[1].decode().lower()
    if found := CODES.search(head):
        text = "".join(chr(int(code)) for code in found[1].split()[:9] if 0 < int(code) < 128).lower()
        return text if text in FACTORS else None
    return None


def to_lps(points: Array, space: str) -> Array:
    """Points (N, 3) of axes "lps" or "ras" in LPS."""
    return points * FACTORS[space]
