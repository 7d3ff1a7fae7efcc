"""The intra-operative cloud as registration sees it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from gapr_core import clouds
from gapr_core.config import SourceConfig
from gapr_core.geometry import quadrics, sampling
from gapr_core.results import Refusal, RegistrationStatus

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PreparedSource:
    """A cleaned source.

    Attributes:
        points: (N, 3) float64, mm, in the source frame.
        axes: (N, 3, 3) local frames; rows are two tangents and the unit normal, whose sign is arbitrary.
        flatness_mm: (N,) root-mean-square distance of a point's neighbours to their plane.
        neighbours: (N, k) indices of each point's nearest points, itself first.
        order: (N,) indices such that every prefix is spread over the whole cloud, trustworthy points first.
        spacing_mm: median distance between neighbouring points.
        oriented: the normals point out of the body, to where the sensor was, so that their sign says something.
    """

    points: Array
    axes: Array
    flatness_mm: Array
    neighbours: NDArray[np.int64]
    order: NDArray[np.int64]
    spacing_mm: float
    oriented: bool = False

    @property
    def normals(self) -> Array:
        """(N, 3) unit normals, of arbitrary sign unless `oriented`."""
        return self.axes[:, 2]

    @property
    def noise_mm(self) -> float:
        """Roughness of the source alone: median distance of neighbours to their plane, mm."""
        return float(np.median(self.flatness_mm))

    def facing(self, viewpoint: Array) -> PreparedSource:
        """The same with normals that point to the viewpoint (3,), mm: a sensor sees surfaces from outside."""
        away = np.einsum("ni,ni->n", self.normals, viewpoint - self.points) < 0.0
        return replace(self, axes=self.axes * np.where(away[:, None], [1.0, -1.0, -1.0], 1.0)[..., None], oriented=True)

    def subset(self, count: int) -> Array:
        """(min(count, N), 3) of its points, spread over the whole cloud."""
        return self.points[self.order[:count]]


def prepare(source: ArrayLike, config: SourceConfig | None = None) -> PreparedSource | Refusal:
    """Clean, thin and describe a source (N, 3), mm.

    Returns:
        The prepared source, or why there is too little of it.

    Raises:
        InvalidPointCloudError: for a wrong shape or type, or an extent that cannot be a piece of a bone in mm.
    """
    config = config or SourceConfig()
    points = clouds.finite_points(source)
    if len(points) > config.most_raw_points:
        points = points[np.random.default_rng(0).choice(len(points), config.most_raw_points, replace=False)]
    points = without_isolated(sampling.distinct(points), config)
    if len(points) < config.fewest_points:
        return Refusal(
            RegistrationStatus.TOO_FEW_POINTS,
            f"{len(points)} distinct finite points, at least {config.fewest_points} are needed",
        )
    extent_mm = float(np.linalg.norm(np.ptp(points, axis=0)))
    if extent_mm > clouds.EXTENT_LIMITS_MM[1] or extent_mm < 1.0:
        clouds.check_extent(extent_mm, "mm", "the source")
    width_mm = float(np.sqrt(np.linalg.eigvalsh(np.cov(points.T))[1]))
    if width_mm < config.smallest_width_mm:
        return Refusal(RegistrationStatus.DEGENERATE, f"the source is a line: it spreads {width_mm:.1f} mm sideways")
    return describe(points[sampling.thin(points, config.most_points)], config)


def without_isolated(points: Array, config: SourceConfig) -> Array:
    """Points (N, 3), mm, without those far from all others: far echoes, flying pixels.

    A point is isolated when its sixth nearest neighbour (`companions`) is farther than 12 mm and than five times what
    is typical of the cloud: Open3D's `remove_radius_outlier` with a radius that follows the spacing. Of a sparse cloud,
    such as a pointer gives, every point counts: it stays as it is.
    """
    if len(points) < config.dense_points:
        return points
    some = points[:: -(-len(points) // config.most_compared)]
    gaps = cKDTree(some).query(points, k=config.companions + 1)[0][:, -1]
    return points[gaps <= max(config.isolated_mm, config.isolated_gaps * float(np.median(gaps)))]


def describe(points: Array, config: SourceConfig) -> PreparedSource:
    """Frames, neighbours and order of points (N, 3), mm, that are clean and thin already."""
    gaps, neighbours = cKDTree(points).query(points, k=_neighbour_count(len(points), config))
    frames = quadrics.local_frames(points, neighbours)
    isolation = np.linalg.norm(points - points[neighbours].mean(axis=1), axis=1) / np.maximum(gaps[:, -1], 1e-9)
    return PreparedSource(
        points,
        frames.axes,
        frames.flatness_mm,
        neighbours,
        _spread_order(points, isolation),
        float(np.median(gaps[:, 1])),
    )


def _neighbour_count(count: int, config: SourceConfig) -> int:
    """How many points give a normal: of few points a quarter, so that it stays one of a part of the source."""
    return min(config.normal_neighbours, max(count // 4, config.fewest_points), count)


def _spread_order(points: Array, isolation: Array, spread: int = 512) -> NDArray[np.int64]:
    """Points in the middle of their neighbours first, farthest-point order among them; then the rest, shuffled."""
    trusted = np.flatnonzero(isolation <= np.quantile(isolation, 0.8))
    start = int(np.linalg.norm(points[trusted] - points[trusted].mean(axis=0), axis=1).argmin())
    spread_out = sampling.farthest_points(points[trusted], spread, start)
    first = trusted[spread_out[np.sort(np.unique(spread_out, return_index=True)[1])]]  # some may lie on each other
    rest = np.setdiff1d(np.arange(len(points)), first)
    return np.concatenate([first, np.random.default_rng(0).permutation(rest)])
