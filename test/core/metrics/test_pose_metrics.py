"""Pose errors against scipy, closed forms and hand-made cases."""

from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gapr_core.geometry import extent, se3
from gapr_core.geometry.se3 import PoseError
from gapr_core.metrics import pose


def random_pose(rng):
    return se3.from_rotation_translation(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-100, 100, 3))


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def test_rotation_error_is_the_geodesic_angle_of_scipy(rng):
    source = rng.normal(size=(50, 3)) * 40
    for _ in range(20):
        a, b = random_pose(rng), random_pose(rng)
        relative = Rotation.from_matrix(a[:3, :3]).inv() * Rotation.from_matrix(b[:3, :3])
        assert se3.pose_error(a, b, source).rre_deg == pytest.approx(np.degrees(relative.magnitude()))


def test_turning_about_the_source_centroid_costs_no_translation(rng):
    source = rng.normal(size=(50, 3)) * 40 + [500.0, 0.0, 0.0]
    true = random_pose(rng)
    centre = se3.apply(true, source).mean(axis=0)
    turned = se3.exp([0, 0, 0, 0, 0, np.radians(7)], centre) @ true
    error = se3.pose_error(turned, true, source)
    assert error.rte_mm == pytest.approx(0.0, abs=1e-9) and error.rre_deg == pytest.approx(7.0)
    assert not error.is_right and error.within(4.0, 7.1)


def test_a_pose_exactly_at_the_limits_is_right_and_one_beyond_either_is_not():
    assert PoseError(4.0, 5.0).is_right
    assert not PoseError(4.001, 0.0).is_right and not PoseError(0.0, 5.001).is_right


def test_rmse_is_the_paper_s_way_over_the_inverse_of_the_truth(rng):
    source, estimate, true = rng.normal(size=(80, 3)) * 30, random_pose(rng), random_pose(rng)
    back = se3.apply(np.linalg.inv(true) @ estimate, source)
    assert pose.rmse_mm(estimate, true, source) == pytest.approx(np.sqrt(((back - source) ** 2).sum(1).mean()))


def test_whole_bone_error_sees_what_the_patch_hides():
    target = np.c_[np.linspace(0, 400, 401), np.zeros(401), np.zeros(401)]
    tilt = se3.exp([0, 0, 0, 0, 0, np.radians(1)])
    assert pose.rmse_mm(tilt, np.eye(4), target[:20]) < 0.25
    expected = 2 * np.sin(np.radians(0.5)) * np.sqrt((target[:, 0] ** 2).mean())
    assert pose.whole_bone_rmse_mm(tilt, np.eye(4), target) == pytest.approx(expected)


def test_errors_do_not_depend_on_where_the_source_frame_is(rng):
    source, target = rng.normal(size=(60, 3)) * 30, rng.normal(size=(90, 3)) * 60
    estimate, true, move = random_pose(rng), random_pose(rng), random_pose(rng)
    moved, there = se3.apply(move, source), np.linalg.inv(move)
    points = {"hip": target[0]}
    for measure, cloud, other in (
        (pose.rmse_mm, source, moved),
        (se3.pose_error, source, moved),
        (pose.whole_bone_rmse_mm, target, target),
        (pose.tre_mm, points, points),
    ):
        assert measure(estimate @ there, true @ there, other) == pytest.approx(measure(estimate, true, cloud))


def test_tre_at_a_named_point_is_the_distance_it_is_moved():
    shifted = se3.from_rotation_translation(np.eye(3), [3.0, 4.0, 0.0])
    assert pose.tre_mm(shifted, np.eye(4), {"knee": [1.0, 2.0, 3.0]}) == {"knee": pytest.approx(5.0)}


def test_extreme_points_of_a_box_are_at_the_ends_of_its_long_axis(rng):
    box = rng.uniform(-1, 1, size=(500, 3)) * [200, 30, 5]
    ends = pose.extreme_points(box)
    assert len(ends) == 6
    assert ends["axis1+"][0] > 195 and ends["axis1-"][0] < -195
    assert ends["axis2+"][1] > 25 and ends["axis2-"][1] < -25


def test_the_plus_end_of_an_axis_is_the_one_towards_its_largest_positive_coordinate(rng):
    """Also where the longest axis is not x: the sign is that of each axis's own largest coordinate."""
    spread = rng.uniform(-1, 1, size=(500, 3)) * [30, 5, 200] + [0.0, 0.0, 900.0]
    turn = Rotation.from_euler("zyx", [200.0, 25.0, 170.0], degrees=True).as_matrix()
    for points in (spread, spread @ turn.T):
        ends = pose.extreme_points(points)
        for k in (1, 2, 3):
            apart = ends[f"axis{k}+"] - ends[f"axis{k}-"]
            assert apart[np.abs(extent.principal(points).axes[k - 1]).argmax()] > 0.0


def test_the_paper_limit_scales_with_the_bone():
    small, large = ([[-half, 0.0, 0.0], [half, 0.0, 0.0]] for half in (100.0, 200.0))
    assert pose.within_paper_limit(1.9, small) and not pose.within_paper_limit(2.0, small)
    assert pose.within_paper_limit(3.9, large) and not pose.within_paper_limit(4.1, large)


def test_the_paper_measures_a_bone_by_the_longest_edge_of_its_box():
    """The largest distance to the mean is longer for every bone that is not a line."""
    box = np.array(list(product((-50.0, 50.0), (-30.0, 30.0), (-100.0, 100.0))))
    assert pose.within_paper_limit(1.99, box) and not pose.within_paper_limit(2.01, box)
    assert pose.within_extent_limit(2.3, box) and not pose.within_extent_limit(2.33, box)


def test_recall_counts_failures_and_is_nan_of_nothing():
    assert pose.recall([True, False, False, True]) == 0.5
    assert np.isnan(pose.recall([]))


def test_r2_is_one_minus_the_variance_that_polyfit_leaves(rng):
    x = rng.normal(size=200)
    y = 3 * x + rng.normal(size=200)
    fit = np.polyval(np.polyfit(x, y, 1), x)
    correlation = np.corrcoef(fit, y)[0, 1]
    assert pose.r2(fit[:, None], y[:, None]) == pytest.approx(correlation**2)
    assert pose.r2(np.full((200, 1), y.mean()), y[:, None]) == pytest.approx(0.0)


def test_r2_of_rotation_punishes_wrap_around_as_the_method_page_says(rng):
    true = np.array([random_pose(rng) for _ in range(4000)])
    axes = rng.normal(size=(4000, 3))
    axes *= np.radians(1.0) / np.linalg.norm(axes, axis=1, keepdims=True)
    near = np.array([se3.exp(np.r_[0, 0, 0, axis]) @ T for axis, T in zip(axes, true, strict=True)])
    assert pose.r2_translation(true, true) == 1.0 and pose.r2_rotation(true, true) == 1.0
    assert 0.93 < pose.r2_rotation(near, true) < 0.99


def test_r2_needs_two_pairs(rng):
    one = random_pose(rng)[None]
    assert np.isnan(pose.r2_translation(one, one)) and np.isnan(pose.r2([[1.0]], [[2.0]]))
    assert pose.r2([[1.0], [4.0]], [[1.0], [3.0]]) == pytest.approx(0.5)  # 1 of 2 is left


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("truth", [[[0.1, 1.0]] * 3, [[0.1, 1.0], [0.1, 2.0], [0.1, 5.0]]])
def test_r2_has_no_value_where_a_component_of_all_truths_is_the_same(truth):
    """Pairs with one common truth printed a warning of NumPy; rounding could give any number."""
    assert np.isnan(pose.r2(np.add(truth, 0.5), truth))


def test_the_stand_in_for_a_refusal_lays_centroid_on_centroid(rng):
    source, target = rng.normal(size=(20, 3)), rng.normal(size=(30, 3)) + 70
    T = pose.centroid_alignment(source, target)
    assert np.allclose(se3.apply(T, source).mean(0), target.mean(0)) and np.array_equal(T[:3, :3], np.eye(3))
