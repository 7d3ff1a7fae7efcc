"""PointCloud2 of any legal layout to (N, 3) and back, through one strided view over its bytes."""

from __future__ import annotations

import array
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from msg_adapters.errors import InvalidMessageError
from msg_adapters.inputs import Input

DTYPES: dict[int, str] = {
    PointField.INT8: "i1",
    PointField.UINT8: "u1",
    PointField.INT16: "i2",
    PointField.UINT16: "u2",
    PointField.INT32: "i4",
    PointField.UINT32: "u4",
    PointField.FLOAT32: "f4",
    PointField.FLOAT64: "f8",
}
LARGEST_STEP = 2**31 - 1  # bytes of a point; NumPy counts them in a C int
CODES = {code: kind for kind, code in DTYPES.items()}
NAMES = {getattr(PointField, name): name for name in ("INT8", "UINT8", "INT16", "UINT16", "INT32", "UINT32")}


def cloud_to_xyz(
    cloud: PointCloud2, *, dtype: DTypeLike = np.float64, keep_nan: bool = False, drop_zeros: bool = False
) -> NDArray[Any]:
    """Read x, y, z of every point, row by row, in the unit of the message.

    Args:
        cloud: any legal layout: padding, either byte order, float32 or float64 coordinates in any order among other
            fields, organised or not. Two common slips of drivers are read as meant: `row_step` 0, and `row_step` of
            the whole cloud.
        dtype: of the result.
        keep_nan: keep the points that are not finite, so that rows stay aligned with other fields.
        drop_zeros: drop points that are exactly (0, 0, 0), which depth cameras send for "nothing seen".

    Returns:
        (N, 3) new array, independent of the message.

    Raises:
        InvalidMessageError: for a layout that contradicts itself or has no float x, y, z.
    """
    if not len(cloud.data) and not cloud.width * cloud.height:
        return np.empty((0, 3), dtype=dtype)
    records = _view(cloud, _coordinate_dtype(cloud))
    xyz = np.empty((records.size, 3), dtype=dtype)
    with np.errstate(over="ignore", invalid="ignore"):  # beyond float32: becomes infinite
        for column, name in enumerate("xyz"):
            xyz[:, column].reshape(records.shape)[...] = records[name]
    keep = np.ones(len(xyz), dtype=bool)
    if not keep_nan:  # column by column: NumPy takes far longer along an axis of three
        keep &= np.logical_and.reduce([np.isfinite(column) for column in xyz.T])
    if drop_zeros:
        keep &= np.logical_or.reduce([column != 0 for column in xyz.T])
    return xyz if keep.all() else xyz[keep]


def cloud_to_grid(cloud: PointCloud2) -> NDArray[np.float64] | None:
    """Read x, y, z of every pixel of an organised cloud, in the unit of the message.

    Returns:
        (H, W, 3) new array, points that are not finite among them; None for a cloud of one row or one column.

    Raises:
        InvalidMessageError: for a layout that contradicts itself or has no float x, y, z.
    """
    if min(cloud.height, cloud.width) < 2:
        return None
    return cloud_to_xyz(cloud, keep_nan=True).reshape(cloud.height, cloud.width, 3)


def cloud_to_field(cloud: PointCloud2, name: str) -> NDArray[Any]:
    """(N,) one more field of every point, row by row, in its own dtype: `distance`, `intensity`.

    Raises:
        InvalidMessageError: for a layout that contradicts itself, or without exactly one such field.
    """
    dtype = _dtype_of(cloud, [_single_field(cloud, name)])
    if not cloud.width * cloud.height:
        return np.empty(0, dtype[name])
    return _view(cloud, dtype)[name].flatten()


def xyz_to_cloud(
    points: ArrayLike, header: Header | None = None, *, fields: Mapping[str, ArrayLike] | None = None
) -> PointCloud2:
    """Write a little-endian cloud without padding.

    Args:
        points: (N, 3), or (H, W, 3) for an organised cloud; float64 stays float64, everything else becomes float32.
        header: frame and stamp.
        fields: further fields by name, each (N,) or (H, W), in their own dtype.

    Raises:
        InvalidMessageError: for another shape, or a dtype that PointField does not have.
    """
    points = np.asarray(points)
    if points.ndim not in (2, 3) or points.shape[-1] != 3:
        raise InvalidMessageError(f"points must be (N, 3) or (H, W, 3), got {points.shape}")
    kind = "f8" if points.dtype == np.float64 else "f4"
    columns = {name: points[..., i].astype(kind) for i, name in enumerate("xyz")}
    columns |= {name: np.asarray(values) for name, values in (fields or {}).items()}
    records = _pack(columns, points.shape[:-1])
    height, width = (1, *records.shape) if records.ndim == 1 else records.shape
    step = records.dtype.itemsize
    return PointCloud2(
        header=header or Header(), height=height, width=width, fields=_describe(records.dtype), is_bigendian=False,
        point_step=step, row_step=step * width, data=array.array("B", records.tobytes()),
        is_dense=bool(np.isfinite(points).all()),
    )  # fmt: skip


def _coordinate_dtype(cloud: PointCloud2) -> np.dtype[Any]:
    fields = [_single_field(cloud, name) for name in "xyz"]
    for field in fields:
        if field.datatype not in (PointField.FLOAT32, PointField.FLOAT64):
            kind = NAMES.get(field.datatype, f"unknown ({field.datatype})")
            raise InvalidMessageError(f"field {field.name} must be FLOAT32 or FLOAT64, got {kind}")
    return _dtype_of(cloud, fields)


def _dtype_of(cloud: PointCloud2, fields: Sequence[PointField]) -> np.dtype[Any]:
    """Describe records that hold these fields alone, at their places."""
    if cloud.point_step > LARGEST_STEP:
        raise InvalidMessageError(f"point_step must be at most {LARGEST_STEP}, got {cloud.point_step}")
    unknown = next((field for field in fields if field.datatype not in DTYPES), None)
    if unknown is not None:
        raise InvalidMessageError(f"field {unknown.name} has the unknown type {unknown.datatype}")
    order = ">" if cloud.is_bigendian else "<"
    names, offsets = [field.name for field in fields], [field.offset for field in fields]
    formats = [order + DTYPES[field.datatype] for field in fields]
    for name, code, offset in zip(names, formats, offsets, strict=True):
        if offset + np.dtype(code).itemsize > cloud.point_step:
            raise InvalidMessageError(f"field {name} ends beyond point_step {cloud.point_step}")
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": cloud.point_step})


def _single_field(cloud: PointCloud2, name: str) -> PointField:
    found = [field for field in cloud.fields if field.name == name]
    if len(found) != 1:
        names = ", ".join(field.name for field in cloud.fields) or "none"
        raise InvalidMessageError(f"need exactly one field {name}, the cloud has: {names}")
    if found[0].count > 1:  # 0, the default of the message, is read as 1, as PCL does
        raise InvalidMessageError(f"field {name} must have count 1, got {found[0].count}")
    return found[0]


def _view(cloud: PointCloud2, dtype: np.dtype[Any]) -> NDArray[Any]:
    """(height, width) records over the bytes of the message, nothing copied."""
    packed = cloud.width * cloud.point_step
    row_step = _row_step(cloud, packed)
    unpadded_end = row_step * (cloud.height - 1) + packed if cloud.height else 0
    legal = {row_step * cloud.height, unpadded_end}
    if len(cloud.data) not in legal:
        raise InvalidMessageError(
            f"{cloud.height} rows of {row_step} bytes need {row_step * cloud.height} bytes of data, "
            f"got {len(cloud.data)}"
        )
    shape, strides = (cloud.height, cloud.width), (row_step, cloud.point_step)
    return np.ndarray(shape, dtype, buffer=memoryview(cloud.data), strides=strides)


def _row_step(cloud: PointCloud2, packed: int) -> int:
    whole_cloud = cloud.height > 1 and cloud.row_step == packed * cloud.height == len(cloud.data)
    if cloud.row_step == 0 or whole_cloud:
        return packed
    if cloud.row_step < packed:
        raise InvalidMessageError(
            f"row_step {cloud.row_step} is shorter than {cloud.width} points of {cloud.point_step} bytes"
        )
    return int(cloud.row_step)


def _pack(columns: Mapping[str, NDArray[Any]], shape: tuple[int, ...]) -> NDArray[Any]:
    for name, values in columns.items():
        if values.shape != shape:
            raise InvalidMessageError(f"field {name} must have shape {shape}, got {values.shape}")
        if values.dtype.str[1:] not in CODES:
            raise InvalidMessageError(f"field {name}: PointField has no type for {values.dtype}")
    records = np.empty(shape, np.dtype([(name, "<" + values.dtype.str[1:]) for name, values in columns.items()]))
    for name, values in columns.items():
        records[name] = values
    return records


def _describe(dtype: np.dtype[Any]) -> list[PointField]:
    assert dtype.fields is not None
    return [
        PointField(name=name, offset=entry[1], datatype=CODES[entry[0].str[1:]], count=1)
        for name, entry in dtype.fields.items()
    ]


INPUT = Input(
    PointCloud2, partial(cloud_to_xyz, drop_zeros=True), lambda cloud: cloud.width * cloud.height, cloud_to_grid
)
