"""Each simulator on a ball, whose distances are known exactly."""

from functools import partial
from importlib import import_module

import numpy as np
import pytest
from scipy.spatial import cKDTree
from shapes import ball_specimen

from gapr_core.data import protocols
from gapr_core.data.sensors import SENSORS, SPARSE
from gapr_core.data.sensors.acquired import look
from gapr_core.data.sensors.pointer import pointer
from gapr_core.data.sensors.structured_light import _one_view
from gapr_core.geometry import se3

RADIUS = 60.0
CENTRE = np.array([300.0, -200.0, 900.0])


@pytest.fixture(scope="module")
def ball():
    return ball_specimen(RADIUS)


def heights(acquired, radius=RADIUS):
    return np.linalg.norm(acquired.points - CENTRE, axis=1) - radius


def drawn(simulate, ball, count=12):
    return [simulate(ball, np.random.default_rng(seed)) for seed in range(count)]


@pytest.mark.parametrize("name", list(SENSORS))
def test_the_same_seed_gives_the_same_cloud_and_the_parameters_are_stated(name, ball):
    first, again, other = (SENSORS[name](ball, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.points, again.points)
    assert first.points.shape != other.points.shape or np.abs(first.points - other.points).max() > 1.0
    assert first.parameters["family"] == name
    assert {"noise_mm", "bias", "bias_mm", "standoff_mm", "scale", "outlier_share"} <= set(first.parameters)


@pytest.mark.parametrize("name", list(SENSORS))
def test_a_sensor_sees_one_side(name, ball):
    for acquired in drawn(SENSORS[name], ball, 6):
        towards = np.asarray(acquired.parameters["view_direction"])
        assert ((acquired.points - CENTRE) @ towards > -0.1 * RADIUS).mean() > 0.97


def test_a_pointer_gives_12_to_200_points_that_lie_outside_by_the_standoff(ball):
    clouds = drawn(SENSORS["pointer"], ball, 24)
    assert {12 <= len(cloud.points) <= 200 for cloud in clouds} == {True}
    assert len({len(cloud.points) for cloud in clouds}) > 20
    off = np.array([np.median(heights(c)) - c.parameters["standoff_mm"] for c in clouds])
    assert abs(np.median(off)) < 0.1
    assert np.mean([c.parameters["standoff_mm"] for c in clouds]) > 0.3


def test_the_sparse_ones_are_fifty_dots_and_four_slices(ball):
    dots, strokes = (drawn(simulate, ball, 6) for simulate in (SPARSE["pointer_50"], partial(pointer, points=(50, 50))))
    assert {len(cloud.points) for cloud in dots + strokes} == {50}
    nearest = [[np.median(np.sort(np.linalg.norm(c.points[:, None] - c.points[None], axis=2), axis=1)[:, 1])
                for c in clouds] for clouds in (dots, strokes)]  # fmt: skip
    assert min(nearest[0]) > 3.0 and min(nearest[1]) < 1.5  # points of a stroke are in a row
    slices = [cloud.parameters["slices"] for cloud in drawn(SPARSE["ultrasound_4"], ball, 8)]
    assert max(slices) == np.median(slices) == 4  # one that misses the bone is left out


def test_a_pointer_strokes_in_rows(ball):
    clouds = [c for c in drawn(SENSORS["pointer"], ball, 24) if len(c.points) > 60]
    nearest = [np.sort(np.linalg.norm(c.points[:, None] - c.points[None], axis=2), axis=1)[:, 1] for c in clouds]
    assert min(np.median(gaps) for gaps in nearest) < 2.5  # dots alone would lie 5 mm apart and more


@pytest.fixture
def traced(ball, monkeypatch):
    """Clouds of a pointer that is dragged with the errors named, and without all others."""
    module = import_module("gapr_core.data.sensors.tracing")
    none = dict.fromkeys(("STANDOFF_MM", "LIFT_MM", "NOISE_MM", "TIP_MM", "GRIP_DEG"), (0.0, 0.0))

    def clouds(count=8, **errors):
        for name, limits in {**none, "BIAS_MM": 0.0, "IN_THE_AIR": 0.0, **errors}.items():
            monkeypatch.setattr(module, name, limits)
        return drawn(module.tracing, ball, count)

    return clouds


def test_a_dragged_pointer_gives_hundreds_of_samples_in_rows(traced):
    clouds = traced(24)
    counts = [len(cloud.points) for cloud in clouds]
    assert min(counts) >= 300 and max(counts) <= 4000 and len(set(counts)) > 20
    for cloud in clouds:
        steps = np.linalg.norm(np.diff(cloud.points[:-1], axis=0), axis=1)
        assert np.median(steps) < 2.0 and 1 < cloud.parameters["strokes"] < 0.1 * len(cloud.points)
        assert np.abs(heights(cloud)).max() < 0.3


def test_a_dragged_pointer_lies_outside_by_its_standoff(traced):
    for before, after in zip(traced(), traced(STANDOFF_MM=(0.7, 0.7)), strict=True):
        np.testing.assert_allclose(np.quantile(heights(after) - heights(before), (0.02, 0.98)), 0.7, atol=0.01)
        assert after.parameters["standoff_mm"] == pytest.approx(0.7)


def test_a_dragged_tip_is_lifted_for_a_while_and_not_sample_by_sample(traced):
    still, lifted, noisy = traced(), traced(LIFT_MM=(0.4, 0.4)), traced(NOISE_MM=(0.3, 0.3))
    for before, after, rough in zip(still, lifted, noisy, strict=True):
        lift, noise = heights(after) - heights(before), heights(rough) - heights(before)
        assert np.quantile(lift, 0.02) > -1e-3
        assert lift.mean() == pytest.approx(after.parameters["standoff_mm"], rel=0.3)
        assert np.corrcoef(lift[:-1], lift[1:])[0, 1] > 0.9
        assert noise.std() == pytest.approx(0.3, rel=0.1) and abs(np.corrcoef(noise[:-1], noise[1:])[0, 1]) < 0.2


def test_a_wrong_tip_shifts_a_whole_trace(traced):
    still, wrong = traced(), traced(TIP_MM=(0.5, 0.5))
    turned = traced(TIP_MM=(0.5, 0.5), GRIP_DEG=(20.0, 20.0))
    for before, after, gripped in zip(still, wrong, turned, strict=True):
        shift = after.points - before.points
        assert np.ptp(shift, axis=0).max() < 1e-9
        assert np.linalg.norm(shift[0]) == pytest.approx(after.parameters["tip_mm"])
        assert after.parameters["tip_mm"] > 0.1
        each = np.linalg.norm(gripped.points - before.points, axis=1)
        assert np.ptp(each) < 1e-9 and np.ptp(gripped.points - before.points, axis=0).max() > 0.05


def test_a_dragged_pointer_leaves_the_bone_in_runs(traced):
    for cloud in traced(IN_THE_AIR=0.3):
        off = heights(cloud) > 0.5
        assert off.mean() == pytest.approx(cloud.parameters["outlier_share"], abs=0.02)
        assert np.count_nonzero(np.diff(off.astype(int)) > 0) <= max(0.15 * off.sum(), 1)


def test_ultrasound_sees_the_bone_deeper_where_sound_is_slower_than_assumed(ball):
    too_high, depth_error = [], []
    for cloud in drawn(SENSORS["ultrasound"], ball, 16):
        drawn_speed = cloud.parameters["speed_of_sound"] - 1.0
        assert abs(drawn_speed) == pytest.approx(0.02, abs=0.0101)
        too_high.append(np.median(heights(cloud)) - cloud.parameters["thickness_mm"])
        depth_error.append(drawn_speed * (cloud.parameters["tissue_mm"] + 3.0))
        assert np.median(heights(cloud)) == pytest.approx(cloud.parameters["standoff_mm"], abs=0.2)
    assert np.corrcoef(too_high, depth_error)[0, 1] < -0.8


def test_ultrasound_points_lie_in_few_planes(ball):
    cloud = next(c for c in drawn(SENSORS["ultrasound"], ball, 12) if c.parameters["slices"] <= 8)
    gaps = np.sort(np.linalg.norm(cloud.points[:, None] - cloud.points[None], axis=2), axis=1)[:, 1]
    spread = np.sqrt(4.0 * np.pi * RADIUS**2 * cloud.parameters["share"] / len(cloud.points))
    assert np.median(gaps) < 0.6 * spread  # crowded within the slices, nothing between them


def test_a_depth_camera_is_noisy_along_its_rays_only(ball):
    cloud = next(c for c in drawn(SENSORS["depth_camera"], ball) if c.parameters["noise_mm"] > 0.7)
    rays = cloud.viewpoint - cloud.points
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    slant = np.einsum("ni,ni->n", rays, (cloud.points - CENTRE) / RADIUS)
    assert np.quantile(slant, 0.01) > 0.1  # what faces away is not seen
    frontal = np.abs(heights(cloud))[slant > 0.9]
    assert np.median(frontal) == pytest.approx(0.67 * cloud.parameters["noise_mm"], rel=0.6)


def test_a_depth_camera_throws_pixels_behind_the_rim(ball):
    cloud = max(drawn(SENSORS["depth_camera"], ball), key=lambda c: c.parameters["outlier_share"])
    rays = cloud.viewpoint - cloud.points
    distance = np.linalg.norm(rays, axis=1)
    from_axis = np.linalg.norm(np.cross(cloud.points - CENTRE, rays / distance[:, None]), axis=1)
    off = np.abs(heights(cloud)) > 4.0
    assert off.any()
    assert np.median(from_axis[off]) > np.median(from_axis[~off])


def test_a_laser_is_accurate_and_lights_stripes(ball):
    for cloud in drawn(SENSORS["laser"], ball, 8):
        expected = cloud.parameters["noise_mm"] + cloud.parameters["bias_mm"] + 0.15
        assert np.median(np.abs(heights(cloud))) < 1.5 * expected


@pytest.mark.parametrize("name", ["depth-camera", "laser"])
def test_the_viewpoint_of_a_pair_is_in_the_frame_of_its_source(name, ball):
    pair = protocols.make_pair(name, ball, 3)
    in_bone = se3.apply(pair.T_target_source, pair.metadata["viewpoint"][None])[0] + pair.metadata["origin_mm"]
    away = in_bone - CENTRE
    assert np.linalg.norm(away) > RADIUS + 50.0
    assert away @ pair.metadata["view_direction"] > 0.95 * np.linalg.norm(away)
    assert "viewpoint" not in protocols.make_pair("pointer", ball, 3).metadata


def test_structured_light_is_accurate_but_its_views_are_not_laid_on_each_other_exactly(ball):
    clouds = drawn(SENSORS["structured_light"], ball, 24)
    off = np.array([np.median(np.abs(heights(c))) for c in clouds])
    allowed = [sum(c.parameters[k] for k in ("noise_mm", "row_mm", "step_mm", "view_mm", "bias_mm")) for c in clouds]
    assert (off < np.array(allowed) + 0.1).all()
    several = np.array([c.parameters["views"] > 1 for c in clouds])
    apart = np.array([c.parameters["view_mm"] + c.parameters["view_deg"] for c in clouds])
    far, near = several & (apart > 0.5), several & (apart < 0.35)
    assert off[far].mean() > 1.3 * off[near].mean()


def test_the_depth_of_structured_light_comes_in_steps(ball):
    exact = {"row_mm": 0.0, "row_height_mm": 1.0, "noise_mm": 0.0, "step_mm": 2.0, "view_mm": 0.0, "view_deg": 0.0}
    view, rng = look(ball, (0.1, 0.1), "seen", 20_000, np.random.default_rng(0)), np.random.default_rng(1)
    points = _one_view(ball, view, np.zeros(len(view.points)), exact, 2000, rng)
    assert off_whole_steps(points, view.towards) < 0.02 < off_whole_steps(view.points[:2000], view.towards)


def off_whole_steps(points, towards):
    """0 where depths along some direction near this one lie at whole steps of 2 mm, 1 where they lie anywhere."""
    rng = np.random.default_rng(2)
    for spread in (0.3, 0.1, 0.03, 0.01, 0.003):
        tried = np.vstack([towards, towards + spread * rng.normal(size=(3000, 3))])
        tried /= np.linalg.norm(tried, axis=1, keepdims=True)
        together = np.abs(np.exp(1j * np.pi * (points @ tried.T)).mean(axis=0))
        towards = tried[together.argmax()]
    return 1.0 - together.max()


def test_stereo_makes_a_ridge_round(monkeypatch):
    module = import_module("gapr_core.data.sensors.stereo")
    for name, limits in {"NOISE_MM": (1e-9, 1e-9), "BIAS_MM": 0.0, "HOLES": (0, 0), "WINDOW_MM": (2.0, 2.0)}.items():
        monkeypatch.setattr(module, name, limits)
    for cloud in drawn(module.stereo, ball_specimen(20.0), 6):
        from_middle = (cloud.points - CENTRE) @ cloud.parameters["view_direction"]
        top = heights(cloud, 20.0)[from_middle > 0.95 * from_middle.max()]
        assert np.median(top) == pytest.approx(-(2.0**2) / 20.0, rel=0.3)  # the mean of a paraboloid over the window


def test_the_noise_of_stereo_is_that_of_patches(ball):
    clouds = [c for c in drawn(SENSORS["stereo"], ball, 24) if len(c.points) > 2500]
    cloud = next(c for c in clouds if c.parameters["window_mm"] > 2.5 and c.parameters["bias_mm"] < 0.4)
    off, towards = heights(cloud), np.asarray(cloud.parameters["view_direction"])
    across = cloud.points - np.outer(cloud.points @ towards, towards)  # near ones in space have the same noise anyway
    assert np.corrcoef(off, off[cKDTree(across).query(across, k=2)[1][:, 1]])[0, 1] > 0.5


def test_what_covers_a_bone_lies_above_it(ball):
    for cloud in drawn(SENSORS["covered"], ball, 12):
        p, off = cloud.parameters, heights(cloud)
        assert np.quantile(off, 0.02) > -(2.5 * p["noise_mm"] + p["bias_mm"] + 0.1)
        assert off.mean() == pytest.approx(p["standoff_mm"], abs=p["bias_mm"] + 0.15)
        assert off.max() < 4.0 + p["bias_mm"] + 5.0 * p["noise_mm"] + 0.1
    shares = [c.parameters["covered_share"] for c in drawn(SENSORS["covered"], ball, 24)]
    assert min(shares) < 0.3 and max(shares) > 0.7


def test_a_bone_that_moves_is_seen_at_its_mean_place(ball, monkeypatch):
    module = import_module("gapr_core.data.sensors.moving")
    for name, limits in {"NOISE_MM": (0.0, 0.0), "TURN_DEG": (0.0, 0.0), "BIAS_MM": 0.0, "CYCLES": (1.0, 1.0)}.items():
        monkeypatch.setattr(module, name, limits)
    monkeypatch.setattr(module, "SHIFT_MM", (0.0, 0.0))
    still = drawn(module.moving, ball, 8)
    monkeypatch.setattr(module, "SHIFT_MM", (5.0, 5.0))
    moved = drawn(module.moving, ball, 8)
    for before, after in zip(still, moved, strict=True):
        each = after.points - before.points
        assert np.abs(each.mean(axis=0)).max() < 1e-9
        assert np.linalg.norm(each, axis=1).max() == pytest.approx(5.0)
        assert np.linalg.matrix_rank(each, tol=1e-6) == 1
    assert max(np.abs(heights(each)).max() for each in still) < 0.3
