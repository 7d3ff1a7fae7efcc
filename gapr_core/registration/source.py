"""The intra-operative cloud as registration sees it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from gapr_core import clouds
from gapr_core.config import SourceConfig
from gapr_core.geometry import quadrics, sampling
from gapr_core.results import RegistrationStatus

Array = NDArray[np.float64]

MOST_RAW_POINTS = 100_000  # more are drawn from at random before the even thinning


@dataclass(frozen=True)
class Unusable:
    """Why a source cannot give a pose, whatever the target."""

    status: RegistrationStatus
    reason: str


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
    """

    points: Array
    axes: Array
    flatness_mm: Array
    neighbours: NDArray[np.int64]
    order: NDArray[np.int64]
    spacing_mm: float

    @property
    def normals(self) -> Array:
        """(N, 3) unit normals of arbitrary sign."""
        return self.axes[:, 2]

    @property
    def noise_mm(self) -> float:
        """Roughness of the source alone: median distance of neighbours to their plane, mm."""
        return float(np.median(self.flatness_mm))

    def subset(self, count: int) -> Array:
        """(min(count, N), 3) of its points, spread over the whole cloud."""
        return self.points[self.order[:count]]


def prepare(source: ArrayLike, config: SourceConfig | None = None) -> PreparedSource | Unusable:
    """Clean, thin and describe a source (N, 3), mm.

    Returns:
        The prepared source, or why there is too little of it.

    Raises:
        InvalidPointCloudError: for a wrong shape or type, or an extent that cannot be a piece of a bone in mm.
    """
    config = config or SourceConfig()
    points = clouds.finite_points(source)
    if len(points) > MOST_RAW_POINTS:
        points = points[np.random.default_rng(0).choice(len(points), MOST_RAW_POINTS, replace=False)]
    points = np.unique(points, axis=0)
    if len(points) < config.fewest_points:
        return _too_few(f"{len(points)} distinct finite points, at least {config.fewest_points} are needed")
    extent_mm = float(np.linalg.norm(np.ptp(points, axis=0)))
    if extent_mm > clouds.EXTENT_LIMITS_MM[1] or extent_mm < 1.0:
        clouds.check_extent(extent_mm, "mm", "the source")
    if extent_mm < config.smallest_extent_mm:
        return _too_few(f"a source {extent_mm:.1f} mm across, at least {config.smallest_extent_mm:g} mm are needed")
    width_mm = float(np.sqrt(np.linalg.eigvalsh(np.cov(points.T))[1]))
    if width_mm < config.smallest_width_mm:
        return Unusable(RegistrationStatus.DEGENERATE, f"the source is a line: it spreads {width_mm:.1f} mm sideways")
    return _describe(points[sampling.thin(points, config.most_points)], config)


def _too_few(reason: str) -> Unusable:
    return Unusable(RegistrationStatus.TOO_FEW_POINTS, reason)


def _describe(points: Array, config: SourceConfig) -> PreparedSource:
    tree = cKDTree(points)
    neighbours = tree.query(points, k=min(config.normal_neighbours, len(points)))[1]
    frames = quadrics.local_frames(points, neighbours)
    lonely = np.linalg.norm(points - points[neighbours].mean(axis=1), axis=1) / np.linalg.norm(
        points[neighbours[:, -1]] - points, axis=1
    )
    return PreparedSource(
        points,
        frames.axes,
        frames.flatness_mm,
        neighbours,
        _spread_order(points, lonely),
        quadrics.spacing(points, tree),
    )


def _spread_order(points: Array, lonely: Array, spread: int = 512) -> NDArray[np.int64]:
    """Points in the middle of their neighbours first, farthest-point order among them; then the rest, shuffled."""
    trusted = np.flatnonzero(lonely <= np.quantile(lonely, 0.8))
    start = int(np.linalg.norm(points[trusted] - points[trusted].mean(axis=0), axis=1).argmin())
    first = trusted[sampling.farthest_points(points[trusted], spread, start)]
    rest = np.setdiff1d(np.arange(len(points)), first)
    return np.concatenate([first, np.random.default_rng(0).permutation(rest)])
