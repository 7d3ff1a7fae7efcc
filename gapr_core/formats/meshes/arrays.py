"""NPY and NPZ: the size of an array is known before it is unpacked."""

from __future__ import annotations

import io
import math
import zipfile
from pathlib import Path

import numpy as np
from numpy.lib import format as npy

from gapr_core.errors import InvalidPointCloudError
from gapr_core.formats import tracker
from gapr_core.formats.limits import FileLimits
from gapr_core.formats.options import ReadOptions
from gapr_core.geometry import pinhole
from gapr_core.surface import Surface, as_points


def read_npy(path: Path, options: ReadOptions) -> Surface:
    """Read an array (N, 3), an image (H, W, 3), or tool poses (N, 4, 4), mm.

    Raises:
        InvalidPointCloudError: poses without the tip, a tip without poses, or poses that are not rigid.
    """
    array = array_of(options.limits.read(path), options.limits)
    if array.shape[1:] == (4, 4):
        return Surface(
            tracker.touched(tracker.rigid_poses(array, path), tracker.given_tip(options.tip_mm, path)), joined=True
        )
    if options.tip_mm is not None:
        raise InvalidPointCloudError(
            f"{tracker.RECORDINGS} for --tip", f"{path.name} of shape {array.shape}", "leave it out for points"
        )
    points = as_points(array)
    return Surface(points, camera=pinhole.centre_of(points.reshape(array.shape)) if array.ndim == 3 else None)


def read_npz(path: Path, options: ReadOptions) -> Surface:
    """Read the arrays `points` (N, 3) and, if there is one, `faces` (F, 3) integers.

    Raises:
        InvalidPointCloudError: no array of that name.
        ValueError: faces that are no integers.
    """
    limits = options.limits
    data = limits.read(path)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        end = data.rfind(b"PK\5\6") + 10  # says how many arrays there are: a damaged list may skip one
        if len(archive.infolist()) != int.from_bytes(data[end : end + 2], "little"):
            raise ValueError("a list of its arrays that is damaged")
        names = {name.removesuffix(".npy"): name for name in archive.namelist()}
        if "points" not in names:
            given = f"only {', '.join(names) or 'nothing'}"
            raise InvalidPointCloudError("an array named points", given, "save it as np.savez(file, points=P)")
        wanted = [names[name] for name in ("points", "faces") if name in names]
        limits.check_unpacked(sum(entry.file_size for entry in archive.infolist()))
        if damaged := archive.testzip():  # of all: faces whose name is damaged are no faces
            raise ValueError(f"the array {damaged} in it is damaged")
        arrays = [array_of(archive.read(name), limits) for name in wanted]
    if len(arrays) == 1:
        return Surface(as_points(arrays[0]))
    if arrays[1].dtype.kind not in "iu":
        raise ValueError(f"faces of type {arrays[1].dtype}, not integers")
    return Surface(as_points(arrays[0]), arrays[1].astype(np.int64))


def array_of(data: bytes, limits: FileLimits) -> np.ndarray:
    """Read the array of an .npy file, whose length must fit its header.

    Raises:
        ValueError: a damaged header, Python objects, or another length.
    """
    file = io.BytesIO(data)
    version = npy.read_magic(file)
    read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, fortran_order, dtype = read_header(file)
    if dtype.hasobject:
        raise ValueError("Python objects in it")
    size = math.prod(shape) * dtype.itemsize
    limits.check_unpacked(size)
    if size != len(data) - file.tell() or min(shape, default=0) < 0:
        raise ValueError(f"{len(data) - file.tell()} bytes of data where the header announces {size}")
    return np.frombuffer(data, dtype, offset=file.tell()).reshape(shape, order="F" if fortran_order else "C")
