"""Patient axes: LPS (left, posterior, superior) inside, and RAS (right, anterior, superior) as some files have it.

The change is a turn by 180 deg about the long axis of the body: a rigid motion, so that no residual shows a wrong one.
Files are turned here alone, for the library, the command line and the node.
"""

from __future__ import annotations

import logging
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gapr_core.errors import ConfigError
from gapr_core.formats.limits import FileLimits
from gapr_core.formats.meshes import vtp
from gapr_core.surface import Surface

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

LPS_RAS = np.array([-1.0, -1.0, 1.0])  # the same both ways
FACTORS = {"lps": np.ones(3), "as_is": np.ones(3), "ras": LPS_RAS, "lps_to_ras": LPS_RAS}
CHOICES = ("auto", *FACTORS)
COMMENT = re.compile(rb"SPACE=(LPS|RAS)\b")
COMMENT_BYTES = 8192


def turned(surface: Surface, path: Path, axes: str) -> Surface:
    """The surface of a mesh or cloud file, turned once at most.

    What the caller says wins over the file, and a contradiction is logged; "lps_to_ras" says LPS as well, and what it
    makes of a file that says RAS would be neither, so that is refused.

    Args:
        surface: as it is in the file.
        path: the file, whose comment may say SPACE=LPS or SPACE=RAS, as those of 3D Slicer do.
        axes: see `ReadOptions`.

    Raises:
        ConfigError: unknown axes, or "lps_to_ras" of a file that says RAS.
    """
    check(axes)
    said = stated(path)
    if axes == "lps_to_ras" and said == "ras":
        raise ConfigError("a file in LPS for lps_to_ras", f"{path.name}, which says SPACE=RAS", "use as_is: it is RAS")
    if axes == "auto" and said == "ras":
        log.warning("%s says SPACE=RAS: x and y are negated, to LPS", path.name)
    elif said == "ras" and axes != "ras":
        log.warning("%s says SPACE=RAS and is read as %s, as you say", path.name, axes.upper())
    elif said == "lps" and axes == "ras":
        log.warning("%s says SPACE=LPS and is read as RAS, as you say", path.name)
    return scaled(surface, FACTORS[said or "as_is" if axes == "auto" else axes])


def of_patient(surface: Surface, path: Path, axes: str) -> Surface:
    """The surface of a file that is in LPS already, by its own header: "lps_to_ras" alone turns it.

    Raises:
        ConfigError: unknown axes, or "ras": such a file says its axes.
    """
    check(axes)
    if axes == "ras":
        raise ConfigError("axes of a mesh or a cloud", f"ras for {path.name}, which says its own", "leave them out")
    return scaled(surface, FACTORS["lps_to_ras"]) if axes == "lps_to_ras" else surface


def check(axes: str) -> None:
    """Raise `ConfigError` for a name that means no axes."""
    if axes not in CHOICES:
        raise ConfigError(f"axes {' '.join(CHOICES)}", repr(axes), "name one of them")


def scaled(surface: Surface, factors: Array) -> Surface:
    """Points and normals times factors (3,) of 1 and -1 that are a rotation."""
    normals = None if surface.normals is None else surface.normals * factors
    camera = None if surface.camera is None else surface.camera * factors
    return replace(surface, points=surface.points * factors, normals=normals, camera=camera)


def stated(path: Path) -> str | None:
    """What a comment in the file's beginning says, "lps" or "ras"; None without one."""
    with path.open("rb") as file:
        head = file.read(COMMENT_BYTES)
    if found := COMMENT.search(head):
        return found[1].decode().lower()
    if path.suffix.lower() == ".vtp":
        text = vtp.space(path, FileLimits.from_environment()).lower()
        return text if text in ("lps", "ras") else None
    return None


def to_lps(points: Array, space: str) -> Array:
    """Points (N, 3) of axes "lps" or "ras" in LPS."""
    return points * FACTORS[space]
