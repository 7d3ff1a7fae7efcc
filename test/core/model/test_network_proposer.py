from __future__ import annotations

import os

import numpy as np
import pytest
import torch

from gapr_core import Registrar
from gapr_core.config import SourceConfig
from gapr_core.geometry import se3
from gapr_core.model import weights
from gapr_core.model.network import GAPRNet
from gapr_core.registration.confidence.classifier import Classifier
from gapr_core.registration.problem import source as sources
from gapr_core.registration.problem import target as targets
from gapr_core.registration.proposals import consensus, network
from gapr_core.registration.proposals.network import RADIUS_VOXELS, SHIPPED, SMALLEST_VOXEL_MM, NetworkProposer


@pytest.fixture(scope="module")
def pair(toy):
    rng = np.random.default_rng(0)
    moved = se3.apply(toy.motion(3), toy.view(toy.bone(3000, 1))) + rng.normal(0, 0.3, (1500, 3))
    return sources.prepare(moved), targets.prepare(toy.bone(3000))


def proposer(toy):
    torch.manual_seed(0)
    return NetworkProposer(GAPRNet(toy.small_config()))


def test_proposals_are_rigid_poses_best_first(toy, pair, monkeypatch):
    one, asked = proposer(toy), []
    found_mm = network.correspondences_mm
    monkeypatch.setattr(network, "correspondences_mm", lambda *each: asked.append(found_mm(*each)) or asked[-1])
    found = one.propose(*pair, np.random.default_rng(0))
    assert found.shape == (len(found), 4, 4) and len(found) > 1
    frame = one.prepare(pair[1])[0]
    radius_mm = RADIUS_VOXELS * max(SMALLEST_VOXEL_MM, frame.voxel * frame.scale_mm)
    scores = consensus._support(found, asked[0], radius_mm).sum(axis=1)
    assert (np.diff(scores) <= 0).all() and np.allclose(np.linalg.det(found[:, :3, :3]), 1.0)


def test_the_share_of_the_target_is_computed_once(toy, pair, monkeypatch):
    target = targets.prepare(toy.bone(3000))
    one = proposer(toy)
    first = one.propose(pair[0], target, np.random.default_rng(0))
    assert len(target.cache) == 1
    calls = []
    forward = type(one.network.backbone).forward
    monkeypatch.setattr(
        type(one.network.backbone), "forward", lambda self, c: calls.append(len(c.fine.points)) or forward(self, c)
    )
    second = one.propose(pair[0], target, np.random.default_rng(0))
    assert len(calls) == 1 and np.array_equal(first, second)


def test_moving_the_source_moves_every_proposal(toy, pair):
    T = toy.motion(9)
    moved = sources.prepare(se3.apply(T, pair[0].points))
    one = proposer(toy)
    still, after = (one.propose(s, pair[1], np.random.default_rng(0)) for s in (pair[0], moved))
    shift, turn = se3.pose_error(after[0] @ T, still[0], pair[0].points)
    assert shift < 0.05 and turn < 0.05


def test_the_network_sees_all_points_of_which_some_are_fitted(toy, pair):
    one, all_points = proposer(toy), pair[0].points
    part = sources.prepare(all_points, SourceConfig(fitted_points=400))
    assert part.is_part and len(part.points) <= 400
    found, expected = (one.propose(each, pair[1], np.random.default_rng(0)) for each in (part, pair[0]))
    assert np.array_equal(found, expected)


def test_saved_weights_propose_what_the_network_proposed(toy, pair, tmp_path):
    one = proposer(toy)
    weights.save(one.network, tmp_path / "w.safetensors")
    first, second = (
        p.propose(*pair, np.random.default_rng(0))
        for p in (one, NetworkProposer.from_weights(tmp_path / "w.safetensors"))
    )
    assert np.array_equal(first, second)


def test_of_other_weights_than_the_shipped_ones_it_is_said_that_no_confidence_was_fitted_to_them(toy, tmp_path, caplog):
    weights.save(proposer(toy).network, tmp_path / "w.safetensors")
    own = NetworkProposer.from_weights(tmp_path / "w.safetensors")
    for path in (SHIPPED, os.path.relpath(SHIPPED)):
        Registrar(proposers=[NetworkProposer.from_weights(path)])
    Registrar(proposers=[own], classifier=Classifier.load())
    assert not caplog.messages
    Registrar(proposers=[own])
    assert "fitted to the shipped weights, and this network has others" in caplog.text


def test_networks_of_the_same_weights_share_the_work_on_a_target_and_others_do_not(toy, pair, tmp_path):
    path = tmp_path / "w.safetensors"
    weights.save(proposer(toy).network, path)
    target = targets.prepare(toy.bone(3000))
    for _ in range(2):
        NetworkProposer.from_weights(path).prepare(target)
    assert len(target.cache) == 1
    torch.manual_seed(1)
    weights.save(GAPRNet(toy.small_config()), path)  # the same file, other weights
    NetworkProposer.from_weights(path).prepare(target)
    assert len(target.cache) == 2
    for _ in range(2):
        proposer(toy).prepare(target)  # without a name every network is its own
    assert len(target.cache) == 4
