"""Checks of NIfTI files beyond ITK's: its length, both its places, and the names in its extended header."""

from __future__ import annotations

import gzip
import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import IO
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from gapr_core.errors import InvalidPointCloudError
from gapr_core.formats.limits import FileLimits
from gapr_core.formats.volumes import whole

EXTENSION_BYTES = 1 << 20
HEADER_BYTES = 348
IN_ONE_FILE = b"n+1\0"  # ends the header; with another end ITK looks for an .img
MM_PER_UNIT = {1: 1000.0, 2: 1.0, 3: 0.001}  # of xyzt_units: m, mm, um

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Geometry:
    """Where a header of NIfTI-1 places the voxels: RAS, mm.

    Attributes:
        corners: (8, 4) of the grid: i, j, k, 1; the first is 0 0 0, the last the one across.
        pixdim: (3,) size of a voxel.
        qfac: -1 where the third axis of the qform is turned round, else 1.
        quaternion: (3,) b c d of the qform; None where its code is 0.
        qoffset: (3,) origin of the qform.
        sform: (3, 4) affine; None where its code is 0.
    """

    corners: Array
    pixdim: Array
    qfac: float
    quaternion: Array | None
    qoffset: Array
    sform: Array | None


def label_names(path: Path) -> dict[int, str]:
    """Names by number in the label table that `TotalSegmentator --ml` writes; empty where there is none."""
    with _opened(path) as file:
        head = file.read(EXTENSION_BYTES)
    start, end = head.find(b"<CaretExtension"), head.find(b"</CaretExtension>")
    if start < 0 or end < 0 or b"<!DOCTYPE" in head[start:end]:
        return {}
    labels = ElementTree.fromstring(head[start:end] + b"</CaretExtension>").iter("Label")
    return {int(label.get("Key", "0")): (label.text or "").strip() for label in labels}


def geometry(path: Path) -> Geometry:
    """Both places in a header.

    Raises:
        InvalidPointCloudError: NIfTI-2.
        ValueError: no header of NIfTI-1.
    """
    with _opened(path) as file:
        head = file.read(HEADER_BYTES)
    order = _order(head)
    size = np.maximum(struct.unpack_from(order + "3h", head, 42), 1)
    qfac, *pixdim = struct.unpack_from(order + "4f", head, 76)
    q_code, s_code, *numbers = struct.unpack_from(order + "2h18f", head, 252)
    mm = MM_PER_UNIT.get(head[123] & 7, 1.0)
    corners = np.array([[*corner, 1.0] for corner in np.ndindex(2, 2, 2)]) * [*(size - 1), 1.0]
    return Geometry(
        corners, np.abs(pixdim) * mm, -1.0 if qfac < 0.0 else 1.0, np.array(numbers[:3]) if q_code > 0 else None,
        np.array(numbers[3:6]) * mm, np.array(numbers[6:]).reshape(3, 4) * mm if s_code > 0 else None,
    )  # fmt: skip


def check_length(path: Path, limits: FileLimits) -> None:
    """Check that all announced voxels are in the file and no others, undamaged by any checksum.

    Raises:
        InvalidPointCloudError: more than the limit, NIfTI-2, or voxels in another file.
        ValueError: a file that is damaged, cut or longer.
    """
    with _opened(path) as file:
        head = file.read(HEADER_BYTES)
    expected = _announced(head)
    limits.check_unpacked(expected)
    is_packed = path.name.lower().endswith(".gz")
    whole.check_length(whole.gzip_bytes(path) if is_packed else path.stat().st_size, expected)
    if head[-4:] != IN_ONE_FILE:
        raise InvalidPointCloudError(whole.ONE_FILE[0], "a header of another file", "save it as one .nii or .nii.gz")


def _order(head: bytes) -> str:
    """Return the byte order of a NIfTI-1 header."""
    if len(head) < HEADER_BYTES:
        raise ValueError(f"{len(head)} bytes, less than a header")
    sizes = {order: struct.unpack(order + "i", head[:4])[0] for order in "<>"}
    if 540 in sizes.values():
        raise InvalidPointCloudError("NIfTI-1", "NIfTI-2, which ITK does not read", "save it as NIfTI-1, NRRD or MHA")
    order = next((o for o, size in sizes.items() if size == HEADER_BYTES), None)
    if order is None:
        raise ValueError("no NIfTI header")
    return order


def _announced(head: bytes) -> int:
    """Bytes up to the end of the voxels, by a header of NIfTI-1."""
    order = _order(head)
    bits, start = struct.unpack_from(order + "h", head, 72), struct.unpack_from(order + "f", head, 108)
    size = struct.unpack_from(order + "8h", head, 40)
    if not 1 <= size[0] <= 7 or min(size[1 : 1 + size[0]]) < 1:
        raise ValueError(f"a grid of {size[0]} dimensions with a size below one")
    return int(start[0]) + math.prod(size[1 : 1 + size[0]]) * bits[0] // 8


def _opened(path: Path) -> IO[bytes]:
    return gzip.open(path) if path.name.lower().endswith(".gz") else path.open("rb")  # type: ignore[return-value]
