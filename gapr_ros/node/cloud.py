"""From a serialised cloud to the points in mm that registration gets, or the reason why not."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from gapr_core import crop_box
from gapr_core.clouds import EXTENT_LIMITS_MM, PLAUSIBLE, finite_points
from gapr_core.geometry import pinhole
from gapr_core.surface import Surface
from gapr_ros.node import units
from gapr_ros.node.outcome import Reason, RefusedError
from gapr_ros.parameters import NodeParameters
from msg_adapters import InvalidMessageError, cloud_to_grid, cloud_to_xyz

Array = NDArray[np.float64]
UNIT_NAMES = {"m": "metres", "cm": "centimetres", "mm": "millimetres"}
MOST_OF_ANY_MM = 1e8
MOST_POINTS = 60_000  # larger clouds are thinned, always alike
LEAST_SHARE, MOST_SHARE = 0.005, 20.0  # of the bone's extent, that a cloud of it can have in the right unit
# A table: a plane that is larger than the bone
TABLE_SHARE, TABLE_SIZE = 0.3, 1.2  # least share of the points, and of the bone's extent
TABLE_MM = 3.0, 8.0  # least and largest distance from it that counts as on it
TABLE_DRAWN, TABLE_TRIES = 3000, 200
APART_MM, SMALL_SHARE, LARGE_SHARE = 15.0, 0.1, 1.5  # things on it: gap between two, least of the largest, of the bone


class Taken(NamedTuple):
    """The points that are registered.

    Attributes:
        points_mm: (N, 3), the cloud's frame.
        on_table: how many were left out as a table.
    """

    points_mm: Array
    on_table: int


def read_message(data: bytes) -> PointCloud2:
    """Read the message, or refuse bytes that are none."""
    try:
        return deserialize_message(data, PointCloud2)
    except Exception as error:  # the middleware raises several kinds
        raise RefusedError(Reason.BAD_FIELDS, f"the bytes are no whole PointCloud2 ({error})") from error


def read_header(data: bytes) -> Header | None:
    """Read the header alone, in microseconds for a cloud of any size; None if the bytes are no message."""
    try:
        return deserialize_message(data, Header)
    except Exception:  # the middleware raises several kinds
        return None


def count(cloud: PointCloud2) -> int:
    """Number of points of the message, usable or not."""
    return int(cloud.width) * int(cloud.height)


def plain_frame(frame_id: str) -> str:
    """Return a frame's name as tf2 knows it: without the leading slash of ROS 1."""
    return frame_id.lstrip("/")


def take_in(
    cloud: PointCloud2, model_extent_mm: float, parameters: NodeParameters, T_crop_cloud: Array | None = None
) -> Taken:
    """Read, convert, clean, crop and thin a cloud, and leave out a table.

    Args:
        cloud: the message.
        model_extent_mm: of the bone.
        parameters: unit and box.
        T_crop_cloud: (4, 4), metres, into the frame of the box; None without a box.

    Raises:
        RefusedError: empty_cloud, bad_fields, non_finite, too_few_points or unit_mismatch.
    """
    whole = units.to_mm(_finite_points(cloud), parameters.cloud_unit)
    check_bytes(whole)
    points = whole if T_crop_cloud is None else _in_box(whole, parameters, T_crop_cloud)
    if not len(points):
        text = f"none of {len(whole)} points is in the box from crop_min to crop_max: correct the box"
        raise RefusedError(Reason.TOO_FEW_POINTS, text)
    points = thin(points, MOST_POINTS)
    if parameters.collects:
        check_spread(points, model_extent_mm, parameters.cloud_unit)
        return Taken(points, 0)
    kept = without_table(points, model_extent_mm)
    check_unit(kept, model_extent_mm, parameters.cloud_unit)
    check_spread(kept, model_extent_mm, parameters.cloud_unit)
    return Taken(kept, len(points) - len(kept))


def seen_from(cloud: PointCloud2, parameters: NodeParameters) -> Array | None:
    """(3,) mm, the cloud's frame: the camera that saw a single cloud, where `viewpoint` is auto.

    Organised clouds show it in any frame, others in that of their camera (`geometry.pinhole`); None where neither does.
    """
    if parameters.viewpoint != "auto" or parameters.collects:
        return None
    grid = cloud_to_grid(cloud)
    centre = pinhole.camera_of(cloud_to_xyz(cloud, drop_zeros=True) if grid is None else grid)
    return None if centre is None else units.to_mm(centre, parameters.cloud_unit)


def without_table(points_mm: Array, bone_mm: float) -> Array:
    """Keep the points that stand out of a plane larger than the bone, in pieces of its size.

    Such a plane is a table, a floor or a drape. Without one all points are kept.
    """
    distance_mm = _table(points_mm, bone_mm)
    if distance_mm is None:
        return points_mm
    rest = points_mm[distance_mm > 0.0]
    pieces = [rest[labels] for labels in _pieces(rest)]
    pieces = [piece for piece in pieces if robust_extent(piece) <= LARGE_SHARE * bone_mm]
    most = max(map(len, pieces), default=0)
    kept = [piece for piece in pieces if len(piece) >= SMALL_SHARE * most]
    return np.concatenate(kept) if kept else points_mm


def _table(points_mm: Array, bone_mm: float) -> Array | None:
    """(N,) distance beyond what counts as on the table, mm, 0 or less on it; None without a table."""
    if robust_extent(points_mm) < TABLE_SIZE * bone_mm:
        return None
    rng = np.random.default_rng(0)
    drawn = points_mm[rng.integers(len(points_mm), size=min(len(points_mm), TABLE_DRAWN))]
    first, second, third = drawn[rng.integers(len(drawn), size=(3, TABLE_TRIES))]
    normals = np.cross(second - first, third - first)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    off = np.abs(drawn @ normals.T - (first * normals).sum(axis=1))
    best = int((off <= TABLE_MM[0]).sum(axis=0).argmax())
    on = drawn[off[:, best] <= TABLE_MM[1]]
    if len(on) < TABLE_SHARE * len(drawn) or robust_extent(on) < TABLE_SIZE * bone_mm:
        return None
    normal = np.linalg.svd(on - on.mean(axis=0), full_matrices=False)[2][2]
    spread = np.median(np.abs((on - on.mean(axis=0)) @ normal))
    limit_mm = float(np.clip(5.0 * spread, *TABLE_MM))
    return np.asarray(np.abs((points_mm - on.mean(axis=0)) @ normal) - limit_mm)


def _pieces(points: Array) -> list[NDArray[np.bool_]]:
    """Masks of the groups of points that are farther apart than `APART_MM`."""
    if not len(points):
        return []
    cells, cell_of = np.unique(np.floor(points / (APART_MM / 2.0)), axis=0, return_inverse=True)
    pairs = cKDTree(cells).query_pairs(2.0, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
    number, labels = connected_components(graph, directed=False)
    of_points = labels[cell_of.ravel()]
    return [of_points == label for label in range(number) if (of_points == label).sum() > 3]


def _in_box(points_mm: Array, parameters: NodeParameters, T_crop_cloud: Array) -> Array:
    """Keep the points inside the box, whose corners are in metres."""
    low, high = (np.asarray(corner) for corner in (parameters.crop_min, parameters.crop_max))
    if not (low < high).all():
        text = f"the box is empty: crop_min {low.tolist()} is not below crop_max {high.tolist()}: correct them"
        raise RefusedError(Reason.TOO_FEW_POINTS, text)
    T, low_mm, high_mm = units.in_mm(T_crop_cloud), units.to_mm(low, "m"), units.to_mm(high, "m")
    return crop_box(points_mm, T, lowest=low_mm, highest=high_mm)


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
            raise RefusedError(Reason.UNIT_MISMATCH, f"looks like {other}: {size}; set cloud_unit, or a crop box")
        raise RefusedError(Reason.UNIT_MISMATCH, f"points too far apart: {size}; set a crop box, or cloud_unit")


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
        raise RefusedError(Reason.UNIT_MISMATCH, f"the cloud is far larger than the bone: {size}; set a crop box")


def robust_extent(points_mm: Array) -> float:
    """Diagonal of the box that holds the middle 98 % along each axis, mm."""
    low, high = np.percentile(points_mm, [1.0, 99.0], axis=0)
    return float(np.linalg.norm(high - low))


def thin(points: Array, most: int) -> Array:
    """At most `most` of the points, drawn at random but always alike."""
    if len(points) <= most:
        return points
    chosen = np.random.default_rng(0).choice(len(points), most, replace=False, shuffle=False)
    return points[np.sort(chosen)]


def _finite_points(cloud: PointCloud2) -> Array:
    try:
        points = finite_points(cloud_to_xyz(cloud, drop_zeros=True))
    except InvalidMessageError as error:
        raise RefusedError(Reason.BAD_FIELDS, str(error)) from error
    if count(cloud) == 0:
        raise RefusedError(Reason.EMPTY_CLOUD, "the cloud has no points: look at the driver")
    if len(points) == 0:
        text = f"none of {count(cloud)} points is finite and off the sensor's origin: look at the driver"
        raise RefusedError(Reason.NON_FINITE, text)
    return points


def _looks_like(extent_mm: float, model_extent_mm: float, unit: str) -> str:
    """Name the other units in which the cloud would be a piece of the bone, else may be one, or ""."""
    per_mm = extent_mm / units.MM_PER_UNIT[unit] / model_extent_mm
    shares = {name: per_mm * units.MM_PER_UNIT[other] for other, name in UNIT_NAMES.items() if other != unit}
    low, high = PLAUSIBLE
    fitting = [name for name, share in shares.items() if low <= share <= high]
    return " or ".join(fitting or [name for name, share in shares.items() if LEAST_SHARE <= share <= MOST_SHARE])
