"""Where a cloud was seen from, on surfaces made by hand: the direction nothing is grazed in, and which end of it."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gapr_core.geometry import one_view, se3

FAR_MM = 450.0
EYE = np.array([0.0, 0.0, FAR_MM])


def patch(normal, at=(0.0, 0.0, 0.0), half_mm=30.0, step_mm=1.5):
    """A square of points about `at` across a normal, and their normals, of either sign."""
    unit = np.array(normal, dtype=np.float64) / np.linalg.norm(normal)
    u, v = np.meshgrid(*[np.arange(-half_mm, half_mm + 1e-6, step_mm)] * 2)
    across = np.linalg.svd(unit[None])[2][1:]
    points = np.stack([u.ravel(), v.ravel()], axis=1) @ across + at
    return points, unit * np.where(np.arange(len(points)) % 2, 1.0, -1.0)[:, None]


def joined(*patches):
    points, normals = (np.vstack(each) for each in zip(*patches, strict=True))
    return points, normals


def off_deg(viewpoint, points, direction):
    """Angle between the way to a viewpoint and a direction."""
    ahead = viewpoint - points.mean(axis=0)
    return np.degrees(np.arccos(ahead @ direction / np.linalg.norm(ahead) / np.linalg.norm(direction)))


def seen_by_a_camera(points, normals, eye):
    """Of points those that nothing nearer hides, in pixels of 1.5 mm at the middle; of a tie only the nearest."""
    ahead = points.mean(axis=0) - eye
    depth = (points - eye) @ ahead / np.linalg.norm(ahead)
    across = np.linalg.svd(ahead[None] / np.linalg.norm(ahead))[2][1:]
    pixel = np.floor((points - eye) @ across.T / depth[:, None] * np.linalg.norm(ahead) / 1.5).astype(int)
    nearest = {}
    for i in np.argsort(depth):
        nearest.setdefault(tuple(pixel[i]), depth[i])
    stays = np.array([depth[i] - nearest[tuple(pixel[i])] < 4.0 for i in range(len(points))])
    return points[stays], normals[stays]


def neighbours_of(points, count=20):
    return cKDTree(points).query(points, k=count)[1]


def seen_from_one_place(points, normals, spacing_mm=1.5):
    return one_view.seen_from_one_place(points, normals, neighbours_of(points), np.arange(len(points)), spacing_mm)


def dome(radius_mm, step_mm=1.5):
    """The upper half of a sphere, up to 30 degrees off its pole, with normals of either sign."""
    u, v = np.meshgrid(*[np.arange(-radius_mm, radius_mm, step_mm)] * 2)
    points = np.stack([u.ravel(), v.ravel()], axis=1)
    points = points[np.hypot(*points.T) < radius_mm * np.sin(np.radians(30.0))]
    points = np.column_stack([points, np.sqrt(radius_mm**2 - (points**2).sum(axis=1))])
    return points, points / radius_mm * np.where(np.arange(len(points)) % 2, 1.0, -1.0)[:, None]


def test_lines_of_sight_become_parallel_and_what_is_nearer_is_higher():
    rng = np.random.default_rng(0)
    eye = np.array([30.0, -80.0, 300.0])
    points = rng.uniform(-40.0, 40.0, (50, 3))
    on_the_same_line = eye + 1.1 * (points - eye)
    both = np.vstack([points, on_the_same_line])
    straight, _ = one_view.with_parallel_sight(both, np.tile([0.0, 0.0, 1.0], (100, 1)), eye)
    np.testing.assert_allclose(straight[:50, :2], straight[50:, :2], atol=1e-9)
    assert (straight[:50, 2] > straight[50:, 2]).all()


def test_lengths_at_the_middle_stay():
    points = np.array([[0.0, 0.0, 0.0], [1e-3, 0.0, 0.0], [-1e-3, 0.0, 0.0], [0.0, 0.0, 1e-3], [0.0, 0.0, -1e-3]])
    straight, _ = one_view.with_parallel_sight(points, np.tile([0.0, 0.0, 1.0], (5, 1)), EYE)
    assert np.linalg.norm(straight[1] - straight[0]) == pytest.approx(1e-3, rel=1e-4)
    assert straight[3, 2] - straight[0, 2] == pytest.approx(1e-3, rel=1e-4)


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.5, -0.2, 0.8), (0.9, 0.3, -0.2), (-1.0, 0.0, 0.4)])
def test_planes_stay_planes_with_their_normals(normal):
    points, normals = patch(normal, at=(12.0, 7.0, -5.0))
    straight, upright = one_view.with_parallel_sight(points, normals, EYE)
    np.testing.assert_allclose(np.abs(upright @ upright[0]), 1.0, atol=1e-9)
    heights = straight @ upright[0]
    assert np.ptp(heights) < 1e-9 * FAR_MM and np.ptp(straight, axis=0).max() > 10.0


def test_a_plane_through_the_camera_has_no_normal_that_is_not_a_number():
    points, normals = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    assert np.isfinite(one_view.with_parallel_sight(points, normals, EYE)[1]).all()


def test_the_direction_is_the_one_in_which_nothing_is_grazed():
    """The walls of a shallow pit lean by 45 degrees to four sides: only from above none is steep."""
    tilted = [patch((x, y, 1.0), at=(40.0 * x, 40.0 * y, 0.0)) for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    turn = se3.exp(np.array([90.0, 10.0, -40.0, 0.5, -0.9, 0.3]), np.zeros(3))
    points, normals = joined(*tilted)
    moved, turned = se3.apply(turn, points), normals @ turn[:3, :3].T
    view = seen_from_one_place(moved, turned)
    up = turn[:3, 2]
    assert min(off_deg(each, moved, up) for each in view.viewpoints) < 8.0
    assert view.steepest_cos == pytest.approx(np.cos(np.radians(45.0)), abs=0.1)
    np.testing.assert_allclose(view.viewpoints.mean(axis=0), moved.mean(axis=0), atol=1e-9)  # one before, one behind


def test_a_surface_all_around_is_grazed_from_everywhere():
    normals = np.random.default_rng(1).normal(size=(3000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    assert seen_from_one_place(40.0 * normals, normals, 2.6).steepest_cos < 0.1


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_of_both_ends_the_one_from_which_nothing_is_hidden_comes_first(sign):
    """A floor seen through a round hole in a plate 60 mm above it; from below it hides a rim of the plate."""
    floor, plate = patch((0.0, 0.0, 1.0), half_mm=90.0), patch((0.0, 0.0, 1.0), at=(0.0, 0.0, 60.0), half_mm=90.0)
    around = np.hypot(*plate[0][:, :2].T) > 45.0
    points, normals = joined(floor, (plate[0][around], plate[1][around]))
    points, normals = seen_by_a_camera(points, normals, EYE + [0.0, 0.0, 40.0])
    points = points * [1.0, sign, sign]  # from above or from below, by half a turn
    view = seen_from_one_place(points, normals)
    assert off_deg(view.viewpoints[0], points, np.array([0.0, 0.0, sign])) < 12.0
    first, second = (one_view.visible_share(points, normals, each, 1.5) for each in view.viewpoints)
    assert first > second + 0.01


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_of_both_ends_the_one_that_a_surface_bulges_towards_comes_first(sign):
    """A dome, of which neither end hides anything: only its shape tells one from the other."""
    points, normals = dome(80.0)
    points = points * [1.0, sign, sign]
    view = seen_from_one_place(points, normals * [1.0, sign, sign])
    assert off_deg(view.viewpoints[0], points, np.array([0.0, 0.0, sign])) < 12.0
    first, second = (one_view.visible_share(points, normals, each, 1.5) for each in view.viewpoints)
    assert first <= second + 0.01


def test_the_share_that_bulges_is_that_of_bumps_less_that_of_hollows():
    points, normals = dome(80.0)
    hollow = points * [1.0, 1.0, -1.0] + [0.0, 200.0, 0.0], normals * [1.0, 1.0, -1.0]
    flat = patch((0.0, 0.0, 1.0), at=(0.0, -200.0, 0.0))
    a_bump, a_hollow, a_plane = (
        one_view.bulging_share(*each, neighbours_of(each[0]), EYE) for each in ((points, normals), hollow, flat)
    )
    assert a_bump > 0.95 and a_hollow < -0.95 and abs(a_plane) < 0.01
    both = joined((points, normals), (points, normals), hollow)[0] + np.repeat(
        [[0, 0, 0], [300, 0, 0], [0, 0, 0]], len(points), axis=0
    )
    turned = np.vstack([normals, normals, hollow[1]])
    assert one_view.bulging_share(both, turned, neighbours_of(both), EYE) == pytest.approx(1.0 / 3.0, abs=0.05)
    assert one_view.bulging_share(points, normals, neighbours_of(points), -EYE) < -0.95  # from behind


def test_the_camera_is_never_in_a_large_cloud():
    points, normals = patch((0.0, 0.0, 1.0), half_mm=400.0, step_mm=10.0)
    view = seen_from_one_place(points, normals)
    away = np.linalg.norm(view.viewpoints - points.mean(axis=0), axis=1)
    np.testing.assert_allclose(away, 1.5 * 400.0 * np.sqrt(2.0))


AHEAD = {"widest_deg": 35.0, "least_cos": 0.5}


def seen_from_origin(points, normals, **how):
    return one_view.seen_from_origin(points, normals, **(AHEAD | how))


@pytest.mark.parametrize(
    ("normal", "at", "may_be"),
    [
        ((0.0, 0.0, 1.0), (0.0, 0.0, 300.0), True),
        ((0.0, 0.0, 1.0), (0.0, 0.0, -300.0), False),  # behind
        ((0.0, 0.0, 1.0), (0.0, 0.0, 45.0), False),  # nearer than a camera sees
        ((0.0, 0.0, 1.0), (0.0, 0.0, 55.0), True),
        (
            (0.0, np.sin(np.radians(33.0)), np.cos(np.radians(33.0))),
            (0.0, 300.0 * np.tan(np.radians(33.0)), 300.0),
            True,
        ),
        (
            (0.0, np.sin(np.radians(37.0)), np.cos(np.radians(37.0))),
            (0.0, 300.0 * np.tan(np.radians(37.0)), 300.0),
            False,
        ),
        ((0.0, np.sin(np.radians(50.0)), np.cos(np.radians(50.0))), (0.0, 0.0, 900.0), True),  # cos 50 deg is .64
        ((0.0, np.sin(np.radians(70.0)), np.cos(np.radians(70.0))), (0.0, 0.0, 900.0), False),  # cos 70 deg is .34
    ],
)
def test_a_cloud_ahead_of_the_origin_that_nothing_grazes_may_be_in_its_camera_s_frame(normal, at, may_be):
    assert seen_from_origin(*patch(normal, at, half_mm=10.0)) is may_be


def test_a_twentieth_of_a_camera_s_cloud_may_be_grazed():
    flat, wall = patch((0.0, 0.0, 1.0), (0.0, 0.0, 300.0)), patch((1.0, 0.0, 0.0), (0.0, 0.0, 300.0))
    for count, may_be in ((60, True), (120, False)):  # of 1681
        assert seen_from_origin(*joined(flat, [each[:count] for each in wall])) is may_be
