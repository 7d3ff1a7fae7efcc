"""Damage of a source that no protocol and no fitted pair holds: to judge with only.

A damage is a function of a `Pair`, of where it was measured, of its bone and of a random generator. It returns the pair
with another source, or another target. Sizes are those of an operating room: a plate of 80 x 12 mm, 1.5 to 3 mm of
cartilage, a fragment that is 2 to 6 mm out of place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gapr_core.data.pair import TARGET_POINTS, Pair
from gapr_core.data.sensors import depth_maps
from gapr_core.data.sensors.acquired import View
from gapr_core.data.specimen import Specimen
from gapr_core.geometry import extent, se3
from gapr_core.geometry.sampling import random_directions

Array = NDArray[np.float64]
Random = np.random.Generator

CARTILAGE_MM = (1.5, 3.0)
ENDS, RIM = 0.1, 0.25  # share of the length at either end that has cartilage; share of that where it thins out
PLATE_MM, PLATE_SHARE = (80.0, 12.0, 4.0), (0.1, 0.25)  # length, width, height of its top; share of the points
TISSUE_SHARE, SHEETS = (0.3, 0.6), 3  # points of soft tissue for each of bone; sheets that hold them
JOINT_SHARE, JOINT_MM = (0.2, 0.5), 40.0  # points of the next bone for each of bone; how far into it
FRAGMENT = (0.25, 0.4)  # share of the points
FRAGMENT_DEG, FRAGMENT_MM = (4.0, 10.0), (2.0, 6.0)  # how far it is turned, and shifted
TAIL_MM, FREEDOM = 1.2, 2.0  # scale and degrees of freedom of Student's t
GRID_MM, STRETCH, SAG_MM, SMOOTH_MM = 2.0, 0.035, 3.0, 5.0
LINES_MM = (1.0, 15.0)  # width of a line, and from line to line
STITCH_MM = (1.0, 2.0)  # how far one half lies off the other
RANGE = (0.005, 0.02)  # how far a camera's range is wrong
PATCH_MM, ALIKE_MM = 1.0, 3.0  # error that near points share, and the standard deviation of the window that they share
LAYER_MM = (4.0, 8.0)  # thickness of an even layer
KEPT_LENGTH = 0.6  # of the bone, in a target that a source reaches beyond


@dataclass(frozen=True)
class Site:
    """Where a source was measured, in the target's frame, mm.

    Attributes:
        points, normals: (M, 3) of the whole bone, normals outward.
        neighbour: (K, 3) of the bone on the other side of a joint; empty where none is known.
    """

    points: Array
    normals: Array
    neighbour: Array

    @classmethod
    def of(cls, specimen: Specimen, origin_mm: Array, neighbour: Specimen | None = None) -> Site:
        """Find the specimen of a pair, in its frame, and the next bone of the same scan."""
        rng = np.random.default_rng(0)
        points, normals = specimen.sample(2 * TARGET_POINTS, rng)
        beyond = neighbour.sample(TARGET_POINTS, rng)[0] - origin_mm if neighbour else np.empty((0, 3))
        return cls(points - origin_mm, normals, beyond)

    def outward(self, points: Array) -> Array:
        """(N, 3) normals of the bone next to points (N, 3)."""
        return np.asarray(self.normals[cKDTree(self.points).query(points)[1]])

    def frame_at(self, points: Array, rng: Random) -> tuple[Array, Array]:
        """Choose a point (3,), and (3, 3) rows: two directions along the bone there, and the outward one."""
        place = points[rng.integers(len(points))]
        outward = self.outward(place[None])[0]
        along = np.cross(outward, random_directions(1, rng)[0])
        along /= np.linalg.norm(along)
        return place, np.array([along, np.cross(outward, along), outward])


Change = Callable[[Array, Site, Random], Array]


def cartilage(points: Array, site: Site, rng: Random) -> Array:
    """Both ends of the bone carry a layer that the target, a CT, does not have."""
    centre, axis = site.points.mean(axis=0), extent.principal(site.points).axes[0]
    along, length = (points - centre) @ axis, (site.points - centre) @ axis
    from_end = np.minimum(along - length.min(), length.max() - along) / (ENDS * np.ptp(length))
    layer_mm = rng.uniform(*CARTILAGE_MM) * np.clip((1.0 - from_end) / RIM, 0.0, 1.0)
    return np.asarray(points + layer_mm[:, None] * site.outward(points))


def plate(points: Array, site: Site, rng: Random) -> Array:
    """Screw a plate to the bone, which hides a part of it."""
    place, axes = site.frame_at(points, rng)
    local = (points - place) @ axes.T
    half = np.array(PLATE_MM) / 2.0
    under = (
        (np.abs(local[:, 0]) < half[0]) & (np.abs(local[:, 1]) < half[1]) & (np.abs(local[:, 2]) < 4.0 * PLATE_MM[2])
    )
    count = round(len(points) * rng.uniform(*PLATE_SHARE))
    top = np.column_stack([rng.uniform(-half[0], half[0], count), rng.uniform(-half[1], half[1], count)])
    height = PLATE_MM[2] + rng.normal(0.0, 0.3, count)
    return np.vstack([points[~under], place + np.column_stack([top, height]) @ axes])


def tissue(points: Array, site: Site, rng: Random) -> Array:
    """Sheets of soft tissue rise from the bone, as around a wound, and nobody says where the camera was."""
    count = round(len(points) * rng.uniform(*TISSUE_SHARE)) // SHEETS
    return np.vstack([points, *(_sheet(points, site, count, rng) for _ in range(SHEETS))])


def _sheet(points: Array, site: Site, count: int, rng: Random) -> Array:
    place, axes = site.frame_at(points, rng)
    tilt, across, along = rng.uniform(-0.8, 0.8), rng.uniform(5.0, 40.0, count), rng.uniform(-30.0, 30.0, count)
    waves = 2.0 * np.sin(across / 9.0) + 2.0 * np.sin(along / 7.0)
    height = rng.uniform(2.0, 10.0) + across * np.sin(tilt) + waves
    local = np.column_stack([across * np.cos(tilt), along, height])
    return np.asarray(place + local @ axes + rng.normal(0.0, 0.5, local.shape))


def joint(points: Array, site: Site, rng: Random) -> Array:
    """Add the end of the next bone to the cloud; nothing changes if none is known."""
    if not len(site.neighbour):
        return points
    gaps = cKDTree(site.points).query(site.neighbour)[0]
    near = np.flatnonzero(gaps < JOINT_MM)
    count = round(len(points) * rng.uniform(*JOINT_SHARE))
    found = site.neighbour[rng.choice(near, min(count, len(near)), replace=False)]
    return np.vstack([points, found + rng.normal(0.0, 1.0, found.shape)])


def fracture(points: Array, site: Site, rng: Random) -> Array:
    """Turn and shift a part of the bone against the rest; the true pose is that of the rest."""
    along = points @ random_directions(1, rng)[0]
    fragment = along < np.quantile(along, rng.uniform(*FRAGMENT))
    turn = np.radians(rng.uniform(*FRAGMENT_DEG)) * random_directions(1, rng)[0]
    shift = rng.uniform(*FRAGMENT_MM) * random_directions(1, rng)[0]
    moved = points.copy()
    moved[fragment] = se3.apply(se3.exp(np.concatenate([shift, turn]), points[fragment].mean(axis=0)), points[fragment])
    return moved


def heavy_tails(points: Array, site: Site, rng: Random) -> Array:
    """Noise without a variance: Student's t with two degrees of freedom."""
    return points + TAIL_MM * rng.standard_t(FREEDOM, points.shape)


def coarse_grid(points: Array, site: Site, rng: Random) -> Array:
    """Coordinates are rounded to 2 mm, in a frame of the sensor's own."""
    R = se3.random_rotation(rng)
    return np.asarray(np.round(points @ R.T / GRID_MM) * GRID_MM @ R)


def one_axis(points: Array, site: Site, rng: Random) -> Array:
    """Everything is 3.5 % longer or shorter along one axis of the sensor."""
    R, centre = se3.random_rotation(rng), points.mean(axis=0)
    stretch = np.array([1.0 + STRETCH * rng.choice([-1.0, 1.0]), 1.0, 1.0])
    return np.asarray(((points - centre) @ R.T * stretch) @ R + centre)


def wrong_range(points: Array, site: Site, rng: Random) -> Array:
    """Everything is .5 to 2 % larger or smaller: of a camera whose range is wrong."""
    centre = points.mean(axis=0)
    return np.asarray(centre + (1.0 + rng.choice([-1.0, 1.0]) * rng.uniform(*RANGE)) * (points - centre))


def patches(points: Array, site: Site, rng: Random) -> Array:
    """Near points share an error of 1 mm, as in the windows over which a stereo camera matches."""
    outward = site.outward(points)
    towards = outward.mean(axis=0) / np.linalg.norm(outward.mean(axis=0))
    alike = depth_maps.windows(View(points, outward, towards, {}), ALIKE_MM).patchy(PATCH_MM, rng)
    return np.asarray(points + alike[:, None] * outward)


def lines(points: Array, site: Site, rng: Random) -> Array:
    """Only lines of 1 mm are seen, 15 mm apart."""
    return points[points @ random_directions(1, rng)[0] % LINES_MM[1] < LINES_MM[0]]


def stitched(points: Array, site: Site, rng: Random) -> Array:
    """Two views, one of which lies 1 to 2 mm elsewhere; both hold the middle third."""
    along = points @ random_directions(1, rng)[0]
    low, high = np.quantile(along, [1.0 / 3.0, 2.0 / 3.0])
    of_second = rng.uniform(low, high, len(points)) < along
    return np.asarray(points + of_second[:, None] * rng.uniform(*STITCH_MM) * random_directions(1, rng)[0])


def bent(points: Array, site: Site, rng: Random) -> Array:
    """Bend the cloud by 3 mm towards its ends, as a sensor that drifts does."""
    axes, centred = extent.principal(points).axes, points - points.mean(axis=0)
    along = centred @ axes[0]
    return np.asarray(points + SAG_MM * ((along / np.abs(along).max()) ** 2)[:, None] * axes[2])


def smoothed(points: Array, site: Site, rng: Random) -> Array:
    """Replace every point by the mean of those within 5 mm, as a scanner's software may do."""
    around = cKDTree(points).query_ball_point(points, SMOOTH_MM)
    return np.array([points[rows].mean(axis=0) for rows in around])


def even_layer(points: Array, site: Site, rng: Random) -> Array:
    """Cover the cloud by an even layer of 4 to 8 mm: muscle, a drape, or an offset of the sensor."""
    return np.asarray(points + rng.uniform(*LAYER_MM) * site.outward(points))


def of_source(change: Change, pair: Pair, site: Site, specimen: Specimen, rng: Random) -> Pair:
    """Change the source of a pair where it lies on the bone."""
    if not pair.has_truth:
        raise ValueError("a pair with a true pose is damaged; for another subject's bone, its source is taken then")
    on_bone = change(se3.apply(pair.T_target_source, pair.source), site, rng)
    return replace(pair, source=se3.apply(se3.inverse(pair.T_target_source), on_bone))


def beyond(pair: Pair, site: Site, specimen: Specimen, rng: Random) -> Pair:
    """End the target at 60 % of the bone's length, but not the source."""
    part = specimen.end(KEPT_LENGTH, bool(rng.integers(2)))
    return replace(pair, target=part.sample(TARGET_POINTS, rng)[0] - pair.metadata["origin_mm"])


CHANGES: dict[str, Change] = {
    "cartilage": cartilage, "plate": plate, "soft tissue": tissue, "next bone": joint, "fracture": fracture,
    "heavy tails": heavy_tails, "coarse grid": coarse_grid, "one axis": one_axis, "wrong range": wrong_range,
    "patches": patches, "lines": lines, "stitched": stitched, "bent": bent, "smoothed": smoothed,
    "even layer": even_layer,
}  # fmt: skip
DAMAGES: dict[str, Callable[[Pair, Site, Specimen, Random], Pair]] = {
    **{name: partial(of_source, change) for name, change in CHANGES.items()},
    "beyond the target": beyond,
}
