"""Kinds of files by their first bytes, for misleading names."""

from __future__ import annotations

import gzip
from pathlib import Path

from gapr_core.errors import InvalidPointCloudError
from gapr_core.formats import text

GZIP = b"\x1f\x8b"
PACKED = ".nii.gz"  # the one packed kind that is read
NIFTI_BYTES = 348
NIFTI_SIZES = (NIFTI_BYTES.to_bytes(4, "little"), NIFTI_BYTES.to_bytes(4, "big"))  # its first number
STL_HEADER_BYTES, STL_FACET_BYTES = 84, 50
SEQUENCE, SEQUENCE_BYTES = b"\nSeq_Frame", 8192  # after the fields of an image
SEQUENCE_HINTS = {".mha": "rename it to .igs.mha", ".nrrd": "save it as .igs.mha in PLUS"}
DICOM, DICOM_AT = b"DICM", 128
SIGNATURES = {
    b"ply": ".ply",
    b"solid": ".stl",
    b"# .PCD": ".pcd",
    b"# vtk DataFile": ".vtk",
    b"<VTKFile": ".vtp",
    b"\x93NUMPY": ".npy",
    b"PK\x03\x04": ".npz",
    b"NRRD": ".nrrd",
    b"ObjectType": ".mha",
}


def check_packed(path: Path, ending: str) -> None:
    """Raise for a file that is gzip-compressed where its ending says that it is not, or the other way round.

    Args:
        path: a file that is there.
        ending: its longest known one.

    Raises:
        InvalidPointCloudError: the file to unpack or to rename.
    """
    head = _head(path)
    is_packed = head.startswith(GZIP)
    if ending == PACKED and head.startswith(NIFTI_SIZES):
        raise InvalidPointCloudError("gzip-compressed NIfTI", f"{path.name}, which is plain NIfTI", "rename it to .nii")
    if not is_packed or ending == PACKED:
        return
    given = f"{path.name}, which is gzip-compressed"
    if _unpacks_to_nifti(path):
        raise InvalidPointCloudError("a file that is not packed", given, f"it is NIfTI: rename it to {PACKED}")
    how = "unpack it first (gunzip), or save it without compression"
    raise InvalidPointCloudError("a file that is not packed", given, how)


def check_sequence(path: Path, ending: str) -> None:
    """Raise for a recording by PLUS under the ending of a label map.

    Raises:
        InvalidPointCloudError: its new name.
    """
    if ending in SEQUENCE_HINTS and SEQUENCE in _head(path, SEQUENCE_BYTES):
        given, how = f"{path.name}, a recording by PLUS", f"{SEQUENCE_HINTS[ending]}, and give --tip"
        raise InvalidPointCloudError(f"a label map as {ending}", given, how)


def hint_of_markups(path: Path) -> str:
    """Explain how to rename control points in a plain .json; empty for other files."""
    is_markups = path.suffix.lower() == ".json" and b'"markups"' in _head(path, SEQUENCE_BYTES)
    return f"it looks like markups of 3D Slicer: rename it to {path.stem}.mrk.json" if is_markups else ""


def is_dicom(path: Path) -> bool:
    """Tell whether a file is DICOM, by its ending or its content."""
    return path.is_file() and (path.suffix.lower() == ".dcm" or _head(path, DICOM_AT + 4)[DICOM_AT:] == DICOM)


def dicom_images(given: str) -> InvalidPointCloudError:
    """Build the error for images in place of a surface."""
    how = "DICOM images hold no surface: segment the bone (3D Slicer) and give its .seg.nrrd, or a DICOM SEG as .dcm"
    return InvalidPointCloudError("the surface of a bone", given, how)


def _unpacks_to_nifti(path: Path) -> bool:
    try:
        with gzip.open(path) as file:
            return file.read(len(NIFTI_SIZES[0])).startswith(NIFTI_SIZES)
    except (OSError, EOFError):
        return False


def _head(path: Path, size: int = STL_HEADER_BYTES) -> bytes:
    """Read the first bytes; none of an unreadable file."""
    try:
        with path.open("rb") as file:
            return file.read(size)
    except OSError:
        return b""


def is_utf_16(path: Path) -> bool:
    """Tell whether an unreadable file is text in UTF-16."""
    return text.is_utf_16(_head(path))


def ending_of(path: Path) -> str:
    """Return the ending that fits the content; empty if unknown or unreadable."""
    head = _head(path)
    facets = int.from_bytes(head[80:84], "little")
    if facets and path.stat().st_size == STL_HEADER_BYTES + STL_FACET_BYTES * facets:
        return ".stl"
    return next((ending for beginning, ending in SIGNATURES.items() if head.startswith(beginning)), "")
