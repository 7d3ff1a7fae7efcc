"""PointCloud2 of every legal layout, built byte by byte, comes back as the points that went in."""

from __future__ import annotations

import array
import struct
import time

import numpy as np
import pytest
from geometry_msgs.msg import PoseArray
from hypothesis import given, settings
from hypothesis import strategies as st
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from msg_adapters import INPUTS, InvalidMessageError, cloud_to_field, cloud_to_grid, cloud_to_xyz, xyz_to_cloud

CODES = {"b": PointField.INT8, "B": PointField.UINT8, "h": PointField.INT16, "H": PointField.UINT16,
         "i": PointField.INT32, "I": PointField.UINT32, "f": PointField.FLOAT32, "d": PointField.FLOAT64}  # fmt: skip


@st.composite
def layouts(draw):
    """A legal layout, its points, and the bytes written one number at a time with `struct`."""
    kind = draw(st.sampled_from("fd"))
    names = draw(st.permutations(["x", "y", "z", "intensity", "ring"][: draw(st.integers(3, 5))]))
    kinds = {"x": kind, "y": kind, "z": draw(st.sampled_from("fd")), "intensity": draw(st.sampled_from("fBH")),
             "ring": draw(st.sampled_from("bhiId"))}  # fmt: skip
    offset, fields = 0, []
    for name in names:
        offset += draw(st.integers(0, 5))
        fields.append((name, kinds[name], offset))
        offset += struct.calcsize(kinds[name])
    step, height, width = offset + draw(st.integers(0, 7)), draw(st.integers(1, 3)), draw(st.integers(1, 6))
    seed = draw(st.integers(0, 2**32 - 1))
    return {"fields": fields, "step": step, "height": height, "width": width, "big": draw(st.booleans()),
            "row_padding": draw(st.integers(0, 9)), "row_step": draw(st.sampled_from(["right", "zero", "whole"])),
            "padded_end": draw(st.booleans()),
            "points": np.random.default_rng(seed).normal(size=(height * width, 3))}  # fmt: skip


def build(layout) -> PointCloud2:
    order = ">" if layout["big"] else "<"
    packed = layout["step"] * layout["width"]
    row = packed + (layout["row_padding"] if layout["row_step"] == "right" else 0)
    data = bytearray(b"\xab" * (row * layout["height"]))
    for i, point in enumerate(layout["points"]):
        start = row * (i // layout["width"]) + layout["step"] * (i % layout["width"])
        for name, kind, offset in layout["fields"]:
            value = float(point["xyz".index(name)]) if name in "xyz" else 1
            struct.pack_into(order + kind, data, start + offset, value)
    if not layout["padded_end"]:
        data = data[: len(data) - (row - packed)]
    row_step = {"right": row, "zero": 0, "whole": row * layout["height"]}[layout["row_step"]]
    return PointCloud2(
        height=layout["height"], width=layout["width"], point_step=layout["step"], row_step=row_step,
        is_bigendian=layout["big"], data=array.array("B", bytes(data)),
        fields=[PointField(name=n, offset=o, datatype=CODES[k], count=1) for n, k, o in layout["fields"]],
    )  # fmt: skip


@pytest.mark.parametrize(("count", "is_read"), [(0, True), (1, True), (2, False)])
def test_a_count_of_0_the_default_of_the_message_is_one(count, is_read):
    cloud = xyz_to_cloud(np.arange(6.0).reshape(2, 3), Header(frame_id="probe"))
    for field in cloud.fields:
        field.count = count
    if is_read:
        np.testing.assert_array_equal(cloud_to_xyz(cloud), np.arange(6.0).reshape(2, 3))
    else:
        with pytest.raises(InvalidMessageError, match="field x must have count 1, got 2"):
            cloud_to_xyz(cloud)


@settings(max_examples=300, deadline=None)
@given(layouts())
def test_every_legal_layout_gives_back_its_points(layout):
    cloud = build(layout)
    before = bytes(cloud.data)
    xyz = cloud_to_xyz(cloud)
    kinds = [next(k for n, k, _ in layout["fields"] if n == name) for name in "xyz"]
    expected = np.stack(
        [layout["points"][:, i].astype({"f": np.float32, "d": np.float64}[k]) for i, k in enumerate(kinds)], axis=1
    )
    assert xyz.dtype == np.float64
    np.testing.assert_array_equal(xyz, expected)
    assert bytes(cloud.data) == before, "the message must not change"
    for name, kind, _ in layout["fields"]:
        if name not in "xyz":  # `build` writes ones
            field = cloud_to_field(cloud, name)
            assert field.dtype.kind + str(field.dtype.itemsize) == np.dtype(kind).kind + str(struct.calcsize(kind))
            np.testing.assert_array_equal(field, np.ones(len(xyz)))


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 40), st.sampled_from([np.float32, np.float64]), st.integers(0, 2**32 - 1))
def test_points_survive_the_round_trip_bit_for_bit(count, dtype, seed):
    points = np.random.default_rng(seed).normal(size=(count, 3)).astype(dtype)
    cloud = xyz_to_cloud(points, Header(frame_id="probe"), fields={"ring": np.arange(count, dtype=np.uint16)})
    np.testing.assert_array_equal(cloud_to_xyz(cloud, dtype=dtype), points)
    assert cloud.header.frame_id == "probe"
    assert (cloud.width, cloud.height, cloud.row_step) == (count, 1, cloud.point_step * count)
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "ring"]


def test_an_organised_cloud_keeps_its_shape_on_the_wire_and_its_row_order():
    points = np.arange(4 * 6 * 3, dtype=np.float32).reshape(4, 6, 3)
    cloud = xyz_to_cloud(points)
    assert (cloud.height, cloud.width, cloud.row_step) == (4, 6, 6 * 12)
    np.testing.assert_array_equal(cloud_to_xyz(cloud), points.reshape(-1, 3))


def test_an_organised_cloud_comes_back_as_the_image_it_is_and_no_other_cloud_does(image):
    np.testing.assert_array_equal(cloud_to_grid(xyz_to_cloud(image)), image)
    for shape in ((1, -1, 3), (-1, 1, 3), (-1, 3), (0, 0, 3)):
        assert cloud_to_grid(xyz_to_cloud(image[:0, :0] if shape[0] == 0 else image.reshape(shape))) is None
    assert INPUTS["PointCloud2"].grid(xyz_to_cloud(image)).shape == (60, 80, 3)
    assert INPUTS["PoseArray"].grid(PoseArray()) is None


def test_points_that_are_not_finite_are_dropped_or_kept_on_request():
    points = np.array([[0, 0, 1], [np.nan, 0, 0], [0, np.inf, 0], [1, 2, 3]], dtype=np.float32)
    cloud = xyz_to_cloud(points)
    assert not cloud.is_dense
    np.testing.assert_array_equal(cloud_to_xyz(cloud), points[[0, 3]])
    np.testing.assert_array_equal(cloud_to_xyz(cloud, keep_nan=True), points)


def test_a_cloud_that_claims_to_be_dense_is_still_checked_for_nan():
    cloud = xyz_to_cloud(np.array([[np.nan, 0, 0], [1, 2, 3]]))
    cloud.is_dense = True
    np.testing.assert_array_equal(cloud_to_xyz(cloud), [[1, 2, 3]])


def test_points_at_the_origin_are_dropped_only_on_request():
    points = np.array([[0, 0, 0], [0, 0, 1e-9], [1, 0, 0]])
    assert len(cloud_to_xyz(xyz_to_cloud(points))) == 3
    np.testing.assert_array_equal(cloud_to_xyz(xyz_to_cloud(points), drop_zeros=True), points[1:])


def test_coordinates_beyond_float32_become_infinite_and_are_dropped_without_a_warning(recwarn):
    cloud = xyz_to_cloud(np.array([[1e300, 0, 0], [1, 2, 3]]))
    assert len(cloud_to_xyz(cloud, dtype=np.float32)) == 1
    assert not recwarn.list


def test_an_empty_cloud_is_no_points_even_without_fields():
    assert cloud_to_xyz(PointCloud2()).shape == (0, 3)
    assert cloud_to_xyz(xyz_to_cloud(np.empty((0, 3)))).shape == (0, 3)


ILLEGAL = {
    "truncated data": (lambda c: setattr(c, "data", c.data[:-5]), "bytes of data"),
    "data of one more point": (lambda c: setattr(c, "data", c.data + c.data[:12]), "bytes of data"),
    "data without points": (lambda c: setattr(c, "height", 0), "bytes of data"),
    "a row shorter than its points": (lambda c: setattr(c, "row_step", 100), "row_step 100"),
    "no z": (lambda c: c.fields.pop(), "exactly one field z"),
    "two fields x": (lambda c: c.fields.append(c.fields[0]), "exactly one field x"),
    "no fields": (lambda c: c.fields.clear(), "exactly one field x, the cloud has: none"),
    "integer x": (
        lambda c: setattr(c.fields[0], "datatype", PointField.INT32),
        "must be FLOAT32 or FLOAT64, got INT32",
    ),
    "unknown type": (lambda c: setattr(c.fields[0], "datatype", 77), "unknown"),
    "an array field": (lambda c: setattr(c.fields[0], "count", 3), "count 1"),
    "a field beyond the point": (lambda c: setattr(c.fields[2], "offset", 9), "beyond point_step"),
    "point_step 0": (lambda c: setattr(c, "point_step", 0), "beyond point_step"),
    "more points than any memory": (
        lambda c: (setattr(c, "width", 2**32 - 1), setattr(c, "height", 2**32 - 1)),
        "row_step",
    ),
}


@pytest.mark.parametrize("name", ILLEGAL)
def test_an_illegal_layout_raises_the_typed_error(name):
    cloud = xyz_to_cloud(np.ones((50, 3), dtype=np.float32))
    damage, message = ILLEGAL[name]
    damage(cloud)
    with pytest.raises(InvalidMessageError, match=message):
        cloud_to_xyz(cloud)
    assert issubclass(InvalidMessageError, ValueError)


def test_a_point_of_more_bytes_than_numpy_counts_raises_the_typed_error():
    cloud = xyz_to_cloud(np.ones((1, 3)))
    cloud.point_step = cloud.row_step = 2**31
    with pytest.raises(InvalidMessageError, match="point_step must be at most 2147483647"):
        cloud_to_xyz(cloud)


@pytest.mark.parametrize("points", [np.ones(3), np.ones((4, 2)), np.ones((2, 2, 2, 3))])
def test_arrays_of_another_shape_are_not_written(points):
    with pytest.raises(InvalidMessageError, match="N, 3"):
        xyz_to_cloud(points)


def test_extra_fields_of_another_length_or_type_are_not_written():
    with pytest.raises(InvalidMessageError, match="shape"):
        xyz_to_cloud(np.ones((4, 3)), fields={"ring": np.ones(3)})
    with pytest.raises(InvalidMessageError, match="int64"):
        xyz_to_cloud(np.ones((4, 3)), fields={"ring": np.ones(4, dtype=np.int64)})


def test_a_vga_cloud_is_read_in_a_fraction_of_its_frame_time():
    cloud = xyz_to_cloud(np.ones((480, 640, 3), dtype=np.float32))
    cloud_to_xyz(cloud)
    start = time.perf_counter()
    cloud_to_xyz(cloud)
    assert time.perf_counter() - start < 0.25


def test_a_field_keeps_its_order_and_is_independent_of_the_message():
    cloud = xyz_to_cloud(np.zeros((2, 2, 3)), fields={"distance": np.array([[1.0, 2.0], [3.0, np.nan]])})
    distance = cloud_to_field(cloud, "distance")
    np.testing.assert_array_equal(distance, [1.0, 2.0, 3.0, np.nan])
    distance[:] = 0.0
    assert cloud_to_field(cloud, "distance")[2] == 3.0
    assert cloud_to_field(xyz_to_cloud(np.zeros((0, 3)), fields={"inlier": np.zeros(0, "u1")}), "inlier").shape == (0,)


def test_a_field_that_is_missing_or_of_no_known_type_is_an_error():
    cloud = xyz_to_cloud(np.zeros((2, 3)), fields={"inlier": np.zeros(2, "u1")})
    with pytest.raises(InvalidMessageError, match="exactly one field distance, the cloud has: x, y, z, inlier"):
        cloud_to_field(cloud, "distance")
    cloud.fields[3].datatype = 99
    with pytest.raises(InvalidMessageError, match="field inlier has the unknown type 99"):
        cloud_to_field(cloud, "inlier")
