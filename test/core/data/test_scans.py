"""Bones as other scanners give them, on a ball whose true surface is known."""

import numpy as np
import pytest
from shapes import ball_specimen

from gapr_core.data import scans

RADIUS_MM = 30.0


@pytest.fixture(scope="module")
def ball():
    return ball_specimen(RADIUS_MM).surface


def off_mm(surface):
    """Distance of each vertex from the ball's true surface."""
    return np.linalg.norm(surface.points - [300.0, -200.0, 900.0], axis=1) - RADIUS_MM


def test_the_surface_of_voxels_lies_within_half_a_voxel_and_has_terraces(ball):
    size = np.array([2.0, 2.0, 4.0])
    terraces = scans.of_voxels(*size)(ball)
    assert np.abs(off_mm(terraces)).max() < 0.5 * np.linalg.norm(size) + 0.1
    steps = np.diff(np.unique(terraces.points[:, 2].round(3)))
    assert steps == pytest.approx(0.5 * size[2], abs=1e-3)  # corners at voxel centres and half-way, nowhere else
    assert terraces.to_open3d().get_volume() == pytest.approx(4.0 / 3.0 * np.pi * RADIUS_MM**3, rel=0.03)


def test_few_triangles_are_few_and_smoothing_shrinks(ball):
    coarse, smooth = scans.of_triangles(500)(ball), scans.smoothed(10)(ball)
    assert len(ball.triangles) > 2000 and len(coarse.triangles) == 500
    assert 0.0 < np.abs(off_mm(coarse)).max() < 1.0
    assert off_mm(smooth).mean() < -0.05


def test_a_size_is_a_factor(ball):
    assert scans.of_size(0.75)(ball).extent_mm == pytest.approx(0.75 * ball.extent_mm)


def test_a_drawn_scan_is_the_same_for_the_same_seed_and_of_both_kinds_over_many(ball):
    made = [scans.drawn(np.random.default_rng(seed))(ball) for seed in (*range(12), 0)]
    np.testing.assert_array_equal(made[0].points, made[-1].points)
    few = [len(surface.triangles) < 4000 and np.abs(off_mm(surface)).max() < 0.5 for surface in made]
    assert 1 <= sum(few) <= 8
