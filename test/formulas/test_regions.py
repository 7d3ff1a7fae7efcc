"""Regions of a scene: where a surface ends, which part of a segment is a region, and in which order they come."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from gapr_core.config import ClutterConfig, SourceConfig
from gapr_core.registration.problem import source as sources
from gapr_core.registration.proposals import regions

SPACING_MM = 2.0
CONFIG = ClutterConfig(radii_mm=(15.0,), seeds=(3,), rounds=4, region_fewest_points=20)


def in_degrees(angle_deg):
    """(3,) unit vector so far from z, towards x."""
    return np.array([np.sin(np.radians(angle_deg)), 0.0, np.cos(np.radians(angle_deg))])


@pytest.fixture
def joined(monkeypatch):
    """Whether two points are of one surface: the second 2 mm away at an elevation, the planes of both turned."""

    def ask(elevation_deg=0.0, normals_deg=(0.0, 0.0)):
        second = SPACING_MM * np.array([np.cos(np.radians(elevation_deg)), 0.0, np.sin(np.radians(elevation_deg))])
        both = SimpleNamespace(points=np.stack([np.zeros(3), second]), neighbours=np.array([[0, 1], [1, 0]]))
        normals = np.stack([in_degrees(angle) for angle in normals_deg])
        monkeypatch.setattr(regions, "fit_planes", lambda points, near: (normals, None, None))
        return bool(regions.smooth_neighbours(both, CONFIG)[0, 1])

    return ask


def sheet(columns, rows, corner=(0.0, 0.0, 0.0), tilt_deg=0.0):
    """A grid of points of 2 mm that rises towards x."""
    x, y = (axis.ravel() * SPACING_MM for axis in np.meshgrid(np.arange(columns), np.arange(rows)))
    tilt = np.radians(tilt_deg)
    return np.stack([x * np.cos(tilt), y, x * np.sin(tilt)], axis=1) + corner


def prepared(*sheets):
    """Sheets one after the other."""
    points = np.vstack(sheets) + np.random.default_rng(0).normal(0.0, 0.02, (sum(map(len, sheets)), 3))
    return sources.describe(points, SourceConfig(normal_neighbours=10))


def every(source, config=CONFIG):
    return [region for found in regions.rounds(source, config) for region in found]


def rows_of(region, source):
    """Which points of the source a region holds."""
    place = {tuple(point): k for k, point in enumerate(source.points)}
    return sorted(place[tuple(point)] for point in region.source.points)


@pytest.mark.parametrize(("angle_deg", "is_one"), [(19.0, True), (21.0, False), (159.0, False), (161.0, True)])
def test_neighbours_are_of_one_surface_up_to_an_angle_between_their_planes(joined, angle_deg, is_one):
    """Whichever way their normals point."""
    assert joined(normals_deg=(0.0, angle_deg)) is is_one


@pytest.mark.parametrize(("elevation_deg", "is_one"), [(-31.0, False), (-29.0, True), (29.0, True), (31.0, False)])
def test_neighbours_are_of_one_surface_up_to_a_step_off_their_planes(joined, elevation_deg, is_one):
    assert joined(elevation_deg) is is_one


@pytest.mark.parametrize("normals_deg", [(0.0, 15.0), (15.0, 0.0)])
def test_a_step_off_the_plane_of_either_neighbour_is_enough(joined, normals_deg):
    """The second point lies 20 degrees above one plane and 35 above the other."""
    assert not joined(20.0, normals_deg) and joined(10.0, normals_deg)


def test_planes_and_neighbours_are_of_so_many_points():
    source = prepared(sheet(10, 10))
    adjacency = regions.smooth_neighbours(source, ClutterConfig(smooth_neighbours=5))
    assert adjacency.shape == (100, 100) and set(np.asarray(adjacency.sum(axis=1)).ravel()) == {5.0}


def test_a_region_ends_at_a_fold_and_at_its_radius():
    source = prepared(sheet(15, 15, (-28.0, 0.0, 0.0)), sheet(15, 15, (2.0, 0.0, 1.0), tilt_deg=70.0))
    found = every(source)
    assert len(found) >= 6
    for region in found:
        sides = {k < 225 for k in rows_of(region, source)}
        assert len(sides) == 1
        assert np.linalg.norm(region.source.points - region.centre, axis=1).max() <= 15.0
    seen_of = {k < 225 for region in found for k in rows_of(region, source)}
    assert seen_of == {True, False}


def test_what_touches_the_seed_only_outside_of_the_ball_is_no_part_of_its_region():
    """Two strips 6 mm apart that meet 40 mm away: one segment, but not within a ball of 15 mm."""
    strips = prepared(sheet(25, 4), sheet(25, 4, (0.0, 12.0, 0.0)), sheet(4, 10, (50.0, 0.0, 0.0)))
    for region in every(strips):
        rows = rows_of(region, strips)
        both = min(rows) < 100 and any(100 <= k < 200 for k in rows)
        assert not both or any(k >= 200 for k in rows)


def test_segments_come_first_the_largest_at_their_head_and_none_that_is_too_small():
    source = prepared(sheet(8, 8), sheet(5, 5, (100.0, 0.0, 0.0)), sheet(4, 4, (0.0, 100.0, 0.0)))
    first = next(regions.rounds(source, CONFIG))
    assert [len(region.source.points) for region in first[:2]] == [64, 25]
    assert all(len(region.source.points) >= 20 for region in every(source))
    middle = source.points[:64].mean(axis=0)
    assert np.linalg.norm(first[0].centre - middle) == np.linalg.norm(source.points[:64] - middle, axis=1).min()


def test_rounds_bring_at_most_so_many_of_each_radius_and_no_region_twice():
    config = ClutterConfig(radii_mm=(10.0, 20.0), seeds=(4, 2), rounds=3, region_fewest_points=20)
    source = prepared(sheet(30, 30))
    found = list(regions.rounds(source, config))
    assert [len(each) for each in found] == [6, 6, 6]
    reach = [np.linalg.norm(r.source.points - r.centre, axis=1).max() for r in found[0]]
    assert max(reach[:4]) <= 10.0 < min(reach[4:]) <= max(reach) <= 20.0
    members = [tuple(rows_of(region, source)) for each in found for region in each]
    assert len(set(members)) == len(members)
    one_small_sheet = list(regions.rounds(prepared(sheet(5, 5)), CONFIG))
    assert [len(each) for each in one_small_sheet] == [1]
    assert list(regions.rounds(prepared(sheet(4, 4)), CONFIG)) == [[]]


def test_a_round_costs_seeds_where_others_grow_too_little_or_the_same(monkeypatch):
    """Three seeds are tried for each region that is asked for."""
    counts = []
    spread = regions.sampling.farthest_points
    monkeypatch.setattr(
        regions.sampling, "farthest_points", lambda p, n, start: counts.append(n) or spread(p, n, start)
    )
    source = prepared(sheet(12, 12))
    counts.clear()
    next(regions.rounds(source, CONFIG))
    assert counts[0] == 3 * 3 * 4 and all(a == regions.SPREAD_OUT for a, _ in pairwise(counts[1:]))
