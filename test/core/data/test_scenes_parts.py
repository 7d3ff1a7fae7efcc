"""The parts of a scene: camera and its errors, limb, openings, what lies around, and pairs made of other pairs."""

from __future__ import annotations

from functools import lru_cache, partial

import numpy as np
import pytest
from scipy.spatial import cKDTree
from shapes import ball_specimen

from gapr_core.data.protocols import make_pair
from gapr_core.data.scenes import camera, limb, things, wound
from gapr_core.geometry import se3
from gapr_core.surface import Surface

BALL_CENTRE = np.array([300.0, -200.0, 900.0])
PLATE = Surface(
    np.array([[-5e3, -5e3, 0], [5e3, -5e3, 0], [5e3, 5e3, 0], [-5e3, 5e3, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]])
)
made = lru_cache(partial(make_pair, seed=4))
ball = lru_cache(ball_specimen)


def wound_on_top(opening=lambda plane: np.hypot(*plane.T) < 30.0):
    return wound.Wound(BALL_CENTRE + [0.0, 0.0, 60.0], np.eye(3), 30.0, opening)


def spot(distance, count=4000):
    return camera.View(np.tile([0.0, 0.0, distance], (count, 1)), np.zeros(count, dtype=int), np.zeros(3))


@pytest.mark.parametrize(("distance", "sigma"), [(100.0, 0.412), (500.0, 0.7), (1000.0, 1.6)])
def test_the_noise_of_the_depth_grows_with_the_square_of_the_distance(distance, sigma):
    depth = camera.measured(spot(distance), np.random.default_rng(0))[:, 2]
    assert depth.std() == pytest.approx(sigma, rel=0.05)


def test_every_measured_point_stays_on_its_ray():
    rng = np.random.default_rng(1)
    view = camera.View(rng.uniform(-200, 200, (500, 3)), np.zeros(500, dtype=int), np.array([0.0, 0.0, 600.0]))
    clean, dirty = view.points - view.camera, camera.measured(view, rng) - view.camera
    assert np.abs(np.cross(clean, dirty)).max() / 600.0 < 1e-9
    assert np.abs(dirty - clean).max() > 0.5


def test_the_smooth_error_reaches_four_tenths_of_a_millimetre_and_is_smooth(monkeypatch):
    monkeypatch.setattr(camera, "NOISE_MM", 0.0)
    monkeypatch.setattr(camera, "NOISE_PER_MM", 0.0)
    at = np.arange(-150.0, 150.0, 2.0)
    points = np.stack([at, np.zeros_like(at), np.full_like(at, 500.0)], axis=1)
    view = camera.View(points, np.zeros(len(at), dtype=int), np.zeros(3))
    off = np.linalg.norm(camera.measured(view, np.random.default_rng(3)), axis=1) - np.linalg.norm(points, axis=1)
    assert np.abs(off).max() == pytest.approx(0.4)
    assert np.abs(np.diff(off)).max() < 2.0 * 0.4 * 4.0 * 2.0 * np.pi / 60.0 / 2.0


def test_the_image_is_480_by_480_of_60_degrees_about_the_point_looked_at():
    point, position = np.array([10.0, 20.0, 30.0]), np.array([200.0, -100.0, 400.0])
    seen_from = camera.looking_at(point, position, 0.7)
    rays = seen_from.rays().reshape(480, 480, 3)
    forward = (point - position) / np.linalg.norm(point - position)
    np.testing.assert_allclose(rays[239:241, 239:241].mean(axis=(0, 1)), forward, atol=1e-5)
    across = np.degrees(np.arccos(rays[240, 0] @ rays[240, -1]))
    assert across == pytest.approx(60.0, abs=0.3)
    np.testing.assert_allclose(seen_from.axes @ seen_from.axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(seen_from.axes) == pytest.approx(1.0)


def test_the_camera_turns_about_its_line_of_sight():
    point, position = np.zeros(3), np.array([0.0, 0.0, 400.0])
    first, second = (camera.looking_at(point, position, roll).axes for roll in (0.0, 0.5))
    assert first[0] @ second[0] == pytest.approx(np.cos(0.5))


@pytest.mark.parametrize(("cosine", "seen"), [(0.19, False), (0.21, True)])
def test_a_surface_is_seen_only_where_rays_meet_it_steeply(cosine, seen):
    slope = np.arccos(cosine)
    position = 500.0 * np.array([np.sin(slope), 0.0, np.cos(slope)])
    seen_from = camera.looking_at(np.zeros(3), position, 0.0)
    points = camera.see([PLATE], seen_from).points
    assert (len(points) > 0 and np.linalg.norm(points, axis=1).min() < 5.0) == seen


def test_what_is_nearer_hides_what_is_farther():
    above = Surface(PLATE.points * 0.01 + [0.0, 0.0, 100.0], PLATE.triangles)
    view = camera.see([PLATE, above], camera.looking_at(np.zeros(3), np.array([0.0, 0.0, 500.0]), 0.0))
    middle = np.hypot(view.points[:, 0], view.points[:, 1]) < 20.0
    assert (view.part[middle] == 1).all() and (view.part == 0).any()
    np.testing.assert_allclose(view.points[view.part == 0, 2], 0.0, atol=1e-3)


@pytest.mark.parametrize("growth", [12, 35])
def test_the_skin_lies_all_around_the_bone_at_the_thickness_of_the_tissue(growth):
    off = np.linalg.norm(limb.skin(ball(), growth).points - BALL_CENTRE, axis=1) - 60.0
    assert np.median(off) == pytest.approx(growth, abs=1.5)
    assert off.min() > growth - 4.0  # also no second skin inside the thick bone


def test_a_hole_is_cut_only_above_the_bone_and_only_in_the_opening():
    skin, place = limb.skin(ball(), 20), wound_on_top()
    left = wound.opened(skin, place)
    middles = place.local(left.points[left.triangles].mean(axis=1))
    beside = np.hypot(middles[:, 0], middles[:, 1])
    assert beside[middles[:, 2] > 0.0].min() >= 30.0
    assert beside[middles[:, 2] < 0.0].min() < 5.0  # the far side is whole
    assert np.isclose(len(skin.triangles) - len(left.triangles), len(skin.triangles) * 0.038, rtol=0.25)  # a cap


def test_a_packed_wound_has_walls_and_a_floor():
    specimen, place = ball(), wound_on_top()
    surface = limb.carved(specimen, 20, place, 10.0)
    local = place.local(surface.points)
    beside, height = np.hypot(local[:, 0], local[:, 1]), local[:, 2]
    assert not ((beside < 24.0) & (height > -5.0)).any()  # air
    assert ((np.abs(beside - 30.0) < 4.0) & (height > 0.0) & (height < 10.0)).sum() > 50  # walls
    assert ((beside < 24.0) & (np.abs(height + 10.0) < 3.0)).sum() > 50  # floor


def test_a_lobed_hole_keeps_about_its_radius_and_its_edge_varies():
    angle = np.linspace(-np.pi, np.pi, 360)
    inside = wound.lobed(50.0, np.random.default_rng(2))
    steps = np.arange(10.0, 90.0, 0.5)
    edge = np.array([steps[inside(np.outer(steps, [np.cos(a), np.sin(a)]))].max() for a in angle])
    assert edge.mean() == pytest.approx(50.0, rel=0.02)
    assert 2.0 < np.ptp(edge) and edge.max() < 50.0 * 1.48


def test_a_slit_is_long_and_narrow():
    inside = wound.slit(60.0, np.random.default_rng(0))
    at = np.arange(-90.0, 90.0, 0.5)
    zeros = np.zeros_like(at)
    length, width = (inside(np.stack(plane, axis=1)).sum() * 0.5 for plane in ((at, zeros), (zeros, at)))
    assert length == pytest.approx(120.0, abs=1.0) and 20.0 <= width <= 36.5


def test_two_windows_have_a_bridge_between_them():
    inside = wound.windows(60.0, np.random.default_rng(0))
    at = np.arange(-90.0, 150.0, 0.5)
    flags = inside(np.stack([at, np.zeros_like(at)], axis=1)).astype(int)
    assert (np.diff(flags) == 1).sum() == 2
    bridge = np.flatnonzero(np.diff(flags))[1:3]
    assert 8.0 <= np.diff(bridge)[0] * 0.5 <= 16.5


def test_a_cloth_covers_everything_but_its_hole():
    cloth = things.drape(wound_on_top(), 20.0, np.random.default_rng(0))
    hole = np.pi * (np.array([0.9, 1.5]) * 30.0) ** 2
    area = cloth.face_areas_mm2.sum()
    assert 500.0**2 - 1.3 * hole[1] < area < 1.1 * (500.0**2 - 0.7 * hole[0])


def test_a_retractor_is_a_flat_blade_of_the_sizes_stated():
    for seed in range(5):
        blade = things.retractor(wound_on_top(), 20.0, np.random.default_rng(seed))
        long, wide, thick = np.sort(np.linalg.svd(blade.points - blade.points.mean(axis=0))[1])[::-1] / np.sqrt(2.0)
        assert 60.0 <= long <= 140.0 and 8.0 <= wide <= 20.0 and thick == pytest.approx(3.0)
        assert blade.face_areas_mm2.sum() == pytest.approx(2.0 * (long * wide + wide * thick + thick * long))


@pytest.mark.parametrize(("protocol", "share"), [("L1-far10", 0.1), ("L2-far30", 0.3)])
def test_far_clutter_is_added_to_the_same_cloud(protocol, share):
    specimen = ball()
    clean, pair = made(protocol.partition("-")[0], specimen), made(protocol, specimen)
    is_bone = pair.metadata["is_bone"]
    assert (~is_bone).mean() == pytest.approx(share, abs=0.001)
    np.testing.assert_array_equal(np.sort(pair.source[is_bone], axis=0), np.sort(clean.source, axis=0))
    np.testing.assert_array_equal(pair.T_target_source, clean.T_target_source)
    far = se3.apply(pair.T_target_source, pair.source[~is_bone])
    assert cKDTree(pair.target).query(far)[0].min() >= 30.0 - 1e-6
    assert np.abs(far).max() > 200.0 and np.abs(far.mean(axis=0)).max() < 60.0  # all around, well beyond


def test_the_bone_alone_is_what_the_scene_shows_of_the_bone():
    scene, alone = made("scene-C2", ball()), made("scene-C2-bone", ball())
    np.testing.assert_array_equal(alone.source, scene.source[scene.metadata["is_bone"]])
    np.testing.assert_array_equal(alone.viewpoint, scene.viewpoint)
    assert alone.metadata["is_bone"].all() and len(alone.metadata["is_bone"]) == len(alone.source)


def test_ultrasound_shows_echoes_behind_the_bone_and_layers_before_it():
    pair = made("scene-ultrasound", ball())
    is_bone = pair.metadata["is_bone"]
    radius = np.linalg.norm(
        se3.apply(pair.T_target_source, pair.source) + pair.metadata["origin_mm"] - BALL_CENTRE, axis=1
    )
    assert np.median(np.abs(radius[is_bone] - 60.0)) < 3.0
    assert (radius[~is_bone] < 53.0).mean() > 0.1 and (radius[~is_bone] > 63.0).mean() > 0.1
    assert 0.5 < is_bone.mean() < 0.9 and pair.viewpoint is None
