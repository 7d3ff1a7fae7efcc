"""What a camera saw says where the bone is and where it cannot be."""

import numpy as np
import pytest

from gapr_core.errors import InvalidPointCloudError
from gapr_core.registration.scenes.free_space import compare, see

EYE = np.array([0.0, 0.0, 400.0])


def wall(height_mm=0.0, half_mm=40.0, step_mm=2.0):
    """A square wall that looks up to the camera."""
    x, y = np.meshgrid(*[np.arange(-half_mm, half_mm + 1e-6, step_mm)] * 2)
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, height_mm)], axis=1)
    return points, np.tile([0.0, 0.0, 1.0], (len(points), 1))


def moved(z_mm=0.0, x_mm=0.0):
    T = np.eye(4)
    T[:3, 3] = [x_mm, 0.0, z_mm]  # T_target_source: the target moves by the opposite
    return T


@pytest.fixture(scope="module")
def image():
    points, normals = wall(half_mm=60.0)
    return see(points, -normals, EYE)


def seen(image, pose, cloud=None, on_mm=3.0, front_mm=4.0):
    found = compare(pose[None], *(cloud or wall()), image, on_mm, front_mm, num_threads=1)
    return float(found.explained[0]), float(found.violating[0]), float(found.compared[0])


@pytest.mark.parametrize(
    ("shift", "expected"),
    [
        ({}, (1.0, 0.0, 1.0)),  # explained in full
        ({"z_mm": -10.0}, (0.0, 1.0, 0.0)),  # in front of the measured surface: free space is violated
        ({"z_mm": 10.0}, (0.0, 0.0, 0.0)),  # behind: may be hidden
        ({"x_mm": 200.0}, (0.0, 0.0, 0.0)),  # outside of the image
    ],
)
def test_a_target_on_in_front_of_and_behind_the_measured_surface(image, shift, expected):
    assert seen(image, moved(**shift)) == pytest.approx(expected, abs=1e-3)


def test_a_surface_that_turns_its_back_is_not_explained(image):
    points, normals = wall()
    assert seen(image, np.eye(4), (points, -normals)) == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)


def test_a_surface_of_another_direction_is_not_explained_where_it_crosses(image):
    points, normals = wall()
    tilted = normals + [1.5, 0.0, 0.0]
    assert seen(image, np.eye(4), (points, tilted / np.linalg.norm(tilted, axis=1, keepdims=True)))[0] == 0.0


def test_the_nearer_to_the_measured_surface_the_better_it_is_explained(image):
    one, two = (seen(image, moved(z_mm=z), on_mm=3.0)[0] for z in (1.0, 2.0))
    assert one == pytest.approx(1.0 - 1.0 / 9.0, abs=1e-3) and two == pytest.approx(1.0 - 4.0 / 9.0, abs=1e-3)


def test_a_step_in_depth_forbids_nothing_at_its_edge():
    near, far = wall(height_mm=0.0), wall(height_mm=-60.0, half_mm=80.0)
    points = np.vstack([near[0], far[0][np.abs(far[0][:, :2]).max(axis=1) > 48.0]])
    image = see(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)), EYE)
    wider = wall(half_mm=42.0)
    assert seen(image, np.eye(4), wider)[1] == 0.0


def test_lines_of_sight_follow_the_cloud_wherever_it_is_and_however_it_is_turned(image):
    turn = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    points, normals = wall(half_mm=60.0)
    shift = np.array([10.0, -300.0, 70.0])
    other = see(points @ turn.T + shift, normals @ turn.T, turn @ EYE + shift)
    back = np.eye(4)
    back[:3, :3], back[:3, 3] = turn.T, -turn.T @ shift
    assert seen(other, moved(z_mm=-1.0) @ back) == pytest.approx(seen(image, moved(z_mm=-1.0)), abs=0.02)


def test_a_camera_in_the_middle_of_the_cloud_is_refused():
    points, normals = wall()
    with pytest.raises(InvalidPointCloudError, match="viewpoint"):
        see(points, normals, [0.0, 0.0, 0.0])
