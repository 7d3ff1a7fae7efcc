"""The intra-operative cloud, cleaned, thinned and described."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from gapr_core import clouds
from gapr_core.config import SourceConfig
from gapr_core.geometry import quadrics, sampling
from gapr_core.geometry.planes import fit_planes
from gapr_core.results import Refusal, RegistrationStatus

Array = NDArray[np.float64]
Found = tuple[Array, NDArray[np.int64]]  # distances and indices (N, k) of neighbours

SPREAD_OUT = 512  # evenly spread points at the head of the order
TRUSTED_SHARE = 0.8  # of the points most in the middle of their neighbours; the spread-out ones are among them
FAR_OUT = 4.0  # a point so many times the median distance from the middle is an outlier; the end of a bar has 2
CONTACT_MM = 1.0  # size of one contact, which a pointer at rest measures repeatedly
CROWD = 5, 5.0  # points kept of a contact: a number, or a multiple of those of a typical mm
SMALLEST_MM = 1.0  # extent below which a cloud is in metres, not too short a piece
SPARE_NEIGHBOURS = 6  # of a point, for means over neighbours on the bone


@dataclass(frozen=True, eq=False)
class PreparedSource:
    """A cleaned source."""

    points: Array  # (N, 3) mm, source frame: the points that are fitted and assessed
    normals: Array  # (N, 3) unit normals, of arbitrary sign unless `oriented`
    flatness_mm: Array  # (N,) root-mean-square distance of a point's neighbours to their plane
    around: NDArray[np.int64]  # (N, k) indices of each point's nearest, itself first, a few more than give a normal
    whole: Array  # (M, 3) mm, the cloud that `points` are drawn from: `patches` index it, and the network sees it
    patches: NDArray[np.int64]  # (N, k) indices into `whole` of the points that gave each normal
    order: NDArray[np.int64]  # (N,) indices whose every prefix is spread over the whole cloud, trustworthy points first
    spacing_mm: float  # median distance between neighbouring points of the whole
    oriented: bool = False  # the normals point out of the body, towards the sensor, so their sign has a meaning

    @property
    def is_part(self) -> bool:
        """True where only some points of the whole are fitted."""
        return len(self.points) < len(self.whole)

    @property
    def neighbours(self) -> NDArray[np.int64]:
        """(N, k) indices of each point's nearest points that give a normal, itself first."""
        return self.around[:, : self.patches.shape[1]]

    def axes(self, chosen: NDArray[np.int64]) -> Array:
        """Compute (K, 3, 3) local frames of the chosen (K,) points; rows are two tangents and the unit normal."""
        axes = quadrics.local_frames(self.whole, self.patches[chosen]).axes
        if not self.oriented:
            return axes
        away = np.einsum("ni,ni->n", axes[:, 2], self.normals[chosen]) < 0.0
        return np.asarray(axes * np.where(away[:, None], [1.0, -1.0, -1.0], 1.0)[..., None])

    def facing(self, viewpoint: Array) -> PreparedSource:
        """Turn the normals to the viewpoint, mm, (3,) or one for each point (N, 3)."""
        away = np.einsum("ni,ni->n", self.normals, viewpoint - self.points) < 0.0
        return replace(self, normals=self.normals * np.where(away, -1.0, 1.0)[:, None], oriented=True)

    def subset(self, count: int) -> Array:
        """Return (min(count, N), 3) of its points, spread over the whole cloud."""
        return self.points[self.order[:count]]


def prepare(
    source: ArrayLike, config: SourceConfig | None = None, num_threads: int = 1, in_scene: bool = False
) -> PreparedSource | Refusal:
    """Clean, thin and describe a source.

    Args:
        source: (N, 3), mm.
        config: sizes of the cleaning and the thinning.
        num_threads: 0 for all cores.
        in_scene: all points are fitted, since few of them may be bone; else `config.fitted_points` of them at most.

    Returns:
        The prepared source, or the refusal of too small a one.

    Raises:
        InvalidPointCloudError: for a wrong shape or type, or an extent that cannot be a piece of a bone in mm.
    """
    config = config or SourceConfig()
    points = clouds.finite_points(source)
    if len(points) > config.most_raw_points:  # before they are sorted, which takes longer
        points = points[_drawn(points, config.most_raw_points)]
    points = sampling.distinct(points)
    if len(points):
        points = sampling.without_crowds(points, CONTACT_MM, *CROWD)
    if len(points) > config.fitted_points and not in_scene:
        return _some_of(points, config, num_threads)
    points, found = _looked_up(points, config, num_threads)
    refusal = _too_little(points, config)
    if refusal is not None:
        return refusal
    if found is None:
        points = points[sampling.thin(points, config.most_points)]
    return describe(points, config, found, num_threads)


def _some_of(points: Array, config: SourceConfig, num_threads: int) -> PreparedSource | Refusal:
    """Draw `fitted_points` of many points (N, 3), mm, at random; neighbours among all give their normals.

    Not evenly spread: some stay so near to each other that shared errors of near residuals show (`roughness`).
    """
    is_clean = len(points) <= config.most_points and not _has_outliers(points)
    whole = points if is_clean else without_isolated(points, config)
    if len(whole) > config.most_points:
        whole = whole[sampling.thin(whole, config.most_points)]
    some = whole[_drawn(whole, config.fitted_points)]
    k = _neighbour_count(len(whole), config)
    gaps, near = quadrics.nearest(some, max(k, config.companions + 1), cKDTree(whole), num_threads)
    if len(whole) >= max(config.dense_points, config.companions + 1):
        stays = _has_companions(gaps[:, config.companions], config)
        some, gaps, near = some[stays], gaps[stays], near[stays]
    refusal = _too_little(some, config)
    if refusal is not None:
        return refusal
    around = quadrics.nearest(some, _around_count(len(some), config), num_threads=num_threads)[1]
    return _described(some, around, gaps[:, :k], whole, np.ascontiguousarray(near[:, :k]))


def _drawn(points: Array, most: int) -> NDArray[np.int64]:
    """Draw at most `most` of the points (N, 3) at random, ascending: the same in every frame."""
    away = points - points.mean(axis=0)
    by_distance = np.argsort(np.einsum("ni,ni->n", away, away))
    chosen = np.random.default_rng(0).choice(len(points), min(most, len(points)), replace=False)
    return np.asarray(np.sort(by_distance[chosen]))


def _too_little(points: Array, config: SourceConfig) -> Refusal | None:
    """Refuse points (N, 3), mm, that are too few or a line; raise for an impossible extent."""
    if len(points) < config.fewest_points:
        return Refusal(
            RegistrationStatus.TOO_FEW_POINTS,
            f"{len(points)} distinct finite points, at least {config.fewest_points} are needed",
        )
    extent_mm = float(np.linalg.norm(np.ptp(points, axis=0)))
    if extent_mm > clouds.EXTENT_LIMITS_MM[1] or extent_mm < SMALLEST_MM:
        clouds.check_extent(extent_mm, "mm", "the source")
    width_mm = float(np.sqrt(max(np.linalg.eigvalsh(np.cov(points.T))[1], 0.0)))  # of a line -1e-13 or so
    if width_mm < config.smallest_width_mm:
        return Refusal(RegistrationStatus.DEGENERATE, f"the source is a line: it spreads {width_mm:.1f} mm sideways")
    return None


def without_isolated(points: Array, config: SourceConfig) -> Array:
    """Remove points that are far from all others (N, 3), mm: far echoes, flying pixels.

    Open3D's `remove_radius_outlier` with a radius that follows the spacing. A sparse cloud stays as it is.
    """
    if len(points) < config.dense_points:
        return points
    some = points[:: -(-len(points) // config.most_compared)]
    return points[_has_companions(cKDTree(some).query(points, k=config.companions + 1)[0][:, -1], config)]


def _has_outliers(points: Array) -> bool:
    """Return True where one of the points (N, 3) is far enough from most to change the cloud's extent."""
    away = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return bool(away.max() > FAR_OUT * np.median(away))


def _has_companions(gaps: Array, config: SourceConfig) -> NDArray[np.bool_]:
    """Mark the points that are not isolated, from the distances (N,), mm, to the last companion of each."""
    return gaps <= max(config.isolated_mm, config.isolated_gaps * float(np.median(gaps)))


def _looked_up(points: Array, config: SourceConfig, num_threads: int) -> tuple[Array, Found | None]:
    """Remove isolated points and keep the neighbours of the others where one look-up gives both, else None."""
    count = _around_count(len(points), config)
    if not config.dense_points <= len(points) <= min(config.most_points, config.most_compared):
        return without_isolated(points, config), None
    if config.companions >= count:
        return without_isolated(points, config), None
    gaps, around = quadrics.nearest(points, count, num_threads=num_threads)
    stays = _has_companions(gaps[:, config.companions], config)
    if stays.all():
        return points, (gaps, around)
    if _around_count(int(stays.sum()), config) != count:
        return points[stays], None
    points, number = points[stays], np.cumsum(stays) - 1
    lost = ~np.asarray(stays[around].all(axis=1))[stays]
    gaps, around = gaps[stays], number[around[stays]]
    gaps[lost], around[lost] = cKDTree(points).query(points[lost], k=count)
    return points, (gaps, around)


def describe(points: Array, config: SourceConfig, found: Found | None = None, num_threads: int = 1) -> PreparedSource:
    """Describe points (N, 3), mm, that are clean and thin already; `found` are their neighbours, where known."""
    gaps, around = found or quadrics.nearest(points, _around_count(len(points), config), num_threads=num_threads)
    patches = np.ascontiguousarray(around[:, : _neighbour_count(len(points), config)])
    return _described(points, around, gaps[:, : patches.shape[1]], points, patches)


def _described(
    points: Array, around: NDArray[np.int64], gaps: Array, whole: Array, patches: NDArray[np.int64]
) -> PreparedSource:
    """Describe points (N, 3) by their patches (N, k) of the whole (M, 3), whose distances are `gaps` (N, k)."""
    normals, flatness_mm, means = fit_planes(whole, patches)
    isolation = np.linalg.norm(points - means, axis=1) / np.maximum(gaps[:, -1], 1e-9)
    order, spacing_mm = _spread_order(points, isolation), float(np.median(gaps[:, 1]))
    return PreparedSource(points, normals, flatness_mm, around, whole, patches, order, spacing_mm)


def _neighbour_count(count: int, config: SourceConfig) -> int:
    """Choose the number of points for a normal: a quarter of few points, so that a patch stays local."""
    return min(config.normal_neighbours, max(count // 4, config.fewest_points), count)


def _around_count(count: int, config: SourceConfig) -> int:
    """Choose the number of neighbours to look up: a few spare ones, since some may not be bone."""
    return min(_neighbour_count(count, config) + SPARE_NEIGHBOURS, count)


def _spread_order(points: Array, isolation: Array) -> NDArray[np.int64]:
    """Order points: those in the middle of their neighbours by farthest-point order, then the rest, shuffled."""
    trusted = np.flatnonzero(isolation <= np.quantile(isolation, TRUSTED_SHARE))
    start = int(np.linalg.norm(points[trusted] - points[trusted].mean(axis=0), axis=1).argmin())
    spread_out = sampling.farthest_points(points[trusted], SPREAD_OUT, start)
    first = trusted[spread_out[np.sort(np.unique(spread_out, return_index=True)[1])]]  # some may lie on each other
    is_rest = np.ones(len(points), dtype=bool)
    is_rest[first] = False
    rest = np.flatnonzero(is_rest)
    return np.concatenate([first, np.random.default_rng(0).permutation(rest)])
