"""The adapter for a checkout of GeoTransformer: stand-ins for its operators; the network itself where there is one."""

from __future__ import annotations

import os
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from gapr_core.benchmark import checkout, geotransformer, methods, peer
from gapr_core.benchmark.geotransformer import ORIGIN, Checkout
from gapr_core.benchmark.peer import VOXEL
from gapr_core.data.parametric import make_bone
from gapr_core.errors import ConfigError, InvalidPointCloudError, WeightsError
from gapr_core.model.config import ModelConfig
from gapr_core.model.pyramid import build_cloud, target_frame
from gapr_core.training.config import TrainConfig
from gapr_core.training.geotransformer import Lessons
from gapr_core.training.peer import train

RNG = np.random.default_rng(0)


def test_its_voxels_are_ours():
    points = torch.from_numpy(RNG.random((40, 3))).float()
    thinned, lengths = geotransformer.grid_subsampling(points, torch.tensor([25, 15]), 0.5)
    ours, counts = checkout.voxels(points.double().numpy(), [25, 15], 0.5)
    assert lengths.tolist() == counts and thinned.dtype == torch.float32
    np.testing.assert_allclose(thinned.numpy(), ours, rtol=1e-6)


def test_its_balls_are_ours_with_sixty_four_points():
    points = torch.from_numpy(RNG.random((40, 3))).float()
    lengths = torch.tensor([25, 15])
    rows = geotransformer.radius_neighbors(points, points, lengths, lengths, 0.4)
    assert rows.dtype == torch.int64
    np.testing.assert_array_equal(rows, checkout.balls(points.numpy(), points.numpy(), [25, 15], [25, 15], 0.4, 64))


def test_it_is_given_the_finest_points_in_its_unit_and_needs_a_patch_of_them():
    sizes = peer.thinning(ModelConfig(superpoints=(50, 75), patch_size=33))
    points = make_bone("femur", 1).sample(4000, RNG)[0]
    frame = target_frame(points, sizes)
    cloud = build_cloud(points, frame, sizes)
    settings = SimpleNamespace(num_stages=4, init_voxel_size=VOXEL, init_radius=2.5 * VOXEL)
    config = SimpleNamespace(make_cfg=lambda: SimpleNamespace(backbone=settings))
    code = Checkout(config, None, None, lambda pairs, *balls: pairs[0] | {"lengths": [None, torch.tensor([40, 32])]})
    T = torch.cat([torch.eye(3), torch.tensor([[0.5], [0.0], [-0.25]])], dim=1)
    with pytest.raises(InvalidPointCloudError, match="at least 33 voxels; got 32"):
        code.batch(cloud, cloud, frame.voxel, sizes)
    batch = code.batch(cloud, cloud, frame.voxel, replace(sizes, patch_size=32), T)
    scale = VOXEL / frame.voxel
    torch.testing.assert_close(batch["ref_points"], cloud.levels[0].points * scale)
    assert batch["transform"][:3, 3].tolist() == pytest.approx([0.5 * scale, 0.0, -0.25 * scale])


def test_its_pose_and_its_matches_are_read_from_its_output():
    code = Checkout(None, None, None, None)
    points, motion = torch.from_numpy(RNG.random((5, 3))).float(), torch.eye(4)
    output = {"src_corr_points": points, "ref_corr_points": points + 1.0, "corr_scores": torch.ones(5)}
    found = code.matches(output, {})
    np.testing.assert_allclose(found.target - found.source, 1.0)
    assert found.score.dtype == np.float64
    np.testing.assert_array_equal(code.own_pose({"estimated_transform": motion}, {}), np.eye(4))


def test_targets_that_are_not_whole_are_not_trained_on(tmp_path):
    config = replace(TrainConfig(), mix={"paper": 1.0, "incomplete": 1.0})
    with pytest.raises(ConfigError, match="protocols with whole targets; got incomplete"):
        train(SimpleNamespace(), Lessons, config, None, tmp_path)


@pytest.mark.skipif(
    ORIGIN.variable not in os.environ, reason=f"its authors' code does not ship: set {ORIGIN.variable} to a clone of it"
)
def test_the_authors_code_learns_a_step_and_registers(tmp_path):
    config = replace(TrainConfig(), pairs=2, batch=2, micro_batch=1, mix={"paper": 1.0}, model_settings={"width": 16})
    train(Checkout.at(), Lessons, config, None, tmp_path)
    made = methods.make(f"geotransformer@{tmp_path / 'weights.safetensors'}")
    target = make_bone("femur", 1).sample(3000, RNG)[0]
    assert made.register(target[:2000], target).method == made.name
    (tmp_path / "weights.safetensors").write_bytes(b"no weights")
    with pytest.raises(WeightsError):
        methods.make(f"geotransformer@{tmp_path / 'weights.safetensors'}")
