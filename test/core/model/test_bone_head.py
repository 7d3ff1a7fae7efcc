from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from gapr_core.data.protocols import make_pair
from gapr_core.data.specimen import Specimen
from gapr_core.geometry import se3
from gapr_core.metrics import auroc
from gapr_core.model import weights
from gapr_core.model.bone_head import BelieveAll, ancestors
from gapr_core.model.network import GAPRNet
from gapr_core.model.pyramid import build_cloud, target_frame
from gapr_core.registration.problem import source as sources
from gapr_core.registration.problem import target as targets
from gapr_core.registration.proposals.network import SHIPPED, NetworkProposer
from gapr_core.training.config import TrainConfig
from gapr_core.training.losses import bone_loss, compute_losses
from gapr_core.training.targets import join, training_pair

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def cluttered(toy):
    """Half a bone with a plate of other points next to it: which fine points are bone is known."""
    config = toy.small_config(bone_head="mlp", width=8, superpoints=(10, 20))
    rng = np.random.default_rng(0)
    plate = rng.uniform(-60, 60, (200, 3)) * [1.0, 1.0, 0.02] + [0.0, 0.0, 90.0]
    frame, T = target_frame(toy.bone(), config), toy.motion(3)
    source = build_cloud(se3.apply(T, np.vstack([toy.view(toy.bone(700, 1)), plate])), frame, config)
    return training_pair(source, build_cloud(toy.bone(), frame, config), se3.inverse(T), frame), frame, config


def test_the_label_is_whether_a_point_lies_on_the_target(cluttered):
    pair, frame, _ = cluttered
    T = np.vstack([pair.T[0].double().numpy(), [0, 0, 0, 1]])
    z = se3.apply(T, pair.source.fine.points.numpy())[:, 2] * frame.scale_mm
    height = 90.0 - float(pair.target.centre_mm[0, 2])
    on_plate = np.abs(z - height) < 5.0
    assert on_plate.any() and not pair.is_bone.numpy()[on_plate].any()
    assert pair.is_bone.numpy()[~on_plate].mean() > 0.8


def test_the_head_learns_which_points_are_bone_and_matches_of_others_lose_their_score(cluttered):
    pair, _, config = cluttered
    torch.manual_seed(0)
    net = GAPRNet(config)
    optimizer = torch.optim.AdamW(net.parameters(), 3e-3)
    for step in range(30):
        losses, _ = compute_losses(net, pair, torch.Generator().manual_seed(step))
        optimizer.zero_grad()
        losses.total.backward()
        optimizer.step()
    with torch.inference_mode():
        out = net.eval()(pair.source, pair.target)
        believing = net.fine_matching.correspondences(pair.source, pair.target, out.fine, out.chosen)
    right = ((out.bone > 0) == pair.is_bone).float().mean()
    assert right > max(0.9, float(pair.is_bone.float().mean()) + 0.02)
    assert (out.matches.score <= believing.score).all() and (out.matches.score < 0.9 * believing.score).any()


def test_without_a_head_nothing_changes_and_nothing_is_learned(clouds, config):
    net = GAPRNet(config).eval()
    assert isinstance(net.bone_head, BelieveAll) and not list(net.bone_head.parameters())
    with torch.inference_mode():
        out = net(*clouds[:2])
        plain = net.fine_matching.correspondences(*clouds[:2], out.fine, out.chosen)
    assert torch.equal(out.matches.score, plain.score)
    assert bone_loss(out.bone, torch.zeros(len(out.bone), dtype=torch.bool)) == 0.0


def test_a_head_that_changes_no_score_leaves_every_match_as_it_is(clouds, toy):
    config = toy.small_config(bone_head="mlp", bone_scores=False)
    torch.manual_seed(0)
    silent, bare = GAPRNet(config).eval(), GAPRNet(replace(config, bone_head="none")).eval()
    weighing = GAPRNet(replace(config, bone_scores=True)).eval()
    bare.load_state_dict({name: t for name, t in silent.state_dict().items() if not name.startswith("bone_head.")})
    weighing.load_state_dict(silent.state_dict())
    with torch.inference_mode():
        said, without, weighed = (net(*clouds[:2]) for net in (silent, bare, weighing))
    assert torch.isfinite(said.bone).all()
    for name in ("source", "target", "score", "patch"):
        assert torch.equal(getattr(said.matches, name), getattr(without.matches, name))
    assert (weighed.matches.score < said.matches.score).all()


def test_the_shipped_weights_are_those_of_the_stage_that_their_card_names():
    """No laser and no structured light: nobody but those who judge has seen them."""
    network, card = weights.load(SHIPPED)
    assert network.config.bone_head == "mlp" and not network.config.bone_scores
    config = TrainConfig.from_yaml(ROOT / "config/train_further.yaml")
    assert not card.get("mean_with") and card["step"] == config.pairs // config.batch
    assert card["run"]["trained"] == "all" and card["run"]["pairs"] == config.pairs
    assert card["run"]["mix"] == dict(config.mix) and not {"laser", "structured-light"} & set(config.mix)


def test_the_shipped_features_and_matches_are_those_of_the_network_without_its_head(femur_cloud):
    network = weights.load(SHIPPED)[0]
    bare = GAPRNet(replace(network.config, bone_head="none")).eval()
    bare.load_state_dict({name: t for name, t in network.state_dict().items() if not name.startswith("bone_head.")})
    frame = target_frame(femur_cloud, network.config)
    source = build_cloud(femur_cloud[femur_cloud[:, 2] > np.median(femur_cloud[:, 2])], frame, network.config)
    target = build_cloud(femur_cloud, frame, network.config)
    with torch.inference_mode():
        one, other = network(source, target), bare(source, target)
    for name in ("source", "target"):
        assert torch.equal(getattr(one.aggregated, name), getattr(other.aggregated, name))
    for name in ("source", "target", "score", "patch"):
        assert torch.equal(getattr(one.matches, name), getattr(other.matches, name))


def test_the_shipped_head_tells_bone_from_what_lies_around_it_in_a_scene(femur):
    specimen = Specimen(femur, "femur", "3", "parametric")
    proposer = NetworkProposer.from_weights(SHIPPED)
    for level in ("scene-C2", "scene-C3"):
        pair = make_pair(level, specimen, 5)
        source = sources.prepare(pair.source)
        said = proposer.bone(source, targets.prepare(pair.target))
        is_bone = pair.metadata["is_bone"][cKDTree(pair.source).query(source.points)[1]]
        assert said.shape == (len(source.points),) and ((said > 0.0) & (said < 1.0)).all()
        assert auroc(said, is_bone) > 0.8


def test_without_a_head_every_point_is_bone(femur, femur_cloud, config):
    source = sources.prepare(femur_cloud[:1500])
    said = NetworkProposer(GAPRNet(config)).bone(source, targets.prepare(femur_cloud))
    assert (said == 1.0).all() and said.shape == (len(source.points),)


def test_the_superpoint_of_a_point_is_found_level_by_level(clouds):
    cloud, index = clouds[1], []
    for point in range(len(cloud.fine.points)):
        for level in cloud.levels[:-1]:
            point = int(level.up[point])
        index.append(point)
    assert ancestors(cloud).tolist() == index


def test_labels_of_a_batch_are_those_of_its_pairs(cluttered):
    pair = cluttered[0]
    assert torch.equal(join([pair, pair]).is_bone, torch.cat([pair.is_bone, pair.is_bone]))


def test_the_loss_is_the_mean_cross_entropy():
    logits, labels = torch.tensor([0.0, 2.0]), torch.tensor([True, False])
    expected = 0.5 * (np.log(2.0) + np.log(1.0 + np.exp(2.0)))
    assert float(bone_loss(logits, labels)) == pytest.approx(expected, rel=1e-6)
