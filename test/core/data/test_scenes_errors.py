"""Scenes as other cameras see them: what each error does to a plate and a step, whose depths are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gapr_core.data.scenes import camera, errors
from gapr_core.data.sensors import depth_maps

CAMERA = np.array([0.0, 0.0, 500.0])
EXACT = {"PATCHY": (0.5, 0.5), "STEP_MM": (1e-6, 1e-6), "FLYING": (0.0, 0.0), "WET": (0, 0), "SMOOTH_MM": 0.0}


def plate(height=lambda at: np.zeros(len(at)), part=lambda at: np.zeros(len(at), dtype=int)):
    """A plate of 120 mm, seen from 500 mm, every 1.5 mm; `height` and `part` of places (N, 2)."""
    across = np.arange(-60.0, 60.5, 1.5)
    at = np.stack(np.meshgrid(across, across), axis=-1).reshape(-1, 2)
    points = np.column_stack([at, height(at)])
    return camera.View(points, part(at), CAMERA)


@pytest.fixture
def only(monkeypatch):
    """Switches every error off but those that are given."""

    def switch(noise_mm=0.0, scale=0.0, **given):
        for name, value in {**EXACT, **given}.items():
            monkeypatch.setattr(errors, name, value)
        monkeypatch.setattr(errors, "noise_mm", lambda depth: np.full(len(depth), noise_mm))
        monkeypatch.setattr(depth_maps, "RANGE", scale)

    return switch


def seen(view, seed=0):
    return errors.seen_in_stereo(view, np.random.default_rng(seed))


def off_mm(view):
    return view.points[:, 2] * 500.0 / np.linalg.norm(view.points - CAMERA, axis=1)


def test_without_errors_a_plate_stays_a_plate(only):
    only()
    found = seen(plate())
    assert len(found.points) == len(plate().points)
    inner = np.abs(found.points[:, :2]).max(axis=1) < 50.0  # at the rim windows are one-sided
    assert np.abs(found.points[inner, 2]).max() < 0.05
    assert (found.part == 0).all() and found.camera == pytest.approx(CAMERA)


def test_a_ridge_becomes_round(only):
    only(WINDOW_MM=(2.0, 2.0))
    found = seen(plate(lambda at: -np.abs(at[:, 0])))
    top = np.abs(plate().points[:, 0]) < 0.1
    assert np.median(found.points[top, 2]) == pytest.approx(-2.0 * np.sqrt(2.0 / np.pi), rel=0.25)  # E |x|, sigma 2


def test_the_noise_has_its_size_and_near_pixels_share_it(only):
    alike = {}
    for patchy in (0.0, 0.5, 1.0):
        only(noise_mm=1.0, PATCHY=(patchy, patchy), WINDOW_MM=(4.0, 4.0))
        found = off_mm(seen(plate()))
        assert found.std() == pytest.approx(1.0, rel=0.1)
        neighbours = cKDTree(plate().points).query(plate().points, k=2)[1][:, 1]
        alike[patchy] = np.corrcoef(found, found[neighbours])[0, 1]
    assert abs(alike[0.0]) < 0.1 and 0.4 < alike[0.5] < 0.6 and alike[1.0] > 0.8


def test_pixels_fly_only_along_an_edge_between_its_two_depths_and_are_on_no_surface(only):
    only(FLYING=(1.0, 1.0))
    step = plate(lambda at: np.where(at[:, 0] > 0.0, 0.0, -30.0), lambda at: (at[:, 0] > 0.0).astype(int))
    found = seen(step)
    flies = found.part == camera.NOTHING
    assert flies.any() and np.abs(step.points[flies, 0]).max() < 6.0
    assert found.points[flies, 2].min() > -31.0 and found.points[flies, 2].max() < 1.0
    assert ((found.points[flies, 2] > -25.0) & (found.points[flies, 2] < -5.0)).mean() > 0.3
    np.testing.assert_array_equal(found.part[~flies], step.part[~flies])
    only(FLYING=(1.0, 1.0), EDGE_MM=40.0)
    assert (seen(step).part >= 0).all()


def test_wet_spots_give_nothing(only):
    only(WET=(3, 3), WET_MM=(6.0, 6.0))
    found = seen(plate())
    assert 0.9 < len(found.points) / len(plate().points) < 0.99
    assert cKDTree(found.points).query(plate().points)[0].max() > 4.0


def test_depth_comes_in_steps(only):
    only(STEP_MM=(0.5, 0.5))
    depth = np.linalg.norm(seen(plate(lambda at: 0.1 * at[:, 0])).points - CAMERA, axis=1)
    np.testing.assert_allclose(depth / 0.5, np.round(depth / 0.5), atol=1e-6)


def test_in_the_theatre_there_are_layers_and_a_wrong_range_too_and_no_ray_turns(only, monkeypatch):
    only()
    monkeypatch.setattr(errors, "layers", lambda points, rng: np.full(len(points), 3.0))
    exact = errors.seen_in_theatre(plate(), np.random.default_rng(0))
    inner = np.abs(plate().points[:, :2]).max(axis=1) < 50.0
    np.testing.assert_allclose(off_mm(exact)[inner], 3.0, atol=0.05)
    only(scale=0.05)
    found = errors.seen_in_theatre(plate(), np.random.default_rng(0))
    factor = np.linalg.norm(found.points[-1] - found.points[0]) / np.linalg.norm(exact.points[-1] - exact.points[0])
    assert abs(factor - 1.0) > 0.005
    np.testing.assert_allclose(found.points - found.camera, factor * (exact.points - exact.camera))
    np.testing.assert_allclose(found.points.mean(axis=0), exact.points.mean(axis=0), atol=1e-9)
    assert errors.seen_in_stereo(plate(), np.random.default_rng(0)).camera == pytest.approx(CAMERA)


def test_the_smooth_error_is_of_its_size(only):
    only(SMOOTH_MM=2.0)
    inner = np.abs(plate().points[:, :2]).max(axis=1) < 50.0
    largest = [np.abs(off_mm(seen(plate(), seed))[inner]).max() for seed in range(6)]
    assert 0.3 < max(largest) < 6.0


def test_layers_lie_over_the_bone_alone_towards_the_camera(monkeypatch):
    monkeypatch.setattr(errors, "seen_in_depth", lambda view, rng: view)
    view = plate(part=lambda at: (at[:, 0] > 0.0).astype(int))
    found = errors.seen_on_layers(view, np.random.default_rng(2))
    above = np.linalg.norm(found.points - view.points, axis=1)
    assert above[view.part == 1].max() == 0.0
    assert 0.5 <= above.max() <= 4.0 and 0.05 < (above > 0.0).mean() < 0.5
    shift, sight = found.points - view.points, CAMERA - view.points
    assert (np.einsum("ni,ni->n", shift, sight) >= -1e-9).all()
    assert np.abs(np.cross(shift, sight)).max() < 1e-6


def test_by_default_the_bone_under_layers_has_the_noise_of_the_depth_too():
    view = plate(part=lambda at: np.ones(len(at), dtype=int))
    view = camera.View(view.points, np.append(np.zeros(10, dtype=int), view.part[10:]), view.camera)
    found = errors.seen_on_layers(view, np.random.default_rng(0))
    assert off_mm(found)[10:].std() == pytest.approx(0.75, rel=0.3)


def test_a_poor_camera_has_up_to_two_and_a_half_times_the_noise_alike_over_wider_windows(only, monkeypatch):
    only(noise_mm=0.5, PATCHY=(1.0, 1.0))
    asked = []
    windows = depth_maps.windows
    monkeypatch.setattr(depth_maps, "windows", lambda view, size_mm: asked.append(size_mm) or windows(view, size_mm))
    noise = [off_mm(errors.seen_by_a_poor_camera(plate(), np.random.default_rng(seed))).std() for seed in range(24)]
    assert 0.5 * 0.95 < min(noise) < 0.7 and 0.95 < max(noise) < 0.5 * 2.5 * 1.05
    assert 1.0 <= min(asked) < 1.8 and 4.0 < max(asked) <= 5.0
