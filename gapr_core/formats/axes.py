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

from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_core.formats import columns
from gapr_core.formats.limits import FileLimits
from gapr_core.formats.meshes import vtk, vtp
from gapr_core.surface import Surface

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

LPS_RAS = np.array([-1.0, -1.0, 1.0])  # the same both ways
FACTORS = {"lps": np.ones(3), "as_is": np.ones(3), "ras": LPS_RAS, "lps_to_ras": LPS_RAS}
CHOICES = ("auto", *FACTORS)
COMMENT = re.compile(rb"\bSPACE[ \t]*=[ \t]*(LPS|RAS)\b", re.IGNORECASE)
COMMENT_BYTES = 8192
IN_FIELDS = {".vtk": vtk.space, ".vtp": vtp.space}  # wherever in the file the field is
OPTIONS = "--axes, --source-axes or model_axes"


def turned(surface: Surface, path: Path, axes: str) -> Surface:
    """Turn the surface of a mesh or cloud file into LPS, once at most.

    The caller's axes win over the file's, and a contradiction is logged. "lps_to_ras" states LPS as well, so a file in
    RAS is refused.

    Args:
        surface: as it is in the file.
        path: the file, whose comment may say SPACE=LPS or SPACE=RAS, or whose columns may be named l p s or r a s, as
            those of 3D Slicer do.
        axes: see `ReadOptions`.

    Raises:
        ConfigError: unknown axes, or "lps_to_ras" of a file that says RAS.
        InvalidPointCloudError: as `stated`.
    """
    check(axes)
    stated, how = _stated(path) or (None, "")
    if axes == "lps_to_ras" and stated == "ras":
        raise ConfigError("a file in LPS for lps_to_ras", f"{path.name}, which {how}", "use as_is: it is RAS")
    if axes == "auto" and stated == "ras":
        log.warning("%s %s: x and y are negated, to LPS", path.name, how)
    elif stated == "ras" and axes == "as_is":
        log.warning("%s %s and is read as it is (%s): auto turns it to LPS", path.name, how, OPTIONS)
    elif stated == "ras" and axes != "ras":
        log.warning("%s %s and is read as %s: %s says so", path.name, how, axes.upper(), OPTIONS)
    elif stated == "lps" and axes == "ras":
        log.warning("%s %s and is read as RAS: %s says so", path.name, how, OPTIONS)
    return scaled(surface, FACTORS[stated or "as_is" if axes == "auto" else axes])


def turned_as_named(surface: Surface, path: Path, axes: str, in_lps: bool) -> Surface:
    """Turn the surface of a file in LPS (`in_lps`), or in a tracker's axes, into the named axes.

    Raises:
        ConfigError: unknown axes, or "ras" of a file that says its axes.
    """
    check(axes)
    if axes == "ras" and in_lps:
        raise ConfigError("axes of a mesh or a cloud", f"ras for {path.name}, which has its own", "leave them out")
    return surface if axes == "auto" else scaled(surface, FACTORS[axes])


def check(axes: str) -> None:
    """Raise `ConfigError` for a name that means no axes."""
    if axes not in CHOICES:
        raise ConfigError(f"axes that are one of {', '.join(CHOICES)}", repr(axes), "name one of them")


def scaled(surface: Surface, factors: Array) -> Surface:
    """Points and normals times factors (3,) of 1 and -1 that are a rotation."""
    normals = None if surface.normals is None else surface.normals * factors
    camera = None if surface.camera is None else surface.camera * factors
    return replace(surface, points=surface.points * factors, normals=normals, camera=camera)


def stated(path: Path) -> str | None:
    """Return the axes in the file's first comment or column names, "lps" or "ras"; None without.

    Raises:
        InvalidPointCloudError: comments that contradict each other, columns of several kinds, or others than the
            comment says.
    """
    stated = _stated(path)
    return stated[0] if stated else None


def _stated(path: Path) -> tuple[str, str] | None:
    """Return the axes that a file states, and where."""
    comment = _in_comment(path)
    named = columns.space(path) if path.suffix.lower() in columns.ENDINGS else None
    if comment and named and comment != named:
        given = f"SPACE={comment.upper()} and columns {' '.join(named)}"
        raise InvalidPointCloudError("the same axes by comment and columns", given, "correct one of them")
    if comment:
        return comment, f"says SPACE={comment.upper()}"
    return (named, f"has columns {' '.join(named)}") if named else None


def _in_comment(path: Path) -> str | None:
    with path.open("rb") as file:
        head = file.read(COMMENT_BYTES)
    if found := {space.decode().lower() for space in COMMENT.findall(head)}:
        if len(found) > 1:
            how = "take out the one that is wrong"
            raise InvalidPointCloudError("one SPACE in all comments", "SPACE=LPS and SPACE=RAS", how)
        return found.pop()
    if space_of := IN_FIELDS.get(path.suffix.lower()):
        text = space_of(path, FileLimits.from_environment()).lower()
        return text if text in ("lps", "ras") else None
    return None


def to_lps(points: Array, space: str) -> Array:
    """Points (N, 3) of axes "lps" or "ras" in LPS."""
    return points * FACTORS[space]
