"""Hypotheses from small regions: where most of a cloud is not bone, a part of it may be nothing else.

Balls of several sizes around points that are spread over the cloud are sources of their own for the exhaustive search.
A ball on bone proposes the pose; which ball that is, the whole cloud decides later.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gapr_core.config import ClutterConfig, SearchConfig
from gapr_core.geometry import sampling
from gapr_core.registration.proposals.base import Proposals
from gapr_core.registration.proposals.search import NormalAlignedSearch
from gapr_core.registration.source import PreparedSource
from gapr_core.registration.target import PreparedTarget

Array = NDArray[np.float64]

SPREAD_OUT = 64  # points of a region that are spread evenly, before the others in the order of the whole cloud


@dataclass(frozen=True, eq=False)
class Region:
    """A part of a source that may be bone alone.

    Attributes:
        source: its points as a source of their own.
        centre: (3,) the point that it was grown from, mm, source frame.
    """

    source: PreparedSource
    centre: Array


def regions(source: PreparedSource, config: ClutterConfig, number: int = 0) -> list[Region]:
    """Balls of every size of the config around seeds that are spread over the source; others for every `number`."""
    tree = cKDTree(source.points)
    found = []
    for radius_mm, count in zip(config.radii_mm, config.seeds, strict=True):
        for seed in _seeds(source, count * (number + 1))[count * number :]:
            members = np.array(tree.query_ball_point(source.points[seed], radius_mm))
            if len(members) >= config.region_fewest_points:
                found.append(Region(_part(source, np.sort(members)), source.points[seed]))
    return found


def _seeds(source: PreparedSource, count: int) -> NDArray[np.int64]:
    start = int(np.linalg.norm(source.points - source.points.mean(axis=0), axis=1).argmin())
    return sampling.farthest_points(source.points, count, start)


def _part(source: PreparedSource, members: NDArray[np.int64]) -> PreparedSource:
    """Some of the points of a source, with what is known of them."""
    rank = np.empty(len(source.points), dtype=np.int64)
    rank[source.order] = np.arange(len(source.points))
    points = source.points[members]
    start = int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmin())
    first = sampling.farthest_points(points, SPREAD_OUT, start)
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


def search(region: Region, target: PreparedTarget, config: ClutterConfig) -> Proposals:
    """Hypotheses of one region."""
    few = SearchConfig(
        references=config.references,
        spins=config.spins,
        probes=config.probes,
        keep=config.keep,
        first_limit_mm=config.first_limit_mm,
    )
    return NormalAlignedSearch(few, num_threads=1).propose(region.source, target, np.random.default_rng(0))
