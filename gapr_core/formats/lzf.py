"""LZF, the compression of PCD files (Marc Lehmann's liblzf), with every index checked."""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numba
import numpy as np


def decompress(packed: bytes, size: int) -> bytes:
    """Unpack LZF data to `size` bytes.

    Raises:
        ValueError: damaged data, or data of another size.
    """
    unpacked = np.zeros(size, dtype=np.uint8)
    if _unpack(np.frombuffer(packed, np.uint8), unpacked) != size:
        raise ValueError("damaged compressed data")
    return unpacked.tobytes()


@numba.njit(cache=True, nogil=True)
def _unpack(packed, out):  # type: ignore[no-untyped-def]
    """Number of bytes written, -1 for damaged data."""
    i, o = 0, 0
    while i < len(packed):
        control = np.int64(packed[i])
        i += 1
        if control < 32:  # so many literal bytes, and one
            length = control + 1
            if i + length > len(packed) or o + length > len(out):
                return -1
            out[o : o + length] = packed[i : i + length]
            i, o = i + length, o + length
            continue
        length = (control >> 5) + 2
        if i + (length == 9) >= len(packed):
            return -1
        if length == 9:
            length += np.int64(packed[i])
            i += 1
        start = o - ((control & 31) << 8) - np.int64(packed[i]) - 1
        i += 1
        if start < 0 or o + length > len(out):
            return -1
        for k in range(length):  # byte by byte: the copy may overlap itself
            out[o + k] = out[start + k]
        o += length
    return o
