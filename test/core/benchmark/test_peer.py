"""What networks of others share: operators, units, poses in mm, an import that leaves nothing behind, messages."""

from __future__ import annotations

import importlib
import json
import sys
from dataclasses import replace
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from gapr_core.benchmark import checkout, methods, peer
from gapr_core.benchmark.checkout import Origin
from gapr_core.benchmark.peer import VOXEL, Matches, Peer
from gapr_core.data.parametric import make_bone
from gapr_core.errors import ConfigError, MethodUnavailableError, WeightsError
from gapr_core.geometry import se3
from gapr_core.model.config import ModelConfig
from gapr_core.model.pyramid import build_cloud, target_frame
from gapr_core.training import peer as training
from gapr_core.training.config import TrainConfig

RNG = np.random.default_rng(0)
ORIGIN = Origin("peer_of_a_test", "Peer", "https://example.org/peer", "own/network.py", "a_library")


@pytest.mark.parametrize("most", [40, None])
def test_balls_hold_the_points_of_the_same_cloud_within_the_radius_nearest_first(most):
    points, queries = RNG.random((40, 3)), RNG.random((30, 3))
    radius, cloud, asks = 0.4, np.repeat([0, 1], [25, 15]), np.repeat([0, 1], [10, 20])
    rows = checkout.balls(queries, points, [10, 20], [25, 15], radius, most)
    distance = np.linalg.norm(queries[:, None] - points[None], axis=2)
    fullest = 0
    for i, row in enumerate(rows):
        inside = np.flatnonzero((distance[i] < radius) & (cloud == asks[i]))
        assert row[: len(inside)].tolist() == inside[np.argsort(distance[i][inside])].tolist()
        assert (row[len(inside) :] == 40).all()
        fullest = max(fullest, len(inside))
    assert rows.shape == (30, most or fullest)


def test_a_ball_may_hold_a_single_point():
    points = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    assert checkout.balls(points, points, [2], [2], 1.0).tolist() == [[0], [1]]


def test_a_motion_between_centred_clouds_is_that_between_the_clouds():
    T = se3.from_rotation_translation(se3.random_rotation(RNG), [0.3, -0.2, 0.1])
    centres, unit_mm, p = RNG.normal(size=(2, 1, 3)) * 50.0, 7.0, RNG.normal(size=(5, 3))
    source, target = (SimpleNamespace(centre_mm=torch.from_numpy(centre)) for centre in centres)
    moved = peer.to_mm(T, source, target, unit_mm)
    np.testing.assert_allclose(se3.apply(moved, centres[0] + unit_mm * p), centres[1] + unit_mm * se3.apply(T, p))
    found = peer.correspondences_mm(Matches(p, p, np.ones(5)), source, target, unit_mm)
    np.testing.assert_allclose((found.source, found.target), centres + unit_mm * p)


def test_a_unit_is_forty_first_voxels_and_the_motion_is_in_it_too():
    sizes = peer.thinning(ModelConfig(superpoints=(50, 75)))
    points = make_bone("femur", 1).sample(4000, RNG)[0]
    frame = target_frame(points, sizes)
    cloud = build_cloud(points, frame, sizes)
    T = torch.cat([torch.eye(3), torch.tensor([[0.5], [0.0], [-0.25]])], dim=1)
    p, q, motion = peer.scaled(cloud, cloud, frame.voxel, T)
    scale = VOXEL / frame.voxel
    torch.testing.assert_close(q, cloud.levels[0].points * scale)
    torch.testing.assert_close(p, q)
    assert motion[:3, 3].tolist() == pytest.approx([0.5 * scale, 0.0, -0.25 * scale])
    torch.testing.assert_close(peer.scaled(cloud, cloud, frame.voxel, None)[2], torch.eye(4))
    assert 50 <= len(cloud.levels[-1].points) <= 75 and sizes.voxel_growth == 2.0


class TrueMotion:
    """In place of a checkout: knows the motion between the clouds in mm, and answers in the unit of a network."""

    origin = ORIGIN

    def __init__(self, T):
        self.T = T

    def batch(self, source, target, voxel, sizes):
        return source, target, float(target.scale_mm[0]) * voxel / VOXEL

    def own_pose(self, output, batch):
        source, target, unit_mm = batch
        R = self.T[:3, :3]
        centre_p, centre_q = source.centre_mm.numpy()[0], target.centre_mm.numpy()[0]
        return se3.from_rotation_translation(R, (R @ centre_p + self.T[:3, 3] - centre_q) / unit_mm)

    def matches(self, output, batch):
        source, _, unit_mm = batch
        p = source.levels[0].points.double().numpy() * float(source.scale_mm[0]) / unit_mm
        return Matches(p, se3.apply(self.own_pose(output, batch), p), np.ones(len(p)))


@pytest.mark.parametrize("pose", ["own", "ransac"])
def test_its_pose_comes_back_in_mm(monkeypatch, pose):
    target = make_bone("femur", 1).sample(4000, RNG)[0]
    T = se3.from_rotation_translation(se3.random_rotation(RNG), [40.0, -20.0, 90.0])
    source = se3.apply(se3.inverse(T), target[target[:, 2] < np.median(target[:, 2])])
    sizes = ModelConfig(superpoints=(50, 75))
    monkeypatch.setattr(peer, "load", lambda code, path: (torch.nn.Identity(), sizes))
    # the baseline sees both clouds relative to their means
    centred = T.copy()
    centred[:3, 3] = se3.apply(T, source.mean(axis=0)[None])[0] - target.mean(axis=0)
    result = Peer(TrueMotion(centred), "any", pose).register(source, target)
    assert result.T_target_source is not None
    np.testing.assert_allclose(result.T_target_source, T, atol=1e-3 if pose == "ransac" else 1e-5)
    assert result.method == ("peer_of_a_test@any" if pose == "own" else "peer_of_a_test_ransac@any")


def write(folder, **modules):
    for name, text in modules.items():
        path = folder.joinpath(*name.split("__")).with_suffix(".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def test_modules_of_a_checkout_hide_others_of_their_name_only_while_it_is_imported(monkeypatch, tmp_path):
    write(tmp_path, own__network="import own.operators as compiled\nVALUE = compiled.VALUE")
    mine, operators = ModuleType("own"), ModuleType("own.operators")
    monkeypatch.setitem(sys.modules, "own", mine)
    operators.VALUE = 7
    before = list(sys.path)
    with ORIGIN.importing([tmp_path], ["own"], {"own.operators": operators}):
        assert importlib.import_module("own.network").VALUE == 7
    assert sys.modules["own"] is mine and sys.path == before
    assert not {"own.network", "own.operators"} & set(sys.modules)


@pytest.mark.parametrize(
    ("text", "needed"),
    [
        ("import a_library_that_is_not_there", "libraries that Peer needs.*pip install a_library"),
        ("import own.moved", "code of Peer as its authors publish it.*git clone https://example.org/peer"),
        ("import math; math.no_such_thing", "code of Peer as its authors publish it"),
    ],
)
def test_what_a_checkout_lacks_is_said(tmp_path, text, needed):
    write(tmp_path, own__network=text)
    with pytest.raises(MethodUnavailableError, match=needed), ORIGIN.importing([tmp_path], ["own"], {}):
        importlib.import_module("own.network")
    assert not [name for name in sys.modules if name.partition(".")[0] == "own"]


def test_without_a_checkout_it_says_what_to_fetch(monkeypatch, tmp_path):
    monkeypatch.delenv(ORIGIN.variable, raising=False)
    with pytest.raises(MethodUnavailableError, match="PEER_OF_A_TEST; got none; git clone https://example.org/peer"):
        ORIGIN.find(None)
    with pytest.raises(MethodUnavailableError, match="without own/network.py"):
        ORIGIN.find(tmp_path)
    write(tmp_path, own__network="")
    assert ORIGIN.find(tmp_path) == tmp_path.resolve()
    monkeypatch.setenv(ORIGIN.variable, str(tmp_path))
    assert ORIGIN.find(None) == tmp_path.resolve()


@pytest.mark.parametrize("name", methods.PEERS)
def test_without_weights_it_says_how_to_train_them(monkeypatch, name):
    with pytest.raises(ConfigError, match=rf"gapr_core\.training\.{name}"):
        methods.make(name)
    methods.check([f"{name}@a.safetensors", f"{name}_ransac@a.safetensors+point_to_plane"])
    monkeypatch.delenv(name.upper(), raising=False)
    with pytest.raises(MethodUnavailableError, match=name.upper()):
        methods.make(f"{name}@weights.safetensors")


@pytest.mark.parametrize("name", ["gapr_paper@", "predator@+point_to_plane", "geotransformer_ransac@"])
def test_a_name_that_ends_before_its_weights_is_refused(name):
    """As of a variable of the shell that is not set: the shipped network answered instead."""
    for ask in (methods.make, lambda name: methods.check([name]), methods.made_of):
        with pytest.raises(ConfigError, match="@WEIGHTS; got no weights in"):
            ask(name)


def code_of(name, width=3):
    return SimpleNamespace(
        origin=Origin(name, name.title(), "", "", ""), network=lambda sizes: torch.nn.Linear(width, width)
    )


def test_weights_come_back_with_their_sizes_and_those_of_another_network_are_refused(tmp_path):
    path, sizes, network = tmp_path / "weights.safetensors", ModelConfig(width=16), torch.nn.Linear(3, 3)
    peer.save(code_of("first"), network, sizes, path, {"pairs": 8})
    loaded, its = peer.load(code_of("first"), path)
    assert its == sizes and torch.equal(loaded.weight, network.weight) and not loaded.training
    with pytest.raises(WeightsError, match=r"weights of Second .*second/1.*got format first/1.*training\.second"):
        peer.load(code_of("second"), path)
    with pytest.raises(WeightsError, match="weights of First.*size mismatch for weight"):
        peer.load(code_of("first", width=4), path)
    path.write_bytes(b"no weights")
    with pytest.raises(WeightsError, match="weights of First"):
        peer.load(code_of("first"), path)
    with pytest.raises(WeightsError, match="weights of First"):
        peer.load(code_of("first"), tmp_path / "none")


def test_tensors_stay_on_the_cpu_where_the_code_would_move_them():
    with checkout.without_cuda():
        tensor = torch.ones(2).cuda().to(torch.device("cuda"))
        assert tensor.device.type == "cpu"
        assert tensor.to(torch.float64).dtype == torch.float64
    assert torch.Tensor.to(torch.ones(2), torch.device("cpu")).device.type == "cpu"


class Sum:
    """A lesson whose loss is five times the sum of the weights; every second pair teaches nothing."""

    names = ("loss",)

    def __init__(self, code, sizes):
        self.pairs = 0

    def __call__(self, network, pair, voxel, log):
        self.pairs += 1
        return {"loss": 5.0 * network.weight.sum()} if self.pairs % 2 else None


@pytest.fixture
def learner():
    """Makes one that learns from parametric bones, two pairs a step."""
    config = TrainConfig(pairs=4, batch=2, micro_batch=1, mix={"L1": 1.0}, pool=2, share=1, bones=("femur",),
                         model_settings={"width": 16})  # fmt: skip
    return lambda: training.Learner(code_of("first"), Sum, config, None)


def test_a_step_learns_by_the_mean_over_the_pairs_of_its_batch(learner):
    """One of two taught: half of its gradient, which is five in each weight."""
    one = learner()
    assert [one._learn(number) is None for number in range(2)] == [False, True]
    assert torch.equal(one.network.weight.grad, torch.full((3, 3), 5.0 / 2.0))


def test_how_many_pairs_taught_nothing_is_counted_on_after_a_stop(learner):
    first, second = learner(), learner()
    first.step(0.001)
    second.go_on(first.state())
    second.step(0.001)
    rows = [line.split(",")[:3] for line in second.table().splitlines()]
    assert rows == [["step", "pairs", "left_out"], ["1", "2", "1"], ["2", "4", "2"]]
    assert second.card()["left_out"] == 2 and second.steps_done == 2


class Chance:
    """A lesson whose loss is drawn at random, by torch and by NumPy; it is stopped before one of its pairs."""

    names = ("loss",)
    stops_before = 99

    def __init__(self, code, sizes):
        self.pairs = 0

    def __call__(self, network, pair, voxel, log):
        self.pairs += 1
        if self.pairs == self.stops_before:
            raise KeyboardInterrupt
        return {"loss": (torch.rand(()) + np.random.random()) * network.weight.sum()}


class Stopped(Chance):
    stops_before = 6


@pytest.fixture
def config():
    """Four steps of two pairs of parametric bones."""
    return TrainConfig(pairs=8, batch=2, micro_batch=1, mix={"L1": 1.0}, pool=2, share=1, bones=("femur",),
                       model_settings={"width": 16})  # fmt: skip


def test_a_run_that_was_stopped_ends_as_one_that_was_not(config, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "SAVE_S", -1.0)  # after every step
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    whole.mkdir()
    parts.mkdir()
    training.train(code_of("first"), Chance, config, None, whole)
    with pytest.raises(KeyboardInterrupt):
        training.train(code_of("first"), Stopped, config, None, parts)
    assert len((parts / "log.csv").read_text().splitlines()) == 3  # two of four steps
    training.train(code_of("first"), Chance, config, None, parts)
    assert (parts / "log.csv").read_text() == (whole / "log.csv").read_text()
    assert torch.equal(peer.load(code_of("first"), parts / "weights.safetensors")[0].weight,
                       peer.load(code_of("first"), whole / "weights.safetensors")[0].weight)  # fmt: skip


def test_a_folder_of_another_run_is_refused(config, tmp_path):
    training.train(code_of("first"), Chance, config, None, tmp_path)
    before = (tmp_path / "weights.safetensors").read_bytes()
    for other in ({"seed": 7}, {"pairs": 16}, {"mix": {"L2": 1.0}}, {"learning_rate": 0.1}):
        with pytest.raises(ConfigError, match="settings this folder was begun with"):
            training.train(code_of("first"), Chance, replace(config, **other), None, tmp_path)
    with pytest.raises(ConfigError, match="a run of second; got one of first"):
        training.train(code_of("second"), Chance, config, None, tmp_path)
    assert (tmp_path / "weights.safetensors").read_bytes() == before
    assert json.loads((tmp_path / "provenance.json").read_text())[0]["step"] == 0
