"""Where a camera was, from the pixels of its own cloud: pinhole images in any frame, and clouds that are none."""

import numpy as np
import pytest

from gapr_core.geometry import pinhole, se3

T = se3.from_rotation_translation(se3.exp([0, 0, 0, 0.4, -1.1, 2.0])[:3, :3], [120.0, -2000.0, 700.0])
CAMERA = T[:3, 3]


def image(height=60, width=80, focal=90.0, distortion=0.0, noise_mm=1.0, relief_mm=40.0):
    """(H, W, 3) mm, camera frame: a wavy surface 450 mm away; noise of depth moves points along their rays."""
    row, column = np.mgrid[:height, :width]
    x, y = (column - 0.45 * width) / focal, (row - 0.55 * height) / focal
    bent = 1.0 + distortion * (x * x + y * y)
    depth = 450.0 + relief_mm * np.sin(9.0 * x) * np.cos(7.0 * y)
    depth += noise_mm * np.random.default_rng(0).normal(size=depth.shape)
    return np.stack([bent * x * depth, bent * y * depth, depth], axis=2)


def moved(grid):
    return se3.apply(T, grid.reshape(-1, 3)).reshape(grid.shape)


def test_an_image_shows_its_camera_in_any_frame():
    np.testing.assert_allclose(pinhole.centre_of(image()), 0.0, atol=1e-6)
    np.testing.assert_allclose(pinhole.centre_of(moved(image())), CAMERA, atol=1e-6)
    np.testing.assert_allclose(pinhole.centre_of(moved(image()) / 1000.0), CAMERA / 1000.0, atol=1e-9)
    np.testing.assert_allclose(pinhole.centre_of(moved(image()).transpose(1, 0, 2)), CAMERA, atol=1e-6)


def test_pixels_without_a_point_and_single_precision_change_little():
    grid = moved(image()).astype(np.float32)
    nothing = np.random.default_rng(1).random(grid.shape[:2])
    grid[nothing < 0.3], grid[nothing > 0.7] = np.nan, 0.0
    np.testing.assert_allclose(pinhole.centre_of(grid), CAMERA, atol=0.01)


def test_a_part_of_the_image_is_enough_and_a_large_one_is_thinned():
    part = np.full((480, 640, 3), np.nan)
    part[200:260, 300:380] = moved(image())
    np.testing.assert_allclose(pinhole.centre_of(part), CAMERA, atol=1e-6)
    np.testing.assert_allclose(pinhole.centre_of(moved(image(480, 640, 700.0))), CAMERA, atol=1e-6)


def test_a_lens_that_bends_little_costs_little_and_one_that_bends_much_is_no_pinhole():
    assert 1.0 < np.linalg.norm(pinhole.centre_of(image(240, 320, 300.0, distortion=0.05))) < 15.0
    assert pinhole.centre_of(image(240, 320, 300.0, distortion=0.3)) is None


def line_scanner():
    """Each row by itself a camera that moved on."""
    grid = image()
    grid[..., 1] = 0.5 * np.arange(len(grid))[:, None]
    return grid


def parallel_slices():
    """Tracked slices of a probe, one a row: parallel lines of sight."""
    grid = image()
    grid[..., 0], grid[..., 1] = np.arange(grid.shape[1]), np.arange(grid.shape[0])[:, None]
    return grid


def turning_scanner():
    """A lidar: rows and columns are angles."""
    azimuth, elevation = (np.radians(0.8 * np.arange(n) - 0.4 * n) for n in (80, 60))
    azimuth, elevation = np.meshgrid(azimuth, elevation)
    sight = [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
    return np.stack(sight, axis=2) * image()[..., 2:]


def in_no_order():
    grid = image()
    return np.random.default_rng(2).permutation(grid.reshape(-1, 3)).reshape(grid.shape)


@pytest.mark.parametrize("cloud", [line_scanner, parallel_slices, turning_scanner, in_no_order])
def test_what_is_no_image_of_a_pinhole_has_no_camera(cloud):
    assert pinhole.centre_of(moved(cloud())) is None


def test_too_few_points_one_row_or_column_and_an_empty_cloud_say_nothing():
    few = np.full((60, 80, 3), np.nan)
    few[20:30, 20:39] = image()[20:30, 20:39]
    assert pinhole.centre_of(few) is None
    few[20:30, 39] = image()[20:30, 39]
    np.testing.assert_allclose(pinhole.centre_of(few), 0.0, atol=1e-6)
    assert pinhole.centre_of(image().reshape(1, -1, 3)) is None
    assert pinhole.centre_of(image().reshape(-1, 1, 3)) is None
    assert pinhole.centre_of(np.empty((0, 0, 3))) is None


def test_bytes_that_are_no_coordinates_and_points_that_are_one_are_no_image():
    huge, tiny, one = 1e200 * image(), 1e-300 * image(), np.ones((60, 80, 3))
    for grid in (
        huge,
        tiny,
        one,
        np.full((60, 80, 3), 1.7e308),
        np.full((60, 80, 3), np.inf),
        np.full((60, 80, 3), 5e-324),
    ):
        assert pinhole.camera_of(grid) is None and pinhole.camera_of(grid.reshape(-1, 3)) is None
    some = image()
    some[::9] = 1e200
    np.testing.assert_allclose(pinhole.centre_of(some), 0.0, atol=1e-6)


def test_a_plane_could_have_been_seen_from_anywhere():
    """Only the disagreement of parts of it refuses: every one of its cameras fits."""
    assert pinhole.centre_of(moved(image(noise_mm=0.0, relief_mm=0.0)).astype(np.float32)) is None


def test_a_misfit_alone_refuses(monkeypatch):
    rough = image() + 8.0 * np.random.default_rng(3).normal(size=(60, 80, 3)) * [1.0, 1.0, 0.0]
    monkeypatch.setattr(pinhole, "LARGEST_DISAGREEMENT", 1e9)
    assert pinhole.centre_of(rough) is None
    monkeypatch.setattr(pinhole, "LARGEST_MISFIT", 1e9)
    assert pinhole.centre_of(rough) is not None


def in_a_row(grid):
    """Its points in any order, in metres and single precision, as drivers send them."""
    return np.random.default_rng(4).permutation(grid.reshape(-1, 3)).astype(np.float32) / np.float32(1000.0)


def test_points_in_any_order_show_that_their_camera_is_in_the_origin_and_nowhere_else():
    cloud = in_a_row(image())
    assert pinhole.is_centre_of(cloud) and pinhole.is_centre_of(cloud[:, [2, 0, 1]]), "x may be along the view, too"
    assert pinhole.is_centre_of(np.round(cloud, 6)), "as text files have them"
    assert not pinhole.is_centre_of(cloud + np.float32([0.02, 0.0, 0.0]))
    assert not pinhole.is_centre_of(in_a_row(moved(image()) - CAMERA)), "the axes are not those of the image"


@pytest.mark.parametrize("axis", [0, 1])
def test_few_columns_alone_or_few_rows_alone_are_no_image(axis):
    grid = image()
    grid[..., axis] += np.random.default_rng(5).normal(size=grid.shape[:2])
    assert not pinhole.is_centre_of(in_a_row(grid))


def test_few_points_points_behind_the_camera_and_lattices_show_nothing():
    cloud = in_a_row(image())
    assert pinhole.is_centre_of(cloud[:1000]) and not pinhole.is_centre_of(cloud[:999])
    assert not pinhole.is_centre_of(np.empty((0, 3)))
    some_behind = cloud.copy()
    some_behind[::2] *= -1.0
    assert not pinhole.is_centre_of(some_behind)
    heights = image()
    heights[..., :2] = np.stack(np.mgrid[:60, :80], axis=2)
    heights[..., 2] = np.round(heights[..., 2] / 20.0)
    assert not pinhole.is_centre_of(heights.reshape(-1, 3)), "coordinates that are few themselves are no lines of sight"
    assert not pinhole.is_centre_of(in_a_row(image(noise_mm=0.0, relief_mm=0.0))), "a plane across the view"


@pytest.mark.parametrize(("count", "half_mm", "away_mm"), [(30_000, 60.0, 3000.0), (5000, 60.0, 100_000.0)])
def test_lines_of_sight_that_are_one_only_since_they_are_rounded_show_no_camera(count, half_mm, away_mm):
    """A dense cloud, or one far from the origin of a tracker's frame: its sights fill the few steps across the view."""
    points = np.random.default_rng(6).uniform(-half_mm, half_mm, (count, 3)) + [0.0, 0.0, away_mm]
    steps = np.round(points[:, :2] / points[:, 2:] / pinhole.SAME_SIGHT)
    assert min(len(np.unique(column)) for column in steps.T) * pinhole.FEWEST_A_SIGHT < count
    assert not pinhole.is_centre_of(points)
    fine = np.random.default_rng(4).permutation(image(300, 300, 8000.0).reshape(-1, 3))
    assert pinhole.is_centre_of(fine), "a camera of 8000 pixels along its focal length"


def test_rows_and_columns_say_more_than_the_origin_and_the_origin_more_than_nothing():
    grid = image()
    points = grid.reshape(-1, 3)
    np.testing.assert_allclose(pinhole.camera_of(moved(grid)), CAMERA, atol=1e-6)
    np.testing.assert_array_equal(pinhole.camera_of(points), np.zeros(3))
    np.testing.assert_array_equal(pinhole.camera_of(points[None]), np.zeros(3), "one row says nothing itself")
    assert pinhole.camera_of(points + 7.0) is None and pinhole.camera_of(points[None] + 7.0) is None


def test_pixels_that_saw_nothing_are_no_lines_of_sight():
    points = image().reshape(-1, 3)
    points[::3], points[1::3] = np.nan, 0.0
    assert pinhole.is_centre_of(points) and pinhole.is_centre_of(points[2::3])
    points[2] = [0.0, 0.0, -450.0]
    assert not pinhole.is_centre_of(points), "one that is a point counts"


def test_points_behind_the_camera_alone_refuse():
    """Their lines of sight meet just as well."""
    grid = image()
    grid[:, ::2] *= -1.0
    assert pinhole.centre_of(grid) is None
