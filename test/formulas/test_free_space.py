"""Lines of sight by hand: a wall 400 mm below the camera, and targets before, behind, beside and across it."""

from dataclasses import replace

import numpy as np
import pytest

from gapr_core.errors import InvalidPointCloudError
from gapr_core.geometry import se3
from gapr_core.registration.scenes import free_space
from gapr_core.registration.scenes.free_space import DepthImage, Visible, _looking_at, _pixels, compare, see

EYE = np.array([0.0, 0.0, 400.0])
ON_MM, FRONT_MM = 2.0, 4.0


def wall(height_mm=0.0, half_mm=24.0, step_mm=8.0):
    x, y = np.meshgrid(*[np.arange(-half_mm, half_mm + 1e-6, step_mm)] * 2)
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, height_mm)], axis=1)
    return points, np.tile([0.0, 0.0, 1.0], (len(points), 1))


@pytest.fixture(scope="module")
def image():
    points, normals = wall(half_mm=40.0, step_mm=4.0)
    return see(points, -normals, EYE)


def shares(image, normal=(0.0, 0.0, 1.0), at=(0.0, 0.0, 0.0), front_mm=FRONT_MM):
    """Explained, violating and compared: of one target point with a normal, each 0 or a share of 1."""
    unit = np.array(normal) / np.linalg.norm(normal)
    found = compare(np.eye(4)[None], np.array([at]), unit[None], image, ON_MM, front_mm, num_threads=1)
    return float(found.explained[0]), float(found.violating[0]), float(found.compared[0])


@pytest.mark.parametrize("off_mm", [-1.9, -1.0, 0.0, 0.5, 1.9])
def test_a_point_is_explained_by_one_less_its_squared_distance_to_the_plane(image, off_mm):
    assert shares(image, at=(0.0, 0.0, off_mm))[0] == pytest.approx(1.0 - (off_mm / ON_MM) ** 2, abs=1e-3)


@pytest.mark.parametrize("off_mm", [-2.1, 2.1])
def test_a_point_farther_off_is_not_explained(image, off_mm):
    assert shares(image, at=(0.0, 0.0, off_mm))[0] == 0.0


@pytest.mark.parametrize(("height_mm", "violating"), [(3.9, 0.0), (4.1, 1.0), (50.0, 1.0), (-4.1, 0.0)])
def test_bone_in_front_of_what_was_measured_violates(image, height_mm, violating):
    assert shares(image, at=(0.0, 0.0, height_mm))[1] == violating
    assert shares(image, normal=(0.0, 0.0, -1.0), at=(0.0, 0.0, height_mm))[1] == violating  # whichever way it faces


@pytest.mark.parametrize(("height_mm", "compared"), [(3.9, 1.0), (4.1, 0.0), (-2.9, 1.0), (-3.1, 0.0)])
def test_bone_is_compared_between_too_far_in_front_and_hidden(image, height_mm, compared):
    assert shares(image, at=(0.0, 0.0, height_mm))[2] == compared


@pytest.mark.parametrize(("cosine", "seen"), [(0.21, 1.0), (0.19, 0.0), (-0.5, 0.0), (1.0, 1.0)])
def test_a_surface_must_face_the_camera(image, cosine, seen):
    normal = (np.sqrt(1.0 - cosine**2), 0.0, cosine)
    assert shares(image, normal)[2] == seen


@pytest.mark.parametrize(("cosine", "explained"), [(0.61, 1.0), (0.59, 0.0)])
def test_a_surface_of_another_direction_is_not_explained(image, cosine, explained):
    for side in (1.0, -1.0):
        normal = (0.0, side * np.sqrt(1.0 - cosine**2), cosine)
        assert shares(image, normal)[0] == pytest.approx(explained, abs=1e-3)
        assert shares(image, normal)[2] == 1.0


def test_a_pixel_holds_the_plane_of_its_point_and_the_least_depth_measured_around():
    points = np.array([[1.0, 2.0, 0.5], [3.0, -1.0, 7.0], [0.0, 4.0, 9.0]])
    normals = np.array([[0.0, 0.6, -0.8], [0.0, 0.0, -1.0], [0.6, 0.0, -0.8]])
    none = len(points)  # where no point is near
    nearest = np.array([[0, none, none, none, 1], [none, 2, none, 1, 2]])
    found = _pixels(nearest, points, normals)
    least = np.array([[0.5, 0.0, 0.0, 0.0, 7.0], [0.0, 0.5, 0.0, 7.0, 7.0]])
    for i, j in np.ndindex(nearest.shape):
        k = nearest[i, j]
        wanted = np.zeros(6) if k == none else [*normals[k], normals[k] @ points[k], points[k, 2], least[i, j]]
        assert found[i, j] == pytest.approx(wanted)


@pytest.mark.parametrize("eye", [[30.0, -20.0, 90.0], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
def test_a_camera_looks_at_the_middle_of_the_points(eye):
    """Along its third axis; along that of the cloud's frame where it stands in the middle."""
    points = np.array([[5.0, 0.0, 0.0], [-5.0, 0.0, 0.0], [0.0, 3.0, 2.0], [0.0, -3.0, -2.0]])
    T = _looking_at(np.array(eye), points)
    length = np.linalg.norm(eye)
    ahead = -np.array(eye) / length if length else np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(T[2, :3], ahead, atol=1e-12)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(se3.apply(T, np.array([eye]))[0], 0.0, atol=1e-12)


def test_points_outside_the_image_or_behind_the_camera_say_nothing(image):
    for at in ((90.0, 0.0, 0.0), (-90.0, 0.0, 0.0), (0.0, 90.0, 0.0), (0.0, -90.0, 0.0), (0.0, 0.0, 500.0)):
        assert shares(image, at=at) == (0.0, 0.0, 0.0)


def test_a_line_of_sight_without_a_measured_point_says_nothing():
    points, normals = wall(half_mm=40.0, step_mm=4.0)
    hole = np.abs(points[:, :2]).max(axis=1) > 14.0
    holed = see(points[hole], normals[hole], EYE)
    assert shares(holed, at=(0.0, 0.0, 100.0)) == (0.0, 0.0, 0.0)
    assert shares(holed, at=(24.0, 0.0, 0.0))[2] == 1.0


def test_a_slanted_plane_is_not_followed_far_in_depth():
    """A steep measured surface: bone in its plane, but far along it in depth, is not explained."""
    x, y = np.meshgrid(*[np.linspace(-40.0, 40.0, 21)] * 2)
    points = np.stack([x.ravel(), y.ravel(), 2.0 * x.ravel()], axis=1)
    normal = np.array([-2.0, 0.0, 1.0]) / np.sqrt(5.0)
    tilted = see(points, np.tile(normal, (len(points), 1)), EYE)
    pixels = tilted.pixels.copy()
    pixels[..., 4] += 8.5  # each measured point lies deeper in its own plane
    assert shares(replace(tilted, pixels=pixels), normal, front_mm=50.0)[0] == pytest.approx(1.0, abs=0.05)
    pixels[..., 4] += 2.0
    assert shares(replace(tilted, pixels=pixels), normal, front_mm=50.0)[0] == 0.0
    pixels[..., 4] -= 19.8  # and on the other side
    assert shares(replace(tilted, pixels=pixels), normal, front_mm=50.0)[0] == 0.0


def test_shares_are_of_all_points_and_of_every_pose(image):
    points, normals = wall()
    poses = np.stack([se3.exp([0, 0, z, 0, 0, 0]) for z in (0.0, -10.0, 10.0)])  # the target moves by the opposite
    found = compare(poses, points, normals, image, ON_MM, FRONT_MM, num_threads=2)
    assert found.explained == pytest.approx([1.0, 0.0, 0.0], abs=1e-3)
    assert found.violating == pytest.approx([0.0, 1.0, 0.0])
    half = np.where(np.arange(len(points)) % 2 == 0, 0.0, 1.0)[:, None] * [0.0, 0.0, 10.0]
    found = compare(poses[:1], points + half, normals, image, ON_MM, FRONT_MM, num_threads=1)
    assert found.explained == pytest.approx([25 / 49], abs=1e-3) and found.violating == pytest.approx([24 / 49])


def test_all_moves_together():
    """Turn cloud and camera: the target follows by the same motion."""
    T = se3.exp([30.0, -20.0, 100.0, 0.7, -1.1, 0.4])
    points, normals = wall(half_mm=40.0, step_mm=4.0)
    turned = see(se3.apply(T, points), normals @ T[:3, :3].T, se3.apply(T, EYE[None])[0])
    target, facing = wall()
    bent = target + [0.0, 0.0, 1.0] * (target[:, :1] / 24.0)
    for cloud in (target, bent, target + [0.0, 0.0, 6.0]):
        plain = compare(np.eye(4)[None], cloud, facing, see(points, normals, EYE), ON_MM, FRONT_MM, num_threads=1)
        moved = compare(se3.inverse(T)[None], cloud, facing, turned, ON_MM, FRONT_MM, num_threads=1)
        assert moved.violating == pytest.approx(plain.violating, abs=0.05)
        assert moved.explained == pytest.approx(plain.explained, abs=0.05)


def test_a_score_takes_off_twice_what_was_seen_through_and_a_fifth_of_what_was_seen_otherwise():
    explained, violating, compared = (np.array(x) for x in ([0.5, 0.5, 0.4], [0.0, 0.1, 0.0], [0.5, 0.8, 0.2]))
    found = Visible(explained, violating, compared)
    assert found.score == pytest.approx([0.5, 0.5 - 0.2 * 0.3 - 2.0 * 0.1, 0.4])


def test_the_image_looks_at_the_middle_and_holds_planes_of_the_camera_frame(image):
    assert isinstance(image, DepthImage)
    in_camera = se3.apply(image.T_camera_source, np.array([[0.0, 0.0, 0.0], EYE]))
    assert in_camera[0] == pytest.approx([0.0, 0.0, 400.0], abs=1e-9)
    assert in_camera[1] == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)
    seen = image.pixels[..., 4] > 0.0
    assert seen.mean() > 0.9 and image.pixels[seen][:, 4] == pytest.approx(400.0, abs=1e-2)
    assert image.pixels[seen][:, :3] == pytest.approx(np.tile([0.0, 0.0, -1.0], (seen.sum(), 1)), abs=1e-5)
    assert image.pixels[seen][:, 3] == pytest.approx(-400.0, abs=1e-2)
    assert image.origin == pytest.approx([-0.1, -0.1], abs=1e-3)


def test_the_smallest_depth_is_that_of_the_pixels_around():
    points, normals = wall(half_mm=40.0, step_mm=4.0)
    points = points + np.where(points[:, :1] > 0.0, [[0.0, 0.0, 40.0]], 0.0)  # a step
    image = see(points, normals, EYE)
    deep = np.abs(image.pixels[..., 4] - 400.0) < 1.0
    beside = deep & (np.abs(image.pixels[..., 5] - 360.0) < 1.0)
    assert beside.any() and (deep & ~beside).any()
    rows, columns = np.nonzero(beside)
    assert len(set(columns)) <= 2 or len(set(rows)) <= 2  # only along the step


@pytest.mark.parametrize(("least", "most", "pixel"), [
    (0.003, 160_000, 4.0 / 400.0),  # the spacing of the points
    (0.02, 160_000, 0.02), (0.003, 100, 0.2 / 10.0),  # its 0.2 x 0.2 in a hundred pixels
])  # fmt: skip
def test_pixels_are_as_large_as_the_gaps_and_not_too_many(monkeypatch, least, most, pixel):
    monkeypatch.setattr(free_space, "SMALLEST_PIXEL", least)
    monkeypatch.setattr(free_space, "MOST_PIXELS", most)
    image = see(*wall(half_mm=40.0, step_mm=4.0), EYE)
    assert image.pixel == pytest.approx(pixel, rel=1e-6)
    assert image.pixels.shape[:2] == pytest.approx((0.2 / pixel + 1, 0.2 / pixel + 1), abs=1.01)


def test_a_measured_point_speaks_for_lines_of_sight_within_its_reach():
    rays = np.array([[0.0, 0.0], *[[0.1 * np.cos(a), 0.1 * np.sin(a)] for a in np.linspace(0, 6, 19)]])
    rays = np.vstack([rays, rays + [1e-4, 0.0]])  # in pairs: their gaps ask for the smallest pixel
    points = np.column_stack([rays * 400.0, np.full(len(rays), 400.0)]) * [1.0, 1.0, -1.0] + EYE
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    image = see(points, normals, EYE)
    centre = image.origin + image.pixel * np.stack(np.meshgrid(*map(np.arange, image.pixels.shape[1::-1])), -1)
    seen = se3.apply(image.T_camera_source, points)
    gap = np.linalg.norm(centre[..., None, :] - seen[:, :2] / seen[:, 2:], axis=-1)
    assert np.array_equal(image.pixels[..., 4] > 0.0, gap.min(axis=-1) <= free_space.REACH)


def test_points_far_aside_of_the_view_are_left_out():
    points, normals = wall(half_mm=40.0, step_mm=4.0)
    for x_mm, least, most in ((3000.0, 0.0, 0.2), (1500.0, 3.5, 4.0)):  # their cosines are .13 and .26
        aside = np.array([[x_mm, 0.0, 0.0], [-x_mm, 0.0, 0.0]])
        image = see(np.vstack([points, aside]), np.vstack([normals, normals[:2]]), EYE)
        assert least < np.abs(image.origin).max() < most


def test_a_camera_inside_the_cloud_sees_nothing():
    points, normals = wall()
    with pytest.raises(InvalidPointCloudError, match="viewpoint outside the cloud"):
        see(points, normals, np.zeros(3))
