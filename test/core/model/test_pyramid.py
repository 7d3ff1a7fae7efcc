from __future__ import annotations

import numpy as np
import pytest
import torch

from gapr_core.errors import InvalidPointCloudError
from gapr_core.geometry import se3
from gapr_core.model.pyramid import build_cloud, pyramid, target_frame, voxel_means
from gapr_core.model.types import collate


def test_neighbours_are_the_nearest_points_within_the_radius(clouds, config):
    level = clouds[1].levels[1]
    distance = torch.cdist(level.points.double(), level.points.double())
    radius = level.within.radius[0].double()
    for i in range(0, len(level.points), 7):
        order = distance[i].argsort()[: config.neighbors[1]]
        expected = set(order[distance[i][order] <= radius].tolist())
        assert set(level.within.index[i][level.within.valid[i]].tolist()) == expected
        torch.testing.assert_close(level.within.c_h[i], level.points[sorted(expected)].mean(0), atol=1e-5, rtol=0)


def test_a_moved_cloud_has_the_same_neighbours_and_moved_points(config, toy):
    frame = target_frame(toy.bone(), config)
    still, moved = (
        build_cloud(toy.bone(), frame, config),
        build_cloud(se3.apply(toy.motion(1), toy.bone()), frame, config),
    )
    R = torch.from_numpy(toy.motion(1)[:3, :3]).float()
    for a, b in zip(still.levels, moved.levels, strict=True):
        assert torch.equal(a.within.index, b.within.index)
        torch.testing.assert_close(a.points @ R.T, b.points, atol=1e-5, rtol=0)
        torch.testing.assert_close(a.normals @ R.T, b.normals, atol=1e-4, rtol=0)
    # the last bit decides which of two points that are equally far comes first, or is the last of a full patch
    same = [set(a.tolist()) ^ set(b.tolist()) for a, b in zip(still.patches, moved.patches, strict=True)]
    assert sum(map(len, same)) <= 0.01 * still.patches.numel()


def test_turning_a_cloud_equals_building_the_turned_points(config, toy):
    frame = target_frame(toy.bone(), config)
    turned = build_cloud(toy.bone(), frame, config).turned(toy.motion(2))
    built = build_cloud(se3.apply(toy.motion(2), toy.bone()), frame, config)
    torch.testing.assert_close(turned.coarse.points, built.coarse.points, atol=1e-5, rtol=0)
    torch.testing.assert_close(turned.levels[1].below.c_k, built.levels[1].below.c_k, atol=1e-5, rtol=0)
    torch.testing.assert_close(turned.centre_mm, built.centre_mm)


def test_the_first_voxel_leaves_the_wanted_number_of_superpoints(toy):
    config = toy.small_config(superpoints=(40, 60))
    points = toy.bone(4000, 5)
    frame = target_frame(points, config)
    assert 40 <= len(build_cloud(points, frame, config).coarse.points) <= 60
    assert np.isclose(frame.scale_mm, np.linalg.norm(points - points.mean(0), axis=1).max())


def test_voxel_means_equal_a_dictionary():
    points = np.random.default_rng(0).normal(size=(300, 3))
    cells: dict[tuple, list] = {}
    for p in points:
        cells.setdefault(tuple(np.floor(p / 0.7).astype(int)), []).append(p)
    expected = np.array(sorted(np.mean(c, axis=0).tolist() for c in cells.values()))
    np.testing.assert_allclose(np.array(sorted(voxel_means(points, 0.7).tolist())), expected)


def test_every_fine_point_is_in_the_patch_of_its_nearest_superpoint(clouds):
    cloud = clouds[1]
    nearest = torch.cdist(cloud.fine.points.double(), cloud.coarse.points.double()).argmin(1)
    row, column = cloud.patches_valid.nonzero(as_tuple=True)
    assert torch.equal(nearest[cloud.patches[row, column]], row)
    sizes, cap = torch.bincount(nearest, minlength=len(cloud.patches)), cloud.patches.shape[1]
    assert torch.equal(cloud.patches_valid.sum(1), sizes.clamp(max=max(cap, 1)))


def test_normals_of_a_ball_point_outward_and_surely(toy):
    d = np.random.default_rng(0).normal(size=(1500, 3))
    points = 50.0 * d / np.linalg.norm(d, axis=1, keepdims=True)
    config = toy.small_config(superpoints=(30, 50))
    level = build_cloud(points, target_frame(points, config), config).levels[0]
    assert ((level.normals * level.points).sum(1) > 0.9).all() and level.certainty.min() > 0.5


def test_normals_of_a_plate_are_uncertain(toy):
    points = np.random.default_rng(0).uniform(-50, 50, (1500, 3)) * [1.0, 1.0, 0.005]
    config = toy.small_config(superpoints=(30, 50))
    level = build_cloud(points, target_frame(points, config), config).levels[0]
    assert level.certainty.median() < 0.2 and level.normals[:, 2].abs().median() > 0.95


@pytest.mark.parametrize("bad", [np.zeros((15, 3)), np.zeros((30, 3)), np.full((30, 3), np.nan), np.zeros((30, 2))])
def test_what_is_no_cloud_is_refused_in_one_sentence(bad, config):
    with pytest.raises(InvalidPointCloudError):
        target_frame(bad, config)


def test_a_source_far_larger_than_its_target_is_refused(config, toy):
    with pytest.raises(InvalidPointCloudError, match="larger"):
        build_cloud(toy.bone(4000, 2) * 12.0, target_frame(toy.bone(), config), config)


def test_concatenated_clouds_keep_their_own_neighbours(clouds, config, toy):
    source, target, frame = clouds
    small = build_cloud(toy.view(toy.bone(), 0.05), frame, config)
    joined = collate([source, small, target])
    start = len(source.levels[0].points) + len(small.levels[0].points)
    own = joined.levels[0].within
    assert joined.levels[0].lengths == (
        len(source.levels[0].points),
        len(small.levels[0].points),
        len(target.levels[0].points),
    )
    assert torch.equal(
        own.index[start:][own.valid[start:]] - start, target.levels[0].within.index[target.levels[0].within.valid]
    )
    assert torch.equal(
        joined.levels[1].points[joined.levels[0].up[start:]], target.levels[1].points[target.levels[0].up]
    )


def test_each_stage_is_coarser_than_the_one_before(config, toy):
    sizes = [len(p) for p in pyramid(toy.bone() / 100.0, 0.1, config)]
    assert sizes == sorted(sizes, reverse=True) and len(sizes) == config.stages
