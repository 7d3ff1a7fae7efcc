"""Hypotheses from small regions: where most of a cloud is not bone, a part of it may be bone alone.

The cloud is cut into segments where its surface bends or steps, as at the rim of a wound (smoothness constraint:
Rabbani, van den Heuvel, Vosselman 2006). The parts of a segment within balls of several sizes are sources of their own
for the exhaustive search.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from gapr_core.config import ClutterConfig, SearchConfig
from gapr_core.geometry import sampling
from gapr_core.geometry.planes import fit_planes
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.proposals.search import NormalAlignedSearch

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

SPREAD_OUT = 64  # evenly spread points of a region, before the others in the order of the whole cloud
TRIES = 3  # seeds for each requested region, since some grow too small a region or a copy of another


@dataclass(frozen=True, eq=False)
class Region:
    """A part of a source that may be bone alone."""

    source: PreparedSource  # its points as a source of their own
    centre: Array  # (3,) its seed, mm, source frame


def rounds(source: PreparedSource, config: ClutterConfig) -> Iterator[list[Region]]:
    """Yield the regions of each round, at most `config.seeds` of each radius, without repetition.

    There is a first round, even an empty one; the rounds end where nothing more grows.
    """
    joined, tree = smooth_neighbours(source, config), cKDTree(source.points)
    seeds = _seeds(source, joined, TRIES * max(config.seeds) * config.rounds, config.region_fewest_points)
    growing = [_grown(source, tree, joined, seeds, radius_mm, config) for radius_mm in config.radii_mm]
    for number in range(config.rounds):
        sizes = zip(growing, config.seeds, strict=True)
        found = [region for grown, count in sizes for region in islice(grown, count)]
        if number and not found:
            return
        yield found


def smooth_neighbours(source: PreparedSource, config: ClutterConfig) -> csr_array:
    """Build the (N, N) adjacency of neighbours with agreeing normals of few points, each near the other's plane."""
    near = np.ascontiguousarray(source.neighbours[:, : config.smooth_neighbours])
    normals, _, _ = fit_planes(source.points, near)
    one, other = np.repeat(np.arange(len(near)), near.shape[1]), near.ravel()
    apart = source.points[other] - source.points[one]
    agree = np.abs(np.einsum("ni,ni->n", normals[one], normals[other]))
    off = [np.abs(np.einsum("ni,ni->n", normals[of], apart)) for of in (one, other)]
    flat = np.maximum(*off) <= np.sin(np.radians(config.step_deg)) * np.linalg.norm(apart, axis=1)
    joined = flat & (agree > np.cos(np.radians(config.bend_deg)))
    return csr_array((np.ones(int(joined.sum())), (one[joined], other[joined])), shape=2 * (len(near),))


def _grown(
    source: PreparedSource, tree: cKDTree, joined: csr_array, seeds: Indices, radius_mm: float, config: ClutterConfig
) -> Iterator[Region]:
    """Grow a region from every seed: the part of its segment within a ball, if large enough and new."""
    known = set()
    for seed in seeds:
        ball = np.sort(tree.query_ball_point(source.points[seed], radius_mm))
        if len(ball) < config.region_fewest_points:
            continue
        _, segment = connected_components(joined[ball][:, ball], directed=False)
        members = ball[segment == segment[np.searchsorted(ball, seed)]]
        if len(members) >= config.region_fewest_points and members.tobytes() not in known:
            known.add(members.tobytes())
            yield Region(_part(source, members), source.points[seed])


def _seeds(source: PreparedSource, joined: csr_array, count: int, fewest: int) -> Indices:
    """Choose the middle of every segment, the largest first; then points that are spread over the source."""
    _, segment = connected_components(joined, directed=False)
    sizes = np.bincount(segment)
    large = [k for k in np.argsort(-sizes, kind="stable") if sizes[k] >= fewest]
    middles = [_middle(source.points, np.flatnonzero(segment == k)) for k in large]
    everywhere = np.arange(len(source.points))
    spread = sampling.farthest_points(source.points, count, _middle(source.points, everywhere))
    return np.concatenate([np.array(middles, dtype=np.int64), spread])


def _middle(points: Array, some: Indices) -> int:
    """Find the point nearest to the mean of some of the points."""
    return int(some[np.linalg.norm(points[some] - points[some].mean(axis=0), axis=1).argmin()])


def _part(source: PreparedSource, members: Indices) -> PreparedSource:
    """Cut some of the points out of a source, with everything known of them."""
    rank = np.empty(len(source.points), dtype=np.int64)
    rank[source.order] = np.arange(len(source.points))
    points = source.points[members]
    first = sampling.farthest_points(points, SPREAD_OUT, _middle(points, np.arange(len(points))))
    rest = np.setdiff1d(np.arange(len(points)), first)
    order = np.concatenate([first, rest[np.argsort(rank[members[rest]])]])
    return replace(
        source,
        points=points,
        normals=source.normals[members],
        flatness_mm=source.flatness_mm[members],
        around=np.empty((len(points), 0), dtype=np.int64),
        patches=source.patches[members],
        order=order,
    )


def search(region: Region, target: PreparedTarget, config: ClutterConfig) -> Array:
    """Search hypotheses (K, 4, 4) of one region."""
    few = SearchConfig(
        references=config.references,
        spins=config.spins,
        probes=config.probes,
        keep=config.keep,
        first_limit_mm=config.first_limit_mm,
    )
    return NormalAlignedSearch(few, num_threads=1).propose(region.source, target, np.random.default_rng(0))
