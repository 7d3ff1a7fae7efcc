"""PCD: text, binary and compressed (PCL's file format, version .7)."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from gapr_core.formats import text
from gapr_core.formats.options import ReadOptions
from gapr_core.geometry import pinhole
from gapr_core.surface import Array, Surface

TYPES = {"F": {4: "<f4", 8: "<f8"}, "I": {n: f"<i{n}" for n in (1, 2, 4, 8)}, "U": {n: f"<u{n}" for n in (1, 2, 4, 8)}}
log = logging.getLogger(__name__)

IDENTITY = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]  # VIEWPOINT: translation, then the quaternion with its scalar first
KEYS = ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT", "POINTS", "DATA")


def read(path: Path, options: ReadOptions) -> Surface:
    """Read a cloud, its normals if all three components are there, and an image's camera."""
    limits = options.limits
    data = limits.read(path)
    header, start = _header(data)
    count, fields = _integer(header, "POINTS"), _fields(header)
    limits.check_counts(count)
    limits.check_unpacked(count * fields.itemsize)
    columns = _columns(data[start:], header["DATA"][0], fields, count)
    normals = ("normal_x", "normal_y", "normal_z")
    points = _stack(columns, ("x", "y", "z"))
    camera = pinhole.centre_of(points.reshape(_integer(header, "HEIGHT"), -1, 3)) if count else None
    if not _is_identity(header.get("VIEWPOINT", [])):
        log.warning("%s: VIEWPOINT is not applied: the pose is of the numbers in the file", path.name)
    return Surface(points, None, _stack(columns, normals) if set(normals) <= set(columns) else None, camera)


def _header(data: bytes) -> tuple[dict[str, list[str]], int]:
    """Words after each key, and where the data begin."""
    header, at = {}, 0
    while "DATA" not in header:
        end = data.find(b"\n", at)
        if end < 0:
            raise ValueError("no DATA line in its header")
        words = data[at:end].decode("ascii", "replace").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            header[words[0].upper()] = words[1:]
    if missing := [key for key in KEYS if not header.get(key)]:
        raise ValueError(f"no {' '.join(missing)} in its header")
    width, height, points = (_integer(header, key) for key in ("WIDTH", "HEIGHT", "POINTS"))
    if width * height != points:
        raise ValueError(f"{width} x {height} points where {points} are announced")
    return header, at


def _integer(header: dict[str, list[str]], key: str) -> int:
    """Return the number after a key."""
    word = header[key][0]
    if not word.isdecimal():
        raise ValueError(f"{key} {word[:20]!r} in its header, which is no whole number from 0")
    return int(word)


def _is_identity(viewpoint: list[str]) -> bool:
    """Tell whether the words after VIEWPOINT, if any, move nothing."""
    try:
        return not viewpoint or [float(word) for word in viewpoint] == IDENTITY
    except ValueError:
        return False


def _fields(header: dict[str, list[str]]) -> np.dtype:
    """Return the layout of one point; a repeated name (padding) is kept once."""
    names, sizes, kinds = header["FIELDS"], header["SIZE"], [kind.upper() for kind in header["TYPE"]]
    counts = header.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(kinds) == len(counts):
        raise ValueError("FIELDS, SIZE, TYPE and COUNT of different lengths")
    parts = []
    for i, (name, size, kind, count) in enumerate(zip(names, sizes, kinds, counts, strict=True)):
        is_known = size.isdecimal() and int(size) in TYPES.get(kind, {})
        if not is_known or not count.isdecimal() or not 1 <= int(count) <= 1 << 16:
            raise ValueError(f"a field {name[:20]} of type {kind[:5]}{size[:5]} and count {count[:9]}")
        parts.append((f"{i} {name}", TYPES[kind][int(size)], (int(count),)))
    return np.dtype(parts)


def _columns(body: bytes, how: str, fields: np.dtype, count: int) -> dict[str, Array]:
    """Values of each field by its name, in the order of the file."""
    if how == "ascii":
        return _from_text(body, fields, count)
    if how == "binary":
        _check_length(len(body), count * fields.itemsize)
        points = np.frombuffer(body, fields)
        return {name.split(" ", 1)[1]: points[name] for name in fields.names or ()}
    if how == "binary_compressed":
        return _from_planes(_unpacked(body, count * fields.itemsize), fields, count)
    raise ValueError(f"DATA {how[:20]}")


def _from_text(body: bytes, fields: np.dtype, count: int) -> dict[str, Array]:
    widths = [fields[name].shape[0] for name in fields.names or ()]
    values = text.table(text.lines(body), sum(widths))
    if len(values) != count:
        raise ValueError(f"{len(values)} points where the header announces {count}")
    starts = np.cumsum([0, *widths])
    names = [name.split(" ", 1)[1] for name in fields.names or ()]
    return {name: values[:, a:b] for name, a, b in zip(names, starts, starts[1:], strict=False)}


def _unpacked(body: bytes, size: int) -> bytes:
    from gapr_core.formats.lzf import decompress

    packed, unpacked = (int.from_bytes(body[i : i + 4], "little") for i in (0, 4))
    _check_length(len(body) - 8, packed)
    _check_length(unpacked, size)
    return decompress(body[8:], size)


def _from_planes(body: bytes, fields: np.dtype, count: int) -> dict[str, Array]:
    """Compressed files hold one field after the other."""
    columns, at = {}, 0
    for name in fields.names or ():
        base, shape = fields[name].subdtype or (fields[name], (1,))
        size = count * fields[name].itemsize
        columns[name.split(" ", 1)[1]] = np.frombuffer(body[at : at + size], base).reshape(count, *shape)
        at += size
    return columns


def _check_length(given: int, expected: int) -> None:
    if given != expected:
        raise ValueError(f"{given} bytes of points where the header announces {expected}")


def _stack(columns: dict[str, Array], names: tuple[str, ...]) -> Array:
    if missing := [name for name in names if name not in columns]:
        raise ValueError(f"no field {' '.join(missing)}")
    return np.hstack([columns[name][:, :1] for name in names]).astype(np.float64)
