"""From a serialised cloud to the points in mm that registration gets, or the reason why not."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message
from std_msgs.msg import Header

from gapr_core.clouds import EXTENT_LIMITS_MM, PLAUSIBLE, finite_points
from gapr_core.geometry import pinhole
from gapr_core.surface import Surface
from gapr_ros.node import units
from gapr_ros.node.refusal import Reason, RefusedError
from gapr_ros.node.region import Crop
from gapr_ros.parameters import NodeParameters
from msg_adapters import INPUTS, InvalidMessageError

Array = NDArray[np.float64]
UNIT_NAMES = {"m": "metres", "cm": "centimetres", "mm": "millimetres"}
MOST_OF_ANY_MM = 1e8
LEAST_SHARE, MOST_SHARE = 0.005, 20.0  # of the bone's extent, that a cloud of it can have in the right unit


def read_message(data: bytes, cloud_type: str) -> Any:
    """The message of the type that `msg_adapters.INPUTS` names, or a refusal when its bytes are none."""
    try:
        return deserialize_message(data, INPUTS[cloud_type].message)
    except Exception as error:  # the middleware raises several kinds
        raise RefusedError(Reason.BAD_FIELDS, f"the bytes are no whole {cloud_type} ({error})") from error


def read_header(data: bytes) -> Header | None:
    """The header alone, which every input begins with: microseconds, however large the cloud is.

    None when the bytes are no message; `read_message` says why.
    """
    try:
        return deserialize_message(data, Header)
    except Exception:  # the middleware raises several kinds
        return None


def plain_frame(frame_id: str) -> str:
    """A frame's name as tf2 knows it: without the leading slash of ROS 1."""
    return frame_id.lstrip("/")


def check_frame(frame: str, model_frame: str) -> None:
    """Refuse a cloud in no frame at all, and one in that of the bone.

    Raises:
        RefusedError: bad_frame.
    """
    if not frame:
        raise RefusedError(Reason.BAD_FRAME, "the cloud has no frame_id: a pose in no frame means nothing")
    if frame == model_frame:
        text = f"the cloud is in '{frame}', which is the bone's own frame: set model_frame, or the driver's frame_id"
        raise RefusedError(Reason.BAD_FRAME, text)


def take_in(cloud: Any, model_extent_mm: float, parameters: NodeParameters, crops: Sequence[Crop] = ()) -> Array:
    """Read, convert, clean, crop and thin a cloud: (N, 3) float64, mm, finite, in the cloud's frame.

    A cloud that is registered together with others (`accumulate`) may be of any size but empty: `check_together` looks
    at all of them.

    Raises:
        RefusedError: empty_cloud, bad_fields, non_finite, too_few_points or unit_mismatch.
    """
    whole = units.to_mm(_finite_points(cloud, parameters.cloud_type), parameters.cloud_unit)
    points = in_range = _within_range(whole, parameters)
    check_bytes(in_range)
    for crop in crops:
        points = crop(points)
    left_out = _left_out(len(whole), len(in_range), len(points))
    check_count(len(points), 1 if parameters.collects else parameters.min_points, left_out)
    points = thin(points, parameters.max_points, parameters.seed)
    if not parameters.collects:
        check_unit(points, model_extent_mm, parameters.cloud_unit)
    check_spread(points, model_extent_mm, parameters.cloud_unit)
    return points


def seen_from(cloud: Any, parameters: NodeParameters) -> Array | None:
    """(3,) mm, the cloud's frame: where the camera was that saw a single cloud, where `viewpoint` is auto.

    Organised clouds show it in any frame, others in that of their camera (`geometry.pinhole`); None where neither does.
    """
    if parameters.viewpoint != "auto" or parameters.collects:
        return None
    kind = INPUTS[parameters.cloud_type]
    grid = kind.grid(cloud)
    centre = pinhole.camera_of(kind.points(cloud) if grid is None else grid)
    return None if centre is None else units.to_mm(centre, parameters.cloud_unit)


def check_together(points_mm: Array, model_extent_mm: float, parameters: NodeParameters) -> None:
    """Number and unit of all points that are registered as one.

    Raises:
        RefusedError: too_few_points or unit_mismatch.
    """
    check_count(len(points_mm), parameters.min_points)
    check_unit(points_mm, model_extent_mm, parameters.cloud_unit)


def check_count(count: int, least: int, left_out: str = "") -> None:
    """Refuse too few points; a cloud that is registered with others needs one, whatever min_points is."""
    if count < least:
        limit = f", min_points is {least}" if least > 1 else ""
        raise RefusedError(Reason.TOO_FEW_POINTS, f"{count} usable points{limit}{left_out}")


def _left_out(whole: int, in_range: int, kept: int) -> str:
    """What the region of interest took away from a cloud, by the parameters that did; empty where it took nothing."""
    by = {"range_min and range_max": whole - in_range, "the crop (crop_min, crop_max, crop_to_track)": in_range - kept}
    said = " and ".join(f"{count} by {names}" for names, count in by.items() if count)
    return f"; of {whole} points are left out: {said}" if said else ""


def is_one_bone(points_mm: Array, model_extent_mm: float) -> bool:
    """False for points that lie too far apart, whatever their unit is."""
    most_mm = min(EXTENT_LIMITS_MM[1], MOST_SHARE * model_extent_mm)
    return Surface(points_mm).extent_mm <= most_mm


def check_bytes(points_mm: Array) -> None:
    """Refuse coordinates that no camera has, in any unit: bytes that were read as other numbers."""
    if not len(points_mm) or np.abs(points_mm).max() <= MOST_OF_ANY_MM:
        return
    if (extent_mm := robust_extent(points_mm)) > MOST_OF_ANY_MM:
        how = "the bytes may be in the other order (is_bigendian), or the fields at other offsets"
        raise RefusedError(Reason.BAD_FIELDS, f"points {extent_mm:.3g} mm apart: {how}")


def check_spread(points_mm: Array, model_extent_mm: float, unit: str) -> None:
    """Refuse a cloud with points that are metres apart, even a few: no bone is so long."""
    extent_mm = Surface(points_mm).extent_mm
    if extent_mm > EXTENT_LIMITS_MM[1]:
        size = f"{extent_mm:.3g} mm across read as {unit}, {EXTENT_LIMITS_MM[1]:g} mm are the most"
        most_mm = robust_extent(points_mm)
        if most_mm > EXTENT_LIMITS_MM[1] and (other := _looks_like(most_mm, model_extent_mm, unit)):
            raise RefusedError(Reason.UNIT_MISMATCH, f"looks like {other}: {size}; set cloud_unit, or range_max")
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


def _finite_points(cloud: Any, cloud_type: str) -> Array:
    count = INPUTS[cloud_type].count(cloud)
    try:
        points = finite_points(INPUTS[cloud_type].points(cloud))
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
    distance_m = units.to_metres(np.linalg.norm(points_mm, axis=1))
    farthest = parameters.range_max if parameters.range_max > 0.0 else np.inf
    return points_mm[(distance_m >= parameters.range_min) & (distance_m <= farthest)]


def _looks_like(extent_mm: float, model_extent_mm: float, unit: str) -> str:
    """The other units in which the cloud would be a piece of the bone, else those in which it may be one; or ""."""
    per_mm = extent_mm / units.MM_PER_UNIT[unit] / model_extent_mm
    shares = {name: per_mm * units.MM_PER_UNIT[other] for other, name in UNIT_NAMES.items() if other != unit}
    low, high = PLAUSIBLE
    fitting = [name for name, share in shares.items() if low <= share <= high]
    return " or ".join(fitting or [name for name, share in shares.items() if LEAST_SHARE <= share <= MOST_SHARE])
