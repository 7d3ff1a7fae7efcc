"""Every error of a simulator has the size and the direction that it states: one at a time, on a ball."""

from importlib import import_module

import numpy as np
import pytest
from shapes import ball_specimen

from gapr_core.data import views
from gapr_core.data.sensors import acquired, depth_maps
from gapr_core.data.sensors.pointer import pointer

structured_light = import_module("gapr_core.data.sensors.structured_light")  # the package has a function of that name
ultrasound = import_module("gapr_core.data.sensors.ultrasound")
RADIUS, CENTRE = 60.0, np.array([300.0, -200.0, 900.0])
NONE = {
    "depth_camera": {"NOISE_MM": (0.0, 0.0), "BIAS_MM": 0.0, "FLYING": 0.0},
    "laser": {"NOISE_MM": (0.0, 0.0), "BIAS_MM": 0.0, "OUTLIERS": 0.0, "SCALE": 0.0},
    "photogrammetry": {"NOISE_MM": (0.0, 0.0), "BIAS_MM": 0.0, "OUTLIERS": 0.0, "SCALE": 0.0, "BENT_MM": 0.0},
    "pointer": {"NOISE_MM": (0.0, 0.0), "BIAS_MM": 0.0, "ON_TISSUE": 0.0, "STANDOFF_MM": (0.0, 0.0)},
}


@pytest.fixture(scope="module")
def ball():
    return ball_specimen(RADIUS)


@pytest.fixture
def seen(ball, monkeypatch):
    """Clouds of one seed each of a simulator with the errors named, and without all others."""

    def clouds(name, count=4, **errors):
        module = import_module(f"gapr_core.data.sensors.{name}")
        for key, value in (NONE[name] | errors).items():
            monkeypatch.setattr(module, key, value)
        return [getattr(module, name)(ball, np.random.default_rng(seed)) for seed in range(count)]

    return clouds


@pytest.fixture
def view(ball):
    return acquired.look(ball, (0.2, 0.2), "seen", 6000, np.random.default_rng(3))


def shifts(before, after):
    """(N,) how far each point went towards the camera, and (N,) how far aside."""
    rays = before.viewpoint - before.points
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    moved = after.points - before.points
    along = np.einsum("ni,ni->n", moved, rays)
    return along, np.linalg.norm(moved - along[:, None] * rays, axis=1)


@pytest.mark.parametrize("name", ["depth_camera", "laser"])
def test_the_smooth_error_of_a_camera_is_towards_it_and_of_the_size_that_is_stated(seen, name):
    for before, after in zip(seen(name), seen(name, BIAS_MM=2.0), strict=True):
        along, aside = shifts(before, after)
        assert np.abs(along).max() > 0.3 * after.parameters["bias_mm"] > 0.0 and aside.max() < 1e-9


@pytest.mark.parametrize("distance_mm", [250.0, 500.0, 700.0])
def test_the_noise_of_a_depth_camera_grows_with_the_square_of_the_distance_and_with_the_slant(seen, distance_mm):
    at = {"DISTANCE_MM": (distance_mm, distance_mm)}
    for before, after in zip(seen("depth_camera", **at), seen("depth_camera", NOISE_MM=(1.0, 1.0), **at), strict=True):
        along, aside = shifts(before, after)
        to_camera, outward = before.viewpoint - before.points, (before.points - CENTRE) / RADIUS
        away_mm = np.linalg.norm(to_camera, axis=1)
        slant = np.clip(np.einsum("ni,ni->n", outward, to_camera) / away_mm, 0.15, 1.0)
        assert (along * np.sqrt(slant) / (away_mm / 500.0) ** 2).std() == pytest.approx(1.0, rel=0.1)
        stated = np.median((away_mm / 500.0) ** 2 / np.sqrt(slant))
        assert after.parameters["noise_mm"] == pytest.approx(stated, rel=0.02)
        assert aside.max() < 1e-9


def test_flying_pixels_lie_behind_the_bone(seen):
    for before, after in zip(seen("depth_camera"), seen("depth_camera", FLYING=1.0), strict=True):
        along, _ = shifts(before, after)
        flies = along != 0.0
        assert flies.mean() == pytest.approx(after.parameters["outlier_share"]) and flies.any()
        assert along[flies].max() <= -1.0 and along[flies].min() >= -20.0


@pytest.mark.parametrize("name", ["laser", "photogrammetry"])
def test_a_cloud_of_another_size_is_larger_by_the_scale_about_its_middle(seen, name):
    for before, after in zip(seen(name), seen(name, SCALE=0.05), strict=True):
        middle = before.points.mean(axis=0)
        assert abs(after.parameters["scale"] - 1.0) > 1e-3
        np.testing.assert_allclose(after.points, middle + after.parameters["scale"] * (before.points - middle))


def test_a_laser_lights_only_what_both_the_camera_and_the_emitter_see(ball, view, monkeypatch):
    laser = import_module("gapr_core.data.sensors.laser")
    monkeypatch.setattr(laser, "BASELINE_MM", (150.0, 150.0))
    viewpoint = view.points.mean(axis=0) + 150.0 * view.towards
    lit = view.only(laser._lit(ball, view, viewpoint, np.random.default_rng(0)))
    for eye in (viewpoint, viewpoint + 150.0 * acquired.tangents(view)[1]):
        assert (np.einsum("ni,ni->n", lit.outward, acquired.towards_viewpoint(lit.points, eye)) > 0.3).all()


def test_a_bent_cloud_sags_along_the_look_by_what_is_stated(seen):
    for before, after in zip(seen("photogrammetry"), seen("photogrammetry", BENT_MM=2.0), strict=True):
        towards, moved = np.asarray(after.parameters["view_direction"]), after.points - before.points
        assert np.ptp(moved @ towards) == pytest.approx(after.parameters["bent_mm"])
        assert after.parameters["bent_mm"] > 0.1
        assert np.abs(moved - np.outer(moved @ towards, towards)).max() < 1e-9


def test_a_tip_without_full_contact_stands_off_by_the_mean_of_a_half_normal(ball, seen):
    seen("pointer", count=0, CONTACT_MM=(1.0, 1.0))
    cloud = pointer(ball, np.random.default_rng(0), points=(5000, 5000), only_dots=True)
    heights = np.linalg.norm(cloud.points - CENTRE, axis=1) - RADIUS
    assert cloud.parameters["standoff_mm"] == pytest.approx(0.798, abs=1e-3)
    assert heights.mean() == pytest.approx(cloud.parameters["standoff_mm"], abs=0.1)  # facets lie within the ball


def test_each_point_of_structured_light_has_the_smooth_error_of_its_place(ball, view, monkeypatch):
    monkeypatch.setattr(structured_light, "SPREAD", 0.0)
    drawn = {"noise_mm": 0.0, "row_mm": 0.0, "step_mm": 1e-9, "row_height_mm": 1.0, "view_mm": 0.0, "view_deg": 0.0}
    slope = np.array([0.02, -0.01, 0.03])
    errors = (np.zeros(len(view.points)), view.points @ slope)
    before, after = (
        structured_light._one_view(ball, view, each, drawn, 400, np.random.default_rng(1)) for each in errors
    )
    np.testing.assert_allclose((after - before) @ view.towards, before @ slope, atol=1e-6)


QUIET = {"speed_of_sound": 1.0, "thickness_mm": 0.0, "axial_mm": 0.0, "lateral_mm": 0.0, "elevation_mm": 0.0,
         "tracking_mm": 0.0, "tracking_deg": 0.0, "tissue_mm": 10.0}  # fmt: skip


def image(view, bias_mm=0.0, **drawn):
    bias = np.full(len(view.points), bias_mm)
    return ultrasound._image(view.points, bias, view, QUIET | drawn, 0.0, np.random.default_rng(2)) - view.points


def test_a_smooth_error_and_a_thickness_lift_a_slice_out_of_the_bone_along_the_beam(view):
    assert np.abs(image(view)).max() < 1e-9
    for moved in (image(view, bias_mm=0.7), image(view, thickness_mm=0.7)):
        np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 0.7)
        assert (moved @ view.towards > 0.65).all()


def test_the_noise_of_a_slice_has_a_size_of_its_own_along_the_beam_across_and_along_the_way(view):
    along, across = acquired.tangents(view)
    directions = {"axial_mm": view.towards, "lateral_mm": across, "elevation_mm": along}
    for name, direction in directions.items():
        moved = image(view, **{name: 1.0})
        assert (moved @ direction).std() == pytest.approx(1.0, abs=0.05)
        assert np.linalg.norm(moved, axis=1).std() < 0.7  # in one direction alone: three would give more


def test_a_wrong_range_makes_a_cloud_larger_where_its_factor_is():
    range_of = depth_maps.Range(1.1, np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(range_of.of(np.array([[11.0, 2.0, 3.0]])), [[12.0, 2.0, 3.0]])


def test_normals_that_point_into_a_bone_are_turned_to_the_sensor(ball, monkeypatch):
    true_view = acquired.views.best_view

    def inwards(*arguments):
        points, normals, parameters = true_view(*arguments)
        return points, -normals, parameters

    monkeypatch.setattr(acquired.views, "best_view", inwards)
    found = acquired.look(ball, (0.2, 0.2), "seen", 3000, np.random.default_rng(0))
    assert (found.outward @ found.towards >= 0.0).all()


def test_a_band_follows_the_longer_way_of_what_is_seen_and_not_its_depth():
    """Of a plane that is seen at a slant, 100 mm long, 30 mm wide; its depth changes by as much as it is long."""
    rng = np.random.default_rng(0)
    flat = rng.uniform([-50.0, -30.0, 0.0], [50.0, 30.0, 0.0], (4000, 3))
    slope = flat + np.outer(flat[:, 1] * 6.0, [0.0, 0.0, 1.0])
    slope[0] = 0.0
    specimen = type("Open", (), {"visible_from": staticmethod(lambda points, _: np.ones(len(points), dtype=bool))})
    band = slope[views._band_seen(specimen, slope, np.array([0.0, 0.0, 1.0]), 0.1)]
    assert np.ptp(band[:, 0]) > 80.0 and np.ptp(band[:, 1]) < 10.0
