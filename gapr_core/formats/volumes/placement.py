"""Whether a header says where its voxels lie: missing or contradictory entries are refused, never guessed.

ITK fills in the origin and axes that a header lacks, ignores the unit of NRRD and takes one of two places of NIfTI.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gapr_core.errors import InvalidPointCloudError
from gapr_core.formats.volumes import nifti, whole

Array = NDArray[np.float64]

FARTHEST_MM = 0.01  # between the two places of a voxel in a NIfTI file, as well as what rounding explains
STRETCHED_MM = 0.1  # by how much an image may be longer by the sform than by pixdim, whose numbers are often rounded
SQUARE_ROUNDING = 3.0 * np.finfo(np.float32).eps  # of 1 - b^2 - c^2 - d^2
MHA = {  # all spellings that ITK reads
    "TransformMatrix": ("TransformMatrix", "Rotation", "Orientation"),
    "Offset": ("Offset", "Position", "Origin"),
    "ElementSpacing": ("ElementSpacing", "ElementSize"),
}
VECTOR = re.compile(r"\([-+.,\deE\s]*\d[-+.,\deE\s]*\)")  # of numbers: neither nan nor none
MILLIMETRES = re.compile(r"mm|millimet(er|re)s?|", re.IGNORECASE)  # or no word at all


def check(path: Path) -> None:
    """Let a header pass that says, once, where its voxels lie in mm.

    Raises:
        InvalidPointCloudError: no origin, axes or spacing; two places; another unit than mm.
    """
    name = path.name.lower()
    if name.endswith((".nii", ".nii.gz")):
        _check_nifti(nifti.geometry(path))
    elif name.endswith(".nrrd"):
        _check_nrrd(whole.header(path)[0])
    elif name.endswith(".mha"):
        _check_mha(whole.header(path)[0])


def _check_nifti(geometry: nifti.Geometry) -> None:
    """Check for one placement: ITK takes the qform or the sform, and voxel sizes from pixdim."""
    sform, corners = geometry.sform, geometry.corners
    if sform is None:  # then pixdim is the size of the voxels
        return
    columns = np.linalg.norm(sform[:, :3], axis=0)
    if not (np.abs(columns - geometry.pixdim) * np.ptp(corners[:, :3], axis=0) <= STRETCHED_MM).all():
        given = f"{_numbers(columns)} in the sform and {_numbers(geometry.pixdim)} in pixdim"
        raise InvalidPointCloudError("one size of the voxels", given, "write it again with nibabel or 3D Slicer")
    if geometry.quaternion is not None:
        _check_qform(geometry, sform)


def _check_qform(geometry: nifti.Geometry, sform: Array) -> None:
    corners = geometry.corners
    qform, rounding = _qform(geometry)
    apart = np.linalg.norm(corners @ (qform - sform).T, axis=1)
    from_first = np.linalg.norm((corners - corners[0]) @ sform.T, axis=1)
    if not (apart <= FARTHEST_MM + rounding * from_first).all():
        given = f"places up to {apart.max():.3g} mm apart"
        how = "see in 3D Slicer which is right, and write it as both: set_qform and set_sform of nibabel"
        raise InvalidPointCloudError("qform and sform that agree", given, how)


def _qform(geometry: nifti.Geometry) -> tuple[Array, float]:
    """(3, 4) of the quaternion, and the angle in rad that its rounding may hide: much where its scalar is near 0."""
    assert geometry.quaternion is not None
    b, c, d = geometry.quaternion
    square = 1.0 - (b * b + c * c + d * d)
    least, a, most = (np.sqrt(max(square + off, 0.0)) for off in (-SQUARE_ROUNDING, 0.0, SQUARE_ROUNDING))
    rotation = np.array([
        [a * a + b * b - c * c - d * d, 2.0 * (b * c - a * d), 2.0 * (b * d + a * c)],
        [2.0 * (b * c + a * d), a * a + c * c - b * b - d * d, 2.0 * (c * d - a * b)],
        [2.0 * (b * d - a * c), 2.0 * (c * d + a * b), a * a + d * d - b * b - c * c],
    ])  # fmt: skip
    columns = rotation * geometry.pixdim * [1.0, 1.0, geometry.qfac]
    return np.column_stack([columns, geometry.qoffset]), 2.0 * (most - least)


def _check_nrrd(fields: dict[str, str]) -> None:
    names = ("space directions", "space origin")
    _check_there(names, [name for name in names if VECTOR.search(fields.get(name.replace(" ", ""), ""))])
    units = re.findall(r'"([^"]*)"', fields.get("spaceunits", ""))
    if other := next((unit for unit in units if not MILLIMETRES.fullmatch(unit.strip())), None):
        raise InvalidPointCloudError("space units of mm", other[:20], "export it in mm, as 3D Slicer does")


def _check_mha(fields: dict[str, str]) -> None:
    _check_there(MHA, [name for name, words in MHA.items() if any(fields.get(word) for word in words)])
    unit = fields.get("DistanceUnits", "")
    if not MILLIMETRES.fullmatch(unit.strip(" ?")):  # ITK reads all numbers as mm, whatever stands here
        raise InvalidPointCloudError("DistanceUnits of mm", unit, "write it again in mm")


def _check_there(names: Iterable[str], found: list[str]) -> None:
    if missing := [name for name in names if name not in found]:
        expected = f"{', '.join(names)} in the header"
        raise InvalidPointCloudError(expected, f"no {' and no '.join(missing)}", "export it with its affine")


def _numbers(values: Array) -> str:
    return " ".join(f"{value:.4g}" for value in values)
