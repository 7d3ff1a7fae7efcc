"""A bone on a table: at rest, all of the table below it, and seen from above."""

import numpy as np
import pytest

from gapr_core.data.pool import parametric_specimen
from gapr_core.data.protocols import make_pair
from gapr_core.data.scenes.table import resting
from gapr_core.geometry import se3

BRICK = np.stack(np.meshgrid([-50.0, 50.0], [-20.0, 20.0], [-5.0, 5.0]), axis=-1).reshape(-1, 3)


@pytest.fixture(scope="module")
def pair():
    return make_pair("scene-table", parametric_specimen("tibia", 3), 2)


def test_a_brick_rests_on_one_of_its_faces():
    ups = {tuple(np.round(resting(BRICK, np.random.default_rng(seed)), 6)) for seed in range(60)}
    assert ups == {tuple(sign * axis) for axis in np.eye(3) for sign in (1.0, -1.0)}


def test_no_body_rests_on_a_face_that_its_middle_does_not_lie_above():
    """A leaning column 100 mm high whose top hangs over by 80 mm falls over: it does not stand on its foot."""
    column = np.vstack([BRICK[:, :2].repeat(2, axis=0).T, np.tile([0.0, 100.0], 8)]).T * [0.2, 0.5, 1.0]
    column[:, 0] += 0.8 * column[:, 2]
    ups = [resting(column, np.random.default_rng(seed)) for seed in range(30)]
    assert all(abs(up[2]) < 0.99 for up in ups)
    straight = column - [[0.8 * z, 0.0, 0.0] for z in column[:, 2]]
    assert any(abs(resting(straight, np.random.default_rng(seed))[2]) > 0.99 for seed in range(30))


def test_the_table_touches_the_bone_from_below(pair):
    up, is_bone = pair.metadata["up"], pair.metadata["is_bone"]
    heights = se3.apply(pair.T_target_source, pair.source) @ up
    lowest = (pair.target @ up).min()
    assert np.abs(heights[~is_bone] - lowest).max() < 4.0  # errors of the camera, and gaps between target points
    assert heights[is_bone].mean() > lowest + 5.0
    assert 0.10 <= is_bone.mean() <= 0.60


@pytest.mark.parametrize("seed", range(3))
def test_the_camera_is_at_most_50_degrees_off_the_upright(seed):
    """Seen from where it looks at, which is on the bone, near the middle of what it sees of it."""
    pair = make_pair("scene-table", parametric_specimen("tibia", 3), seed)
    eye = se3.apply(pair.T_target_source, np.array([pair.viewpoint]))[0]
    aim = pair.metadata["middle"] - pair.metadata["origin_mm"]
    way = (eye - aim) / np.linalg.norm(eye - aim)
    assert way @ pair.metadata["up"] > np.cos(np.radians(50.0))


def test_the_same_seed_gives_the_same_table(pair):
    again = make_pair("scene-table", parametric_specimen("tibia", 3), 2)
    np.testing.assert_array_equal(pair.source, again.source)
    np.testing.assert_array_equal(pair.viewpoint, again.viewpoint)
