"""From a serialised PointCloud2 to the points in mm that registration gets, or the reason why not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message
from rclpy.time import Time
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from gapr_core.clouds import EXTENT_LIMITS_MM, Surface
from gapr_ros import wire
from gapr_ros.parameters import NodeParameters
from gapr_ros.refusal import Reason, RefusedError
from msg_adapters import InvalidMessageError, cloud_to_xyz

Array = NDArray[np.float64]
BACKWARD_NS = 1_000_000_000  # a stamp this much older than the last one: time went back (a bag in a loop)
LEAST_SHARE, MOST_SHARE = 0.005, 20.0  # of the bone's extent, that a cloud of it can have in the right unit


def read_message(data: bytes) -> PointCloud2:
    """The message, or a refusal when its bytes are no PointCloud2."""
    try:
        return deserialize_message(data, PointCloud2)
    except Exception as error:  # the middleware raises several kinds
        raise RefusedError(Reason.BAD_FIELDS, f"the bytes are no whole PointCloud2 ({error})") from error


def stamp_ns(header: Header) -> int:
    """The stamp, ns."""
    return Time.from_msg(header.stamp).nanoseconds


def check_age(header: Header, now_ns: int, max_age_s: float) -> None:
    """Refuse a cloud that is too old. Off without a limit, before the clock runs and for clouds without a stamp."""
    stamp = stamp_ns(header)
    age_s = (now_ns - stamp) * 1e-9
    if max_age_s > 0.0 and now_ns > 0 and stamp > 0 and age_s > max_age_s:
        raise RefusedError(Reason.STALE, f"the cloud is {age_s:.3g} s old, max_cloud_age is {max_age_s:g} s")


def take_in(cloud: PointCloud2, model_extent_mm: float, parameters: NodeParameters) -> Array:
    """Read, convert, clean and thin a cloud: (N, 3) float64, mm, finite, in the cloud's frame.

    A cloud that is registered together with others (`accumulate`) may be of any size but empty: `check_together` looks
    at all of them.

    Raises:
        RefusedError: empty_cloud, bad_fields, non_finite, too_few_points or unit_mismatch.
    """
    points = _finite_points(cloud)
    points = _within_range(wire.to_mm(points, parameters.cloud_unit), parameters)
    check_count(len(points), 1 if parameters.accumulate > 1 else parameters.min_points)
    points = thin(points, parameters.max_points, parameters.seed)
    if parameters.accumulate == 1:
        check_unit(points, model_extent_mm, parameters.cloud_unit)
    check_spread(points, parameters.cloud_unit)
    return points


def check_together(points_mm: Array, model_extent_mm: float, parameters: NodeParameters) -> None:
    """Number and unit of all points that are registered as one.

    Raises:
        RefusedError: too_few_points or unit_mismatch.
    """
    check_count(len(points_mm), parameters.min_points)
    check_unit(points_mm, model_extent_mm, parameters.cloud_unit)


def check_count(count: int, least: int) -> None:
    """Refuse too few points."""
    if count < least:
        raise RefusedError(Reason.TOO_FEW_POINTS, f"{count} usable points, min_points is {least}")


def is_one_bone(points_mm: Array, model_extent_mm: float) -> bool:
    """False for points that lie too far apart, whatever their unit is."""
    most_mm = min(EXTENT_LIMITS_MM[1], MOST_SHARE * model_extent_mm)
    return Surface(points_mm).extent_mm <= most_mm


def check_spread(points_mm: Array, unit: str) -> None:
    """Refuse a cloud with points that are metres apart, be it a few strays: no bone is so long."""
    extent_mm = Surface(points_mm).extent_mm
    if extent_mm > EXTENT_LIMITS_MM[1]:
        size = f"{extent_mm:.3g} mm across read as {unit}, {EXTENT_LIMITS_MM[1]:g} mm are the most"
        raise RefusedError(Reason.UNIT_MISMATCH, f"points too far apart: {size}; set range_max, or cloud_unit")


def check_unit(points_mm: Array, model_extent_mm: float, unit: str) -> None:
    """Refuse a cloud whose size says that its unit is not the one named; single far points do not count."""
    extent_mm = robust_extent(points_mm)
    share = extent_mm / model_extent_mm
    if LEAST_SHARE <= share <= MOST_SHARE:
        return
    other = _looks_like(extent_mm, model_extent_mm, unit)
    size = f"{extent_mm:.3g} mm across read as {unit}, the bone is {model_extent_mm:.3g} mm"
    if other:
        raise RefusedError(Reason.UNIT_MISMATCH, f"looks like {other}: {size}; set cloud_unit")
    if share > MOST_SHARE:
        raise RefusedError(Reason.UNIT_MISMATCH, f"the cloud is far larger than the bone: {size}; set range_max")


def robust_extent(points_mm: Array) -> float:
    """Diagonal of the box that holds the middle 98 % along each axis, mm."""
    low, high = np.percentile(points_mm, [1.0, 99.0], axis=0)
    return float(np.linalg.norm(high - low))


def thin(points: Array, most: int, seed: int) -> Array:
    """At most `most` of the points, chosen at random but always alike for one seed; 0: all."""
    if most <= 0 or len(points) <= most:
        return points
    chosen = np.random.default_rng(seed).choice(len(points), most, replace=False, shuffle=False)
    return points[np.sort(chosen)]


def _finite_points(cloud: PointCloud2) -> Array:
    count = cloud.width * cloud.height
    try:
        points = cloud_to_xyz(cloud, drop_zeros=True)
    except InvalidMessageError as error:
        raise RefusedError(Reason.BAD_FIELDS, str(error)) from error
    if count == 0:
        raise RefusedError(Reason.EMPTY_CLOUD, "the cloud has no points")
    if len(points) == 0:
        raise RefusedError(Reason.NON_FINITE, f"none of {count} points is finite and off the sensor's origin")
    return points


def _within_range(points_mm: Array, parameters: NodeParameters) -> Array:
    if parameters.range_min <= 0.0 and parameters.range_max <= 0.0:
        return points_mm
    distance_m = wire.to_metres(np.linalg.norm(points_mm, axis=1))
    farthest = parameters.range_max if parameters.range_max > 0.0 else np.inf
    return points_mm[(distance_m >= parameters.range_min) & (distance_m <= farthest)]


def _looks_like(extent_mm: float, model_extent_mm: float, unit: str) -> str:
    """The other unit's name when the cloud would fit the bone in it; empty otherwise."""
    other, name = ("mm", "millimetres") if unit == "m" else ("m", "metres")
    share = extent_mm / wire.MM_PER_UNIT[unit] * wire.MM_PER_UNIT[other] / model_extent_mm
    return name if LEAST_SHARE <= share <= MOST_SHARE else ""
