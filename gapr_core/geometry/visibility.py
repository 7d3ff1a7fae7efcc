"""Which points of a cloud are seen from outside, and which way is out.

Two depth buffers, for two kinds of cloud. A bone of one surface has nothing to hide: the first lets a point pass unless
something is clearly before it. A hollow one (a segmentation that follows the cortical bone on both sides) has a second
surface a few millimetres below, which the first buffer lets pass. So the second asks whether anything in front of a
point lies above its tangent plane. The few outer points that this loses are found again next to the others.
"""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gapr_core.geometry import quadrics
from gapr_core.geometry.sampling import fibonacci_directions
from gapr_core.runtime.parallel import in_threads, thread_count

Array = NDArray[np.float64]
View = Callable[[Array, Array, Array, float], NDArray[np.bool_]]  # direction, points, normals, pixel_mm -> seen

STEEPEST = 2.0  # tangent of the steepest slope that the depth buffer makes room for
FEWEST_VIEWS = 0.05  # share of the views that must see a point of the outer layer: gaps between outer points let some
TURNS = 4  # in which these views are taken, each evenly spread
MOST_PIXELS = 1024  # across a view: points in pairs have next to no spacing, and a buffer that fine has no end
HOLLOW_FROM = 0.15  # share of inner points that makes a bone a hollow one; deep folds of a solid pelvis reach 0.12


def seen_from(direction: Array, points: Array, normals: Array, pixel_mm: float) -> NDArray[np.bool_]:
    """Mask of the (N, 3) points that a depth buffer sees from far along `direction`.

    A point is seen when nothing in the 3 x 3 pixels around it stands higher than its own tangent plane explains.

    Args:
        direction: (3,) unit vector from the body to the viewer.
        points: (N, 3), mm.
        normals: (N, 3), unit; the sign does not matter.
        pixel_mm: edge of a pixel; about 1.5 point spacings closes the surface.
    """
    return np.asarray(_seen_from(direction, points, normals, pixel_mm))


def unobstructed_from(direction: Array, points: Array, normals: Array, pixel_mm: float) -> NDArray[np.bool_]:
    """Mask the (N, 3) points over whose tangent plane no other point of the 3 x 3 pixels stands.

    Unlike a difference in height, the distance to the plane is the wall's thickness from wherever a wall is seen.
    """
    return np.asarray(_unobstructed_from(direction, points, normals, pixel_mm))


@numba.njit(cache=True, nogil=True)
def _pixels(direction, points, pixel_mm):  # type: ignore[no-untyped-def]
    """Give each point's height and pixel in a view along `direction`, and the numbers of rows and columns.

    The outermost pixels are empty: every point has eight pixels around its own.
    """
    x, y, z = direction[0], direction[1], direction[2]
    a, b, c = (0.0, z, -y) if abs(x) < 0.9 else (-z, 0.0, x)  # direction x first or second axis
    size = np.sqrt(a * a + b * b + c * c)
    a, b, c = a / size, b / size, c / size
    d, e, f = y * c - z * b, z * a - x * c, x * b - y * a
    count = len(points)
    height, across, along = np.empty(count), np.empty(count), np.empty(count)
    row, column = np.empty(count, dtype=np.int64), np.empty(count, dtype=np.int64)
    for p in range(count):
        px, py, pz = points[p, 0], points[p, 1], points[p, 2]
        height[p] = px * x + py * y + pz * z
        across[p], along[p] = px * a + py * b + pz * c, px * d + py * e + pz * f
    lowest_across, lowest_along = across.min(), along.min()  # the pixels move with the points
    for p in range(count):
        row[p] = np.int64(np.floor((across[p] - lowest_across) / pixel_mm))
        column[p] = np.int64(np.floor((along[p] - lowest_along) / pixel_mm))
    rows, columns = row.max() + 3, column.max() + 3
    for p in range(count):
        row[p] = (row[p] + 1) * columns + column[p] + 1
    return height, row, rows, columns


@numba.njit(cache=True, nogil=True)
def _seen_from(direction, points, normals, pixel_mm):  # type: ignore[no-untyped-def]
    height, pixel, rows, columns = _pixels(direction, points, pixel_mm)
    highest, alone = np.full(rows * columns, -np.inf), np.empty(rows * columns)
    for p in range(len(points)):
        highest[pixel[p]] = max(highest[pixel[p]], height[p])
    for step in (1, columns):  # 3 x 3 maximum, one axis after the other
        for i in range(len(highest)):
            alone[i] = highest[i]
        for i in range(step, len(highest) - step):
            highest[i] = max(alone[i - step], alone[i], alone[i + step])
    seen = np.empty(len(points), dtype=np.bool_)
    for p in range(len(points)):
        facing = abs(normals[p, 0] * direction[0] + normals[p, 1] * direction[1] + normals[p, 2] * direction[2])
        slope = min(np.sqrt(1.0 - min(facing, 1.0) ** 2) / max(facing, 1e-9), STEEPEST)
        seen[p] = height[p] >= highest[pixel[p]] - pixel_mm * (0.5 + 1.5 * slope)
    return seen


@numba.njit(cache=True, nogil=True)
def _unobstructed_from(direction, points, normals, pixel_mm):  # type: ignore[no-untyped-def]
    height, pixel, rows, columns = _pixels(direction, points, pixel_mm)
    highest = np.full(rows * columns, -1, dtype=np.int64)
    for p in range(len(points)):
        if highest[pixel[p]] < 0 or height[p] >= height[highest[pixel[p]]]:
            highest[pixel[p]] = p
    around = np.array([0, 1, -1, columns, -columns, columns + 1, columns - 1, 1 - columns, -1 - columns])
    free = np.empty(len(points), dtype=np.bool_)
    for p in range(len(points)):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        slant = normals[p, 0] * direction[0] + normals[p, 1] * direction[1] + normals[p, 2] * direction[2]
        free[p] = abs(slant) > 0.1
        sign = 1.0 if slant > 0.0 else -1.0
        nx, ny, nz = sign * normals[p, 0], sign * normals[p, 1], sign * normals[p, 2]
        i = 0
        while free[p] and i < 9:
            top = highest[pixel[p] + around[i]]
            i += 1
            if top >= 0:
                over_mm = (points[top, 0] - x) * nx + (points[top, 1] - y) * ny + (points[top, 2] - z) * nz
                free[p] = over_mm < 0.5 * pixel_mm
    return free


@numba.njit(cache=True, nogil=True)
def _sum_of_views(views, directions):  # type: ignore[no-untyped-def]
    """Sum (N, 3) of the directions (D, 3) whose views (D, N) are true, and their number (N,)."""
    votes, counts = np.zeros((views.shape[1], 3)), np.zeros(views.shape[1], dtype=np.int64)
    for d in range(len(views)):
        for p in range(views.shape[1]):
            if views[d, p]:
                counts[p] += 1
                for axis in range(3):
                    votes[p, axis] += directions[d, axis]
    return votes, counts


def outward_votes(
    points: Array,
    normals: Array,
    spacing_mm: float,
    directions: int = 96,
    num_threads: int = 1,
) -> tuple[Array, NDArray[np.int64]]:
    """Sum of the directions from which `seen_from` sees each point, and their number.

    Args:
        points: (N, 3), mm.
        normals: (N, 3), unit; the sign does not matter.
        spacing_mm: typical distance between neighbouring points.
        directions: how many views, evenly spread.
        num_threads: 0 for all cores.

    Returns:
        (N, 3) sums of unit view directions, which point out of the body, and (N,) counts. A count of zero marks a point
        inside the shell, such as the wall of a medullary canal.
    """
    towards = fibonacci_directions(directions)
    return _sum_of_views(_views(towards, points, normals, spacing_mm, seen_from, num_threads), towards)  # type: ignore[no-any-return]


def _views(
    directions: Array, points: Array, normals: Array, spacing_mm: float, depth_buffer: View, num_threads: int
) -> NDArray[np.bool_]:
    """(D, N) which points each of the directions (D, 3) sees, by `seen_from` or `unobstructed_from`."""
    pixel_mm = max(1.5 * spacing_mm, float(np.linalg.norm(np.ptp(points, axis=0))) / MOST_PIXELS)
    normals = np.ascontiguousarray(normals)  # rows of frames are not: they would be compiled for as well

    def view(direction: Array) -> NDArray[np.bool_]:
        return depth_buffer(direction, points, normals, pixel_mm)

    return np.stack(in_threads(view, directions, num_threads=num_threads))


def outer_layer(
    points: Array, normals: Array, spacing_mm: float, directions: int = 96, num_threads: int = 1
) -> tuple[NDArray[np.bool_], Array] | None:
    """Find the outer one of the two surfaces of a hollow bone.

    Args:
        points: (N, 3), mm.
        normals: (N, 3), unit; the sign does not matter.
        spacing_mm: typical distance between neighbouring points.
        directions: how many views, evenly spread.
        num_threads: 0 for all cores.

    Returns:
        (N,) mask and (N, 3) vectors that point out of the body; None for a bone of one surface. A wall thinner than
        the spacing of the points cannot be separated from one surface.
    """
    towards, views = fibonacci_directions(directions), np.zeros((directions, len(points)), dtype=np.bool_)
    for turn in range(TURNS):
        some = slice(turn, None, TURNS)
        views[some] = _views(towards[some], points, normals, spacing_mm, unobstructed_from, num_threads)
        outer = views.sum(axis=0) >= FEWEST_VIEWS * directions
        if outer.mean() > 1.0 - HOLLOW_FROM:  # of a bone of one surface a few views are enough: it only grows
            return None
    votes, _ = _sum_of_views(views, towards)
    if outer.sum() < quadrics.FEWEST_NEIGHBOURS:
        return None
    for _ in range(3):
        _grow(outer, votes, points, spacing_mm, num_threads)
        if outer.mean() > 1.0 - HOLLOW_FROM:
            return None
    return outer, votes


def _grow(outer: NDArray[np.bool_], outward: Array, points: Array, spacing_mm: float, num_threads: int) -> None:
    """Add, in place, the points that lie on the surface elements of those already in the mask."""
    inside = np.flatnonzero(outer)
    tree = cKDTree(points[inside])
    _, neighbours = quadrics.nearest(points[inside], quadrics.FEWEST_NEIGHBOURS, tree, num_threads)
    frames = quadrics.local_frames(points[inside], neighbours, num_threads)
    normals = quadrics.orient(frames.normals, outward[inside])
    normals, shapes = quadrics.fit_quadrics(points[inside], normals, neighbours, num_threads)
    rest = np.flatnonzero(~outer)
    apart, nearest = tree.query(points[rest], workers=thread_count(num_threads))
    off = quadrics.heights(points[rest] - points[inside[nearest]], normals[nearest], shapes[nearest])
    on_it = (np.abs(off) < 0.5 * spacing_mm) & (apart < 3.0 * spacing_mm)
    outer[rest[on_it]] = True
    outward[rest[on_it]] = normals[nearest[on_it]]
