"""Clouds and meshes from files and arrays: formats, units, cleaning."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_core.formats import columns, reading
from gapr_core.formats.options import ReadOptions
from gapr_core.geometry.extent import is_point
from gapr_core.results import ResultWarning
from gapr_core.surface import Array, Surface, as_array, as_points, check_faces

log = logging.getLogger(__name__)

MM_PER_UNIT = {"mm": 1.0, "m": 1000.0, "cm": 10.0, "in": 25.4}
NAMES = {unit: unit for unit in MM_PER_UNIT} | {"in": "inches"}
PLAUSIBLE = (0.15, 1.2)  # a cloud of a bone has this share of its extent
EXTENT_LIMITS_MM = (10.0, 2500.0)  # bounding-box diagonal of a piece of bone, and of the longest skeleton part
CONVERT, OF_HEADER = "convert it to {read_as}", "correct the unit in its header, or convert it to mm"
OF_ARRAY = "pass units={unit!r}, or convert it to {read_as}"
OPTIONS = "--units {unit}; --source-units {unit}, of the source alone; model_unit of the node"
OF_FILE = f"pass units={{unit!r}} ({OPTIONS}), or convert it to {{read_as}}"
WHOLE_BONE_MM = (60.0, 700.0)  # smaller are a patella, bones of hand and foot, the neck's vertebrae; larger is no bone


def load(
    source: str | Path | ArrayLike | Surface,
    units: str = "mm",
    options: ReadOptions | None = None,
    *,
    of_bone: bool = True,
) -> Surface:
    """Load a surface in mm from a file, an array or another surface.

    Args:
        source: path to a mesh or cloud, a label map, markups or tracked slices (docs/reference/formats.md); an (N, 3)
            array of floats, of which finite rows are kept; or a `Surface`.
        units: "mm", "cm", "m" or "in"; "auto" takes the unit in the names of the columns, or guesses mm or m from the
            extent and logs a warning. Files in patient coordinates (label maps, markups) and a tracker's recordings are
            in mm, whatever is named here.
        options: axes of a mesh, labels of a label map, limits (see `ReadOptions`).
        of_bone: checks for the size of a bone or a piece of one; False for single points.

    A mesh file or a label of several separate long bones is read as one body, with a warning.

    Raises:
        InvalidPointCloudError: unreadable file, unknown format, wrong shape, nothing finite, an extent that cannot be a
            bone in the unit named, or another unit in the names of its columns.
        ConfigError: options that are no `ReadOptions`, or that the file cannot follow.
    """
    if options is not None and not isinstance(options, ReadOptions):
        how = "pass ReadOptions(axes=..., labels=...) of gapr_core"
        raise ConfigError("options as ReadOptions", type(options).__name__, how)
    path = None
    if isinstance(source, str | Path):
        path = Path(source)
        name, surface, how = str(source), reading.read(path, options), OF_FILE
    elif isinstance(source, Surface):
        name, surface, how = "array", _checked(source), OF_ARRAY
    else:
        name, surface, how = "array", Surface(as_points(source)), OF_ARRAY
    surface = _drop_non_finite(surface, name)
    if of_bone:
        _check_apart(surface, name)
    if path is None and surface.faces is not None and len(surface.faces):
        check_faces(surface, name)
    if path is not None and reading.format_of(path).is_in_mm(options or ReadOptions()):
        units, how = "mm", OF_HEADER
    elif path is not None:
        units = _agreed(units, columns.unit(path), name)
        _warn_of_columns(path, surface)
    units = _known(surface, units, name)
    if of_bone:
        _check_size(surface, units, name, how)
    scale = MM_PER_UNIT[units]
    camera = None if surface.camera is None else surface.camera * scale
    unit = surface.unit if path is None else units
    surface = replace(surface, points=surface.points * scale, camera=camera, unit=unit)
    if path is not None:
        _warn_of_several_bones(surface, name)
    return surface


def _checked(surface: Surface) -> Surface:
    """Check a caller's surface; turn its lists into arrays."""
    points, faces, normals = as_points(surface.points), surface.faces, surface.normals
    if faces is not None:
        faces = as_array(faces, "triangles as (F, 3) integers", "triangulate the mesh")
    if normals is not None:
        normals = as_points(normals)
        if len(normals) != len(points):
            given = f"{len(normals)} normals of {len(points)} points"
            raise InvalidPointCloudError("a normal for each point", given, "leave the normals out, or pass all")
    return replace(surface, points=points, faces=faces, normals=normals)


def finite_points(array: ArrayLike) -> Array:
    """Keep the finite rows of an (N, 3) array below 1e12; the result may be empty."""
    points = as_points(array)
    usable = is_point(points)
    return points if usable.all() else points[usable]


def check_extent(extent_mm: float, unit: str, name: str, how: str = CONVERT) -> None:
    """Raise `InvalidPointCloudError` when something of this size cannot be a bone or a piece of one.

    Args:
        extent_mm: its diagonal.
        unit: that it was read as, "mm", "cm" or "m".
        name: what it is called in the message.
        how: to correct the unit, with places for the `unit` that it looks like and the one that it was `read_as`.
    """
    low, high = EXTENT_LIMITS_MM
    if low <= extent_mm <= high:
        return
    others = _across_mm(extent_mm / MM_PER_UNIT[unit], (low, high))
    others = {"m": others["m"]} if "m" in others else others  # what scanners and ROS write
    hint = "check the file and its unit"
    if others:
        looks = " or ".join(others if len(others) == 1 else [f"{u} ({mm:.0f} mm across)" for u, mm in others.items()])
        hint = f"it looks like {looks}: {how.format(unit=next(iter(others)), read_as=unit)}"
    raise InvalidPointCloudError(
        f"a bone or a piece of one, {low:g} to {high:g} mm across",
        f"{name} of {extent_mm:.3g} mm read as {unit}",
        hint,
    )


def _across_mm(extent: float, limits_mm: tuple[float, float]) -> dict[str, float]:
    """Size in mm by each unit of a number that makes one within the limits."""
    sizes = {unit: extent * mm for unit, mm in MM_PER_UNIT.items()}
    return {unit: size for unit, size in sizes.items() if limits_mm[0] <= size <= limits_mm[1]}


def odd_size(bone: Surface) -> ResultWarning | None:
    """Give the warning of a whole bone from a file, mm, whose size is that of another unit.

    A bone and a source in the same wrong unit fit each other: only the size can show it.
    """
    if not bone.unit:
        return None
    low, high = WHOLE_BONE_MM
    extent_mm = bone.extent_mm
    others = _across_mm(extent_mm / MM_PER_UNIT[bone.unit], WHOLE_BONE_MM)
    sizes = ", ".join(f"{size:.0f} mm in {NAMES[unit]}" for unit, size in others.items() if unit != bone.unit)
    if low <= extent_mm <= high and not (bone.unit == "cm" and "in" in others):
        return None
    what = "longer than any human bone" if extent_mm > high else "as small as a patella" if extent_mm < low else ""
    text = f"The bone is {extent_mm:.3g} mm across, read in {NAMES[bone.unit]}{', ' * bool(what)}{what}."
    advice = "A femur has 350 to 550 mm, a pelvis 250 to 350 mm" + (f"; this one has {sizes}. " if sizes else ". ")
    how = "If the unit is wrong, name it (units, --units of both files, model_unit), or correct a label map's header."
    return ResultWarning("bone_size", text, advice + how)


def warn_of_size(name: str, bone: Surface) -> None:
    """Log the warning of `odd_size` where a bone is loaded."""
    if found := odd_size(bone):
        log.warning("%s: %s", name, found)


def _warn_of_columns(path: Path, surface: Surface) -> None:
    """Warn of a text file whose other columns nobody has named, and which are no normals."""
    count = columns.unnamed(path)
    if count > 3 and surface.normals is None:
        log.warning("%s has %d columns without names: the first three are taken as x y z, the others are left out; if "
                    "that is wrong, begin with a line of names", path.name, count)  # fmt: skip


def _agreed(units: str, stated: str | None, name: str) -> str:
    """Return the named unit, or with "auto" the file's.

    Raises:
        InvalidPointCloudError: they contradict each other.
    """
    if stated is None or units == stated:
        return units
    if units != "auto":
        given = f"{name} with coordinates in {stated} by their names, read as {units}"
        raise InvalidPointCloudError("the unit that the file says", given, OF_FILE.format(unit=stated, read_as=units))
    return stated


def _known(surface: Surface, units: str, name: str) -> str:
    """Return the named unit, or with "auto" the one that fits the extent."""
    if units == "auto":
        units = "m" if surface.extent_mm < EXTENT_LIMITS_MM[0] else "mm"
        log.warning("%s is %.3g across: taken to be in %s; name the unit to be sure", name, surface.extent_mm, units)
    if units not in MM_PER_UNIT:
        raise InvalidPointCloudError("units 'mm', 'cm', 'm', 'in' or 'auto'", repr(units), "name one of them")
    return units


def _check_size(surface: Surface, unit: str, name: str, how: str) -> None:
    """Check the extent, and name a few points metres from all others, also in no face of a mesh."""
    mm, (low, high) = MM_PER_UNIT[unit], EXTENT_LIMITS_MM
    if surface.extent_mm * mm > high:
        far = np.linalg.norm(surface.points - np.median(surface.points, axis=0), axis=1) * mm > high
        if 2 * far.sum() < len(far) and low <= Surface(surface.points[~far]).extent_mm * mm <= high:
            given = f"{name} with {far.sum()} of its {len(far)} points metres from the others"
            raise InvalidPointCloudError("points of one bone", given, "take these out")
    check_extent(surface.extent_mm * mm, unit, name, how)


def _check_apart(surface: Surface, name: str) -> None:
    """Raise for one point, or several in one place: no unit makes a piece of bone of them."""
    if surface.extent_mm == 0.0:
        count = len(surface.points)
        given = f"{name} with {count} points in one place" if count > 1 else f"{name} with 1 point"
        raise InvalidPointCloudError("points on the surface of a bone", given, "acquire more of it")


def _drop_non_finite(surface: Surface, name: str) -> Surface:
    finite = is_point(surface.points)
    if not finite.any():
        raise InvalidPointCloudError(
            "points", f"{name} with {len(finite)} points, none finite", "check how it was made"
        )
    if finite.all():
        return surface
    if surface.faces is not None:
        raise InvalidPointCloudError("finite vertices", f"{(~finite).sum()} that are not in {name}", "repair the mesh")
    log.warning("%s: %d of %d points are not finite: left out", name, (~finite).sum(), len(finite))
    normals = None if surface.normals is None else surface.normals[finite]
    return replace(surface, points=surface.points[finite], normals=normals)


def _warn_of_several_bones(surface: Surface, name: str) -> None:
    """Warn of several bones: if they move apart, no rigid pose fits any of them."""
    if surface.faces is None or not len(surface.faces):
        return
    from gapr_core.geometry.long_bones import separate_long_bones

    lengths = separate_long_bones(surface.points, surface.triangles, surface.face_areas_mm2)
    if lengths:
        sizes = " and ".join(f"{length:.0f} mm" for length in sorted(lengths, reverse=True))
        log.warning(
            "%s holds %d separate long parts, of %s: they are registered as one rigid body; "
            "for one bone, save it to a file of its own, or give it a label of its own in the label map "
            "(--label, model_label)",
            name, len(lengths), sizes,
        )  # fmt: skip
