"""Where a camera was, from the pixels of its own cloud.

In an organised cloud a point's row and column say on which line of sight it lies. All lines of a pinhole camera meet in
its centre, in whatever frame the points are, and errors in depth move points along them: they do not move the centre.
Points without rows and columns lie on such lines too, but only the frame of the camera shows it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.geometry.extent import is_point

Array = NDArray[np.float64]

FEWEST_POINTS = 200
NOTHING = 1e-12  # no distance between points
MOST_POINTS = 2000  # that are looked at, evenly spread over the pixels
FEWEST_SAMPLE, LARGEST_SAMPLE = 1000, 10_000  # points whose lines of sight are counted
SAME_SIGHT = 1e-5  # tangent between lines of sight that are one; those of two pixels are farther apart
FEWEST_A_SIGHT = 4  # coordinates of a row, and of a column, on average
LARGEST_FILLING = 0.25  # share of the steps of `SAME_SIGHT` across the view at which there is a line of sight
LARGEST_MISFIT = 1.0  # pixels, root mean square
LARGEST_DISAGREEMENT = 0.15  # of the distance, between the centres that halves of the image give; that of all is nearer


def camera_of(cloud: ArrayLike) -> Array | None:
    """Find the camera: from the pixels of an organised cloud, or at the origin if the lines of sight meet there.

    Args:
        cloud: (N, 3), or (H, W, 3) if it is organised, any unit; points that saw nothing are not finite, or (0, 0, 0).

    Returns:
        (3,) in the frame and unit of the points; None where neither says.
    """
    points = np.asarray(cloud, dtype=np.float64)
    centre = centre_of(points) if points.ndim == 3 else None
    return np.zeros(3) if centre is None and is_centre_of(points.reshape(-1, 3)) else centre


def centre_of(grid: ArrayLike) -> Array | None:
    """Find the centre of the pinhole camera whose image an organised cloud is.

    The projection matrix is the least-squares solution of the direct linear transform (Hartley and Zisserman 2004,
    section 7.1; PCL's `estimateProjectionMatrix` solves the same). It counts only where both halves of the image, cut
    either way, give nearly the same centre: a plane, rows of a line scanner or parallel slices do not.

    Args:
        grid: (H, W, 3), any unit and frame; pixels that saw nothing are not finite, or exactly (0, 0, 0).

    Returns:
        (3,) in the frame and unit of the points; None where they do not say, as in a cloud of one row.
    """
    grid = np.asarray(grid, dtype=np.float64)
    rows, columns = np.nonzero(_saw_something(grid))
    if min(grid.shape[:2]) < 2 or len(rows) < FEWEST_POINTS:
        return None
    some = np.arange(0, len(rows), -(-len(rows) // MOST_POINTS))
    pixels, points = np.stack([columns, rows], axis=1)[some].astype(np.float64), grid[rows, columns][some]
    P = _projection(pixels, points)
    if P is None or _misfit(P, pixels, points) > LARGEST_MISFIT:
        return None
    centre = _centre(P)
    most = LARGEST_DISAGREEMENT * float(np.linalg.norm(points.mean(axis=0) - centre))
    for half in (pixels[:, axis] < np.median(pixels[:, axis]) for axis in (0, 1)):
        for part in (half, ~half):
            P = _projection(pixels[part], points[part])
            if P is None or not np.linalg.norm(_centre(P) - centre) <= most:
                return None
    return centre


def is_centre_of(points: ArrayLike) -> bool:
    """Check whether a pinhole camera at the origin, with axes along its image, saw a cloud.

    The quotients of two coordinates and the third, that along the view, are then few: one for each row and each column,
    while the coordinates themselves are many. A plane across the view could have been seen from anywhere. And they are
    far apart: those of a cloud that is dense, or far from the origin, are few only where they are rounded.

    Args:
        points: (N, 3), any unit; those that saw nothing are not finite, or exactly (0, 0, 0).
    """
    cloud = np.asarray(points, dtype=np.float64)
    cloud = cloud[_saw_something(cloud)]
    some = cloud[:: max(1, -(-len(cloud) // LARGEST_SAMPLE))]
    return any(_is_view_along(axis, some) for axis in (2, 0, 1))


def _saw_something(points: Array) -> NDArray[np.bool_]:
    """(...) which of the points (..., 3) are points."""
    x, y, z = np.moveaxis(points, -1, 0)
    return np.asarray(is_point(points) & ((x != 0.0) | (y != 0.0) | (z != 0.0)))


def _is_view_along(axis: int, points: Array) -> bool:
    depth, across = points[:, axis], np.delete(points, axis, axis=1)
    if len(points) < FEWEST_SAMPLE or not ((depth > NOTHING).all() or (depth < -NOTHING).all()):
        return False
    sights = np.round(across / depth[:, None] / SAME_SIGHT)
    found = np.array([len(np.unique(column)) for column in sights.T])
    places = np.array([len(np.unique(column)) for column in across.T])  # few where they are on a lattice themselves
    far_apart = found <= LARGEST_FILLING * (np.ptp(sights, axis=0) + 1.0)
    return bool((FEWEST_A_SIGHT * found <= places).all() and far_apart.all())


def _projection(pixels: Array, points: Array) -> Array | None:
    """Solve (u, v, 1) ~ P (x, y, z, 1) for P (3, 4); None if points lie behind the camera.

    Both are centred and scaled before, as there (4.4).
    """
    if len(points) < FEWEST_POINTS // 4 or np.ptp(points, axis=0).max() < NOTHING:
        return None
    to_pixel, to_point = _normalising(pixels), _normalising(points)
    u, X = _homogeneous(pixels) @ to_pixel.T, _homogeneous(points) @ to_point.T
    nothing = np.zeros_like(X)
    rows = np.concatenate([np.hstack([X, nothing, -u[:, :1] * X]), np.hstack([nothing, X, -u[:, 1:2] * X])])
    P = np.linalg.inv(to_pixel) @ np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 4) @ to_point
    depths = _homogeneous(points) @ P[2]
    in_front = (depths > 0.0).all() or (depths < 0.0).all()
    return np.asarray(P) if in_front and abs(np.linalg.det(P[:, :3])) > 0.0 else None


def _normalising(x: Array) -> Array:
    """Find the similarity that moves the mean of x (N, D) to the origin and its mean distance to 1."""
    middle = x.mean(axis=0)
    scale = 1.0 / max(float(np.linalg.norm(x - middle, axis=1).mean()), NOTHING)
    T = np.diag([*[scale] * x.shape[1], 1.0])
    T[:-1, -1] = -scale * middle
    return T


def _homogeneous(x: Array) -> Array:
    return np.hstack([x, np.ones((len(x), 1))])


def _misfit(P: Array, pixels: Array, points: Array) -> float:
    """Root mean square distance between pixels and where the points are seen."""
    seen = _homogeneous(points) @ P.T
    return float(np.sqrt(np.mean(np.sum((seen[:, :2] / seen[:, 2:] - pixels) ** 2, axis=1))))


def _centre(P: Array) -> Array:
    """(3,) the point that P (3, 4) sees nowhere."""
    return np.asarray(-np.linalg.solve(P[:, :3], P[:, 3]))
