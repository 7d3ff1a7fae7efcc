"""Chamfer distance against Open3D; inlier ratios by hand."""

import numpy as np
import pytest

from gapr_core.geometry import se3
from gapr_core.metrics.surfaces import chamfer_mm, coarse_inlier_ratio, fine_inlier_ratio


def test_chamfer_agrees_with_open3d_distances_below_the_cut_off():
    import open3d as o3d

    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(300, 3)) * 12, rng.normal(size=(400, 3)) * 14 + 3
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(c)) for c in (a, b)]
    there = np.asarray(clouds[0].compute_point_cloud_distance(clouds[1]))
    back = np.asarray(clouds[1].compute_point_cloud_distance(clouds[0]))
    assert (there >= 10).any() or (back >= 10).any()
    assert chamfer_mm(a, b) == pytest.approx(there[there < 10].mean() + back[back < 10].mean())


def test_chamfer_is_symmetric_and_counts_clouds_far_apart_as_the_cut_off():
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(50, 3)), rng.normal(size=(60, 3))
    assert chamfer_mm(a, b) == pytest.approx(chamfer_mm(b, a))
    assert chamfer_mm(a, a) == 0.0
    assert chamfer_mm(a, b + 1000.0) == 20.0


def test_a_pair_exactly_at_the_limit_does_not_count():
    assert chamfer_mm([[0.0, 0.0, 0.0], [14.0, 0.0, 0.0]], [[4.0, 0.0, 0.0]], cutoff_mm=10.0) == 8.0
    assert fine_inlier_ratio([[0.0, 0.0, 0.0]], [[3.0, 4.0, 0.0]], np.eye(4), 5.0) == 0.0


def test_fine_inlier_ratio_counts_correspondences_under_the_truth():
    T = se3.exp([10, 0, 0, 0, 0, 1.0])
    source = np.random.default_rng(2).normal(size=(10, 3)) * 50
    target = se3.apply(T, source)
    target[:3] += [0, 0, 6.0]
    assert fine_inlier_ratio(source, target, T, 5.0) == pytest.approx(0.7)
    assert fine_inlier_ratio(source, target, T, 7.0) == 1.0
    assert fine_inlier_ratio(np.empty((0, 3)), np.empty((0, 3)), T, 5.0) == 0.0


def test_coarse_inlier_ratio_asks_the_patches_that_were_matched():
    overlap = np.array([[0.0, 0.3], [0.6, 0.0]])
    assert coarse_inlier_ratio([[0, 1], [1, 0], [0, 0], [1, 1]], overlap) == 0.5
    assert coarse_inlier_ratio([[0, 1], [1, 0], [0, 0]], overlap) == pytest.approx(2 / 3)
    assert coarse_inlier_ratio([[0, 1], [1, 0]], overlap, least=0.5) == 0.5
    assert coarse_inlier_ratio([], overlap) == 0.0
