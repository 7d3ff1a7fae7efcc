"""The adapter for a checkout of GeoTransformer: stand-ins, units, messages; the network itself where there is one."""

from __future__ import annotations

import os
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from gapr_core.benchmark import geotransformer, methods
from gapr_core.benchmark.geotransformer import CHECKOUT, VOXEL, Checkout, GeoTransformer
from gapr_core.data.parametric import make_bone
from gapr_core.errors import ConfigError, InvalidPointCloudError, MethodUnavailableError, WeightsError
from gapr_core.geometry import se3
from gapr_core.model.config import ModelConfig
from gapr_core.model.pyramid import build_cloud, target_frame
from gapr_core.training.config import TrainConfig
from gapr_core.training.geotransformer import train

RNG = np.random.default_rng(0)


def test_voxels_are_thinned_cloud_by_cloud():
    points = torch.tensor([[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [1.2, 0.0, 0.0], [0.2, 0.2, 0.2]])
    thinned, lengths = geotransformer.grid_subsampling(points, torch.tensor([3, 1]), 1.0)
    assert lengths.tolist() == [2, 1]
    found = sorted(map(tuple, np.round(thinned.numpy(), 4).tolist()))
    assert found == [(pytest.approx((0.2, 0.1, 0.1))), (pytest.approx((0.2, 0.2, 0.2))), pytest.approx((1.2, 0.0, 0.0))]


def test_balls_hold_the_points_of_the_same_cloud_within_the_radius_nearest_first():
    points = torch.from_numpy(RNG.random((40, 3))).float()
    lengths, radius = torch.tensor([25, 15]), 0.4
    rows = geotransformer.radius_neighbors(points, points, lengths, lengths, radius).numpy()
    cloud = np.repeat([0, 1], [25, 15])
    distance = np.linalg.norm(points.numpy()[:, None] - points.numpy()[None], axis=2)
    for i, row in enumerate(rows):
        inside = np.flatnonzero((distance[i] < radius) & (cloud == cloud[i]))
        assert row[: len(inside)].tolist() == inside[np.argsort(distance[i][inside])].tolist()
        assert (row[len(inside) :] == 40).all()


class TrueMotion(torch.nn.Module):
    """In place of the network: knows the motion between the clouds in mm, and answers in GeoTransformer's unit."""

    def __init__(self, T, sizes):
        super().__init__()
        self.T, self.sizes = T, sizes

    def forward(self, batch):
        source, target, unit_mm = batch
        R = self.T[:3, :3]
        centre_p, centre_q = source.centre_mm.numpy()[0], target.centre_mm.numpy()[0]
        shift = (R @ centre_p + self.T[:3, 3] - centre_q) / unit_mm
        motion = torch.from_numpy(se3.from_rotation_translation(R, shift))
        p = source.levels[0].points.double() * float(source.scale_mm[0]) / unit_mm
        q = p @ motion[:3, :3].T + motion[:3, 3]
        points = {"src_corr_points": p, "ref_corr_points": q, "corr_scores": torch.ones(len(p))}
        return points | {"estimated_transform": motion}


def test_a_motion_between_centred_clouds_is_that_between_the_clouds():
    T = se3.from_rotation_translation(se3.random_rotation(RNG), [0.3, -0.2, 0.1])
    centres, unit_mm, p = RNG.normal(size=(2, 1, 3)) * 50.0, 7.0, RNG.normal(size=(5, 3))
    source, target = (SimpleNamespace(centre_mm=torch.from_numpy(centre)) for centre in centres)
    moved = geotransformer.to_mm(T, source, target, unit_mm)
    np.testing.assert_allclose(se3.apply(moved, centres[0] + unit_mm * p), centres[1] + unit_mm * se3.apply(T, p))
    output = {
        "src_corr_points": torch.from_numpy(p),
        "ref_corr_points": torch.from_numpy(p),
        "corr_scores": torch.ones(5),
    }
    found = geotransformer.correspondences_mm(output, source, target, unit_mm)
    np.testing.assert_allclose((found.source, found.target), centres + unit_mm * p)


@pytest.mark.parametrize("pose", ["local_to_global", "ransac"])
def test_its_pose_comes_back_in_mm(monkeypatch, pose):
    bone = make_bone("femur", 1)
    target = bone.sample(4000, RNG)[0]
    T = se3.from_rotation_translation(se3.random_rotation(RNG), [40.0, -20.0, 90.0])
    source = se3.apply(se3.inverse(T), target[target[:, 2] < np.median(target[:, 2])])
    sizes = ModelConfig(superpoints=(50, 75))

    def batch(source, target, voxel, patch_size):
        return source, target, float(target.scale_mm[0]) * voxel / VOXEL

    monkeypatch.setattr(Checkout, "at", lambda folder: SimpleNamespace(batch=batch))
    # the baseline sees both clouds relative to their means
    centred = T.copy()
    centred[:3, 3] = se3.apply(T, source.mean(axis=0)[None])[0] - target.mean(axis=0)
    monkeypatch.setattr(geotransformer, "load", lambda code, path: (TrueMotion(centred, sizes), sizes))
    result = GeoTransformer("any", pose).register(source, target)
    assert result.T_target_source is not None
    np.testing.assert_allclose(result.T_target_source, T, atol=1e-3 if pose == "ransac" else 1e-5)


def test_a_unit_is_forty_first_voxels_and_the_motion_is_in_it_too():
    sizes = geotransformer.thinning(ModelConfig(superpoints=(50, 75)))
    points = make_bone("femur", 1).sample(4000, RNG)[0]
    frame = target_frame(points, sizes)
    cloud = build_cloud(points, frame, sizes)
    settings = SimpleNamespace(num_stages=4, init_voxel_size=VOXEL, init_radius=2.5 * VOXEL)
    config = SimpleNamespace(make_cfg=lambda: SimpleNamespace(backbone=settings))
    code = Checkout(config, None, None, lambda pairs, *balls: pairs[0] | {"lengths": [None, torch.tensor([40, 32])]})
    T = torch.cat([torch.eye(3), torch.tensor([[0.5], [0.0], [-0.25]])], dim=1)
    with pytest.raises(InvalidPointCloudError, match="at least 33 voxels; got 32"):
        code.batch(cloud, cloud, frame.voxel, 33)
    batch = code.batch(cloud, cloud, frame.voxel, 32, T)
    scale = VOXEL / frame.voxel
    torch.testing.assert_close(batch["ref_points"], cloud.levels[0].points * scale)
    assert batch["transform"][:3, 3].tolist() == pytest.approx([0.5 * scale, 0.0, -0.25 * scale])
    stages = [len(level.points) for level in cloud.levels]
    assert 50 <= stages[-1] <= 75 and sizes.voxel_growth == 2.0


def test_without_a_checkout_it_says_what_to_fetch(monkeypatch, tmp_path):
    monkeypatch.delenv(CHECKOUT, raising=False)
    with pytest.raises(MethodUnavailableError, match="git clone"):
        Checkout.at()
    with pytest.raises(MethodUnavailableError, match="experiments"):
        Checkout.at(tmp_path)
    with pytest.raises(MethodUnavailableError, match=CHECKOUT):
        methods.make("geotransformer@weights.safetensors")


def test_without_weights_it_says_how_to_train_them():
    with pytest.raises(ConfigError, match=r"gapr_core\.training\.geotransformer"):
        methods.make("geotransformer")
    methods.check(["geotransformer@a.safetensors", "geotransformer_ransac@a.safetensors+point_to_plane"])


def test_targets_that_are_not_whole_are_not_trained_on(tmp_path):
    config = replace(TrainConfig(), mix={"paper": 1.0, "incomplete": 1.0})
    with pytest.raises(ConfigError, match="protocols with whole targets; got incomplete"):
        train(SimpleNamespace(), config, None, tmp_path)


@pytest.mark.skipif(
    CHECKOUT not in os.environ, reason=f"its authors' code does not ship: set {CHECKOUT} to a clone of it"
)
def test_the_authors_code_learns_a_step_and_registers(tmp_path):
    config = replace(TrainConfig(), pairs=2, batch=2, micro_batch=1, mix={"paper": 1.0}, model_settings={"width": 16})
    train(Checkout.at(), config, None, tmp_path)
    made = methods.make(f"geotransformer@{tmp_path / 'weights.safetensors'}")
    target = make_bone("femur", 1).sample(3000, RNG)[0]
    assert made.register(target[:2000], target).method == made.name
    (tmp_path / "weights.safetensors").write_bytes(b"no weights")
    with pytest.raises(WeightsError):
        methods.make(f"geotransformer@{tmp_path / 'weights.safetensors'}")
