"""Whether all voxels that a header announces are in its own file, undamaged: ITK prints an error and goes on."""

from __future__ import annotations

import gzip
import re
import zlib
from pathlib import Path
from typing import IO

from gapr_core.errors import InvalidPointCloudError

HEADER_BYTES = 64 << 20
CHUNK_BYTES = 1 << 22
ZLIB, GZIP = 15, 31  # window bits of `zlib`
MHA_END = re.compile(rb"^[ \t]*ElementDataFile[ \t]*=[ \t]*LOCAL[ \t]*\r?\n", re.MULTILINE | re.IGNORECASE)
MHA_FILE = b"elementdatafile"
MHA_SIZES = ("NDims", "DimSize", "ElementType")
NRRD_END = re.compile(rb"\r?\n\r?\n")
NRRD_FILE = re.compile(rb"^[ \t]*data[ _\t]*file[ \t]*:", re.MULTILINE | re.IGNORECASE)
NRRD_SKIPS = ("lineskip", "byteskip")
NRRD_ENCODINGS: dict[str, int | str] = {"raw": "raw", "gzip": GZIP, "gz": GZIP, "hex": "hex"}
NRRD_ENCODINGS |= dict.fromkeys(("txt", "text", "ascii"), "text")
ONE_FILE = ("a header and its voxels in one file", "save it as one file: .mha or .nrrd")


def header(path: Path) -> tuple[dict[str, str], int]:
    """Fields of an MHA or NRRD header, and where its voxels begin; names of NRRD in small letters without spaces.

    Raises:
        InvalidPointCloudError: the voxels are in another file.
        ValueError: no end of the header, or no size.
    """
    is_mha = path.name.lower().endswith(".mha")
    with path.open("rb") as file:
        data = file.read(HEADER_BYTES)
    end = (MHA_END if is_mha else NRRD_END).search(data)
    head = data[: end.end()] if end else data
    if (head.lower().count(MHA_FILE) > 1 or not end) if is_mha else NRRD_FILE.search(head):
        if is_mha and MHA_FILE not in head.lower():
            raise ValueError("no ElementDataFile at the end of its header: the file is cut")
        raise InvalidPointCloudError(ONE_FILE[0], "a header that names another file", ONE_FILE[1])
    if not end or b"\r" in head.replace(b"\r\n", b"\n"):
        raise ValueError("no empty line after its header: the file is cut, or has the line ends of another system")
    fields: dict[str, str] = {}
    for line in head.decode("utf-8", "replace").splitlines():
        name, _, value = line.partition("=" if is_mha else ":")
        fields.setdefault(name.strip() if is_mha else name.lower().replace(" ", ""), value.strip())
    if is_mha and (missing := [name for name in MHA_SIZES if not fields.get(name)]):
        raise ValueError(f"no {' '.join(missing)} in its header")
    return fields, len(head)


def check_voxels(path: Path, count: int, size_bytes: int) -> None:
    """Let a file pass whose voxels, packed or not, are exactly those of its header, with the right checksum.

    Args:
        path: .mha or .nrrd.
        count: numbers that the header announces, channels included.
        size_bytes: of each.

    Raises:
        InvalidPointCloudError: a packing that is not read, or voxels elsewhere in the file.
        ValueError: a file that is damaged, cut or longer.
    """
    fields, start = header(path)
    encoding = _mha_encoding(fields) if path.name.lower().endswith(".mha") else _nrrd_encoding(fields)
    with path.open("rb") as file:
        file.seek(start)
        if encoding in (ZLIB, GZIP):
            given = unpacked_bytes(file, encoding)
        elif encoding == "raw":
            given = path.stat().st_size - start
        elif encoding == "hex":
            given = len(b"".join(file.read().split())) // 2
        else:
            given = len(file.read().split()) * size_bytes
    check_length(given, count * size_bytes)
    if encoding == ZLIB:  # ITK takes the length of the stream from the header, and makes noise of it if that is wrong
        check_packed_length(fields.get("CompressedDataSize"), path.stat().st_size - start)


def check_packed_length(announced: str | None, given: int) -> None:
    """Raise `ValueError` unless the header announces as many compressed bytes as there are."""
    if announced is None:
        raise ValueError("no CompressedDataSize in its header")
    if announced != str(given):
        raise ValueError(f"{given} compressed bytes where its header announces {announced}")


def check_length(given: int, announced: int) -> None:
    """Raise `ValueError` for more or fewer bytes of voxels than the header announces."""
    if given != announced:
        raise ValueError(f"{given} bytes of voxels where its header announces {announced}")


def unpacked_bytes(file: IO[bytes], window_bits: int) -> int:
    """Count the unpacked bytes of a zlib or gzip stream, up to the end of the file.

    Raises:
        ValueError: another checksum, no end of the stream, or data behind it.
    """
    stream, count = zlib.decompressobj(window_bits), 0
    try:
        while not stream.eof and (chunk := stream.unconsumed_tail or file.read(CHUNK_BYTES)):
            count += len(stream.decompress(chunk, CHUNK_BYTES))
        count += len(stream.flush())
    except zlib.error as error:
        raise ValueError(f"its compressed data are damaged: {str(error).rpartition(': ')[2]}") from error
    if not stream.eof:
        raise ValueError(f"its compressed data end too early, after {count} bytes")
    if stream.unused_data or file.read(1):
        raise ValueError("data behind the end of its compressed data")
    return count


def gzip_bytes(path: Path) -> int:
    """Count the unpacked bytes of a .gz file, of one stream or of several.

    Raises:
        ValueError: another checksum, no end of a stream, or data behind it.
    """
    count = 0
    try:
        with gzip.open(path) as file:
            while chunk := file.read(CHUNK_BYTES):
                count += len(chunk)
    except (OSError, EOFError, zlib.error) as error:
        raise ValueError(f"its compressed data are damaged after {count} bytes: {error}") from error
    return count


def _mha_encoding(fields: dict[str, str]) -> int | str:
    if fields.get("HeaderSize", "0") not in ("0", "-1"):
        raise InvalidPointCloudError("voxels right after the header", f"HeaderSize {fields['HeaderSize']}", ONE_FILE[1])
    if fields.get("CompressedData", "False")[:1] in "Tt1":
        return ZLIB
    return "text" if fields.get("BinaryData", "True")[:1] in "Ff0" else "raw"


def _nrrd_encoding(fields: dict[str, str]) -> int | str:
    if skips := [f"{name} {fields[name]}" for name in NRRD_SKIPS if fields.get(name, "0") != "0"]:
        raise InvalidPointCloudError("voxels right after the header", skips[0], "save it again with 3D Slicer")
    encoding = fields.get("encoding", "").lower()
    if encoding not in NRRD_ENCODINGS:
        how = "save it with gzip or without compression"
        raise InvalidPointCloudError("an NRRD encoding of raw, gzip, hex or text", encoding[:20] or "none", how)
    return NRRD_ENCODINGS[encoding]
