"""What ITK does not check or say of a NIfTI file: its length, and the names in its extended header."""

from __future__ import annotations

import gzip
import math
import struct
from pathlib import Path
from typing import IO
from xml.etree import ElementTree

from gapr_core.errors import InvalidPointCloudError
from gapr_core.formats.limits import FileLimits

EXTENSION_BYTES = 1 << 20
CHUNK_BYTES = 1 << 24


def label_names(path: Path) -> dict[int, str]:
    """Names by number in the label table that `TotalSegmentator --ml` writes; empty where there is none."""
    with _opened(path) as file:
        head = file.read(EXTENSION_BYTES)
    start, end = head.find(b"<CaretExtension"), head.find(b"</CaretExtension>")
    if start < 0 or end < 0 or b"<!DOCTYPE" in head[start:end]:
        return {}
    labels = ElementTree.fromstring(head[start:end] + b"</CaretExtension>").iter("Label")
    return {int(label.get("Key", "0")): (label.text or "").strip() for label in labels}


def check_length(path: Path, limits: FileLimits) -> None:
    """Every voxel that the header announces is in the file; ITK fills up what is missing in silence.

    Raises:
        InvalidPointCloudError: more than the limit, or NIfTI-2.
        ValueError: a file that is cut.
    """
    with _opened(path) as file:
        head = file.read(348)
        if len(head) < 348:
            raise ValueError(f"{len(head)} bytes, less than a header")
        expected = _announced(head)
        limits.check_unpacked(expected)
        given = len(head)
        while given < expected and (chunk := file.read(CHUNK_BYTES)):
            given += len(chunk)
    if given < expected:
        raise ValueError(f"{given} bytes where its header announces {expected}")


def _announced(head: bytes) -> int:
    """Bytes up to the end of the voxels, by a header of NIfTI-1."""
    sizes = {order: struct.unpack(order + "i", head[:4])[0] for order in "<>"}
    if 540 in sizes.values():
        raise InvalidPointCloudError("NIfTI-1", "NIfTI-2, which ITK does not read", "save it as NIfTI-1, NRRD or MHA")
    order = next((o for o, size in sizes.items() if size == 348), None)
    if order is None:
        raise ValueError("no NIfTI header")
    bits, start = struct.unpack_from(order + "h", head, 72), struct.unpack_from(order + "f", head, 108)
    size = struct.unpack_from(order + "8h", head, 40)
    if not 1 <= size[0] <= 7 or min(size[1 : 1 + size[0]]) < 1:
        raise ValueError(f"a grid of {size[0]} dimensions with a size below one")
    return int(start[0]) + math.prod(size[1 : 1 + size[0]]) * bits[0] // 8


def _opened(path: Path) -> IO[bytes]:
    return gzip.open(path) if path.name.lower().endswith(".gz") else path.open("rb")  # type: ignore[return-value]
