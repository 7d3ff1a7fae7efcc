"""The adapter for a checkout of Predator: its operators by brute force, a stand-in of ours for its code, the code."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gapr_core.baselines.base import NoPose
from gapr_core.benchmark import methods, predator
from gapr_core.benchmark.peer import VOXEL
from gapr_core.benchmark.predator import NEIGHBORS, ORIGIN, Checkout
from gapr_core.data.parametric import make_bone
from gapr_core.errors import InvalidPointCloudError, MethodUnavailableError, WeightsError
from gapr_core.geometry import se3
from gapr_core.model.config import ModelConfig
from gapr_core.model.pyramid import build_cloud, target_frame
from gapr_core.training import peer as training
from gapr_core.training.config import TrainConfig
from gapr_core.training.peer import WithVoxel, train
from gapr_core.training.predator import RECENT, Lessons, knows_features

RNG = np.random.default_rng(0)
STAND_IN = {  # written for this test: the names that the adapter asks for, with a network and losses of a few lines
    "configs/train/indoor.yaml": """
model: {first_feats_dim: 128, gnn_feats_dim: 256, num_head: 4, dgcnn_k: 10}
loss: {overlap_radius: 0.0375, w_circle_loss: 1.0, w_overlap_loss: 1.0, w_saliency_loss: 0.0}
demo: {n_points: 200}
""",
    "configs/models.py": "architectures = {'indoor': ['simple']}",
    "kernels/places.txt": "0.5",
    "models/architectures.py": """
from pathlib import Path
import torch

class KPFCNN(torch.nn.Module):
    def __init__(self, config):
        super().__init__()
        self.place = float(Path("kernels/places.txt").read_text())
        self.features = torch.nn.Linear(3, config.first_feats_dim)
        self.scores = torch.nn.Linear(3, 2)

    def forward(self, batch):
        points = batch["points"][0]
        scores = torch.sigmoid(self.scores(points))
        return self.features(points) + self.place, scores[:, 0], scores[:, 1]
""",
    "lib/utils.py": """
import yaml

def load_config(path):
    with open(path) as file:
        return {name: value for group in yaml.safe_load(file).values() for name, value in group.items()}
""",
    "lib/loss.py": """
import torch

class MetricLoss(torch.nn.Module):
    def __init__(self, config):
        super().__init__()

    def forward(self, p, q, f, g, matched, rot, trans, overlap, saliency):
        moved = (rot @ p.T + trans).T
        apart = (moved[matched[:, 0]] - q[matched[:, 1]]).norm(dim=1).to(torch.device("cuda"))
        circle = (f[matched[:, 0]] - g[matched[:, 1]]).norm(dim=1).mean()
        return {"circle_loss": circle, "overlap_loss": overlap.mean(), "saliency_loss": saliency.mean(),
                "recall": (apart < 0.0376).float().mean()}
""",
    "datasets/__init__.py": "",
    "datasets/dataloader.py": """
import cpp_wrappers.cpp_subsampling.grid_subsampling as cpp_subsampling
import cpp_wrappers.cpp_neighbors.radius_neighbors as cpp_neighbors
from datasets.indoor import IndoorDataset
from datasets.modelnet import get_train_datasets, get_test_datasets
import numpy as np
import torch

def collate_fn_descriptor(pairs, config, neighborhood_limits):
    p, q, _, _, rot, trans, matched, p_raw, q_raw, _ = pairs[0]
    points, lengths = torch.from_numpy(np.concatenate([p, q])), torch.tensor([len(p), len(q)])
    near = cpp_neighbors.batch_query(points, points, lengths, lengths, radius=0.0625)[:, :neighborhood_limits[0]]
    coarse, counts = cpp_subsampling.subsample_batch(points, lengths, sampleDl=0.2, max_p=0, verbose=0)
    return {"points": [points, torch.from_numpy(coarse)], "stack_lengths": [lengths, torch.from_numpy(counts)],
            "neighbors": [torch.from_numpy(near)], "rot": torch.from_numpy(rot), "trans": torch.from_numpy(trans),
            "correspondences": matched, "src_pcd_raw": torch.from_numpy(p_raw), "tgt_pcd_raw": torch.from_numpy(q_raw)}
""",
}


@pytest.fixture
def stand_in(tmp_path):
    folder = tmp_path / "OverlapPredator"
    for name, text in STAND_IN.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def test_its_voxels_hold_the_means_of_their_points_cloud_by_cloud():
    points = torch.from_numpy(RNG.normal(size=(60, 3))).float()
    thinned, lengths = predator.subsample_batch(points, torch.tensor([35, 25]), sampleDl=0.7, max_p=0, verbose=0)
    expected = []
    for cloud in points.double().numpy()[:35], points.double().numpy()[35:]:
        cells = [tuple(cell) for cell in np.floor(cloud / 0.7).astype(int)]
        rows = [[i for i, own in enumerate(cells) if own == cell] for cell in set(cells)]
        expected.append({tuple(np.round(cloud[own].mean(axis=0), 4)) for own in rows})
    assert lengths.tolist() == [len(cloud) for cloud in expected] and lengths.dtype == np.int32
    first, second = (set(map(tuple, np.round(x.astype(float), 4))) for x in np.split(thinned, [lengths[0]]))
    assert first == expected[0] and second == expected[1] and thinned.dtype == np.float32


def test_its_balls_hold_all_points_of_the_same_cloud_nearest_first_and_are_as_wide_as_the_fullest():
    points, queries = (torch.from_numpy(RNG.random((count, 3))).float() for count in (300, 30))
    counts, asks = torch.tensor([200, 100]), torch.tensor([10, 20])
    rows = predator.batch_query(queries, points, asks, counts, radius=0.6)
    distance = np.linalg.norm(queries.double().numpy()[:, None] - points.double().numpy()[None], axis=2)
    alike = np.repeat([0, 1], asks)[:, None] == np.repeat([0, 1], counts)
    inside = [np.flatnonzero(own) for own in (distance < 0.6) & alike]
    assert rows.shape == (30, max(map(len, inside))) and rows.shape[1] > 64
    for i, row in enumerate(rows):
        assert row[: len(inside[i])].tolist() == inside[i][np.argsort(distance[i][inside[i]])].tolist()
        assert (row[len(inside[i]) :] == 300).all()


def test_points_within_the_radius_of_each_other_are_matched_and_no_others():
    p, q = RNG.random((30, 3)), RNG.random((40, 3))
    found = predator.near(p, q, 0.2)
    apart = np.linalg.norm(p[:, None] - q[None], axis=2)
    assert sorted(found.tolist()) == np.argwhere(apart <= 0.2).tolist()
    assert predator.near(p, q + 10.0, 0.2).shape == (0, 2)


def test_points_are_drawn_by_their_scores_each_at_most_once():
    scores = np.r_[np.full(50, 1.0), np.full(50, 1e-12)]
    assert predator.sampled(scores, 100, RNG).tolist() == list(range(100))
    rows = predator.sampled(scores, 40, RNG)
    assert len(set(rows.tolist())) == 40 and max(rows) < 50


def code(**settings):
    return Checkout(Path(), None, None, None, settings)


def output_of(p, q, features_p, features_q, scores_p, scores_q):
    features, scores = np.concatenate([features_p, features_q]), np.concatenate([scores_p, scores_q])
    batch = {"points": [torch.from_numpy(np.concatenate([p, q]))], "stack_lengths": [torch.tensor([len(p), len(q)])]}
    return (torch.from_numpy(features), torch.from_numpy(scores), torch.ones(len(scores))), batch


def test_each_source_point_is_matched_to_the_target_point_of_the_nearest_feature():
    p, q = RNG.random((8, 3)), RNG.random((12, 3))
    order = RNG.permutation(12)[:8]
    features = RNG.normal(size=(12, 6))
    scores = RNG.random(8), RNG.random(12)
    found = code(n_points=100).matches(*output_of(p, q, features[order], features, *scores))
    np.testing.assert_array_equal(found.source, p)
    np.testing.assert_array_equal(found.target, q[order])
    np.testing.assert_allclose(found.score, scores[0] * scores[1][order])


def test_matches_are_among_the_points_with_the_highest_scores_only():
    p, features = RNG.random((60, 3)), RNG.normal(size=(60, 6))
    scores = np.r_[np.full(20, 1.0), np.full(40, 0.0)]
    found = code(n_points=20).matches(*output_of(p, p, features, features, scores, scores))
    assert (
        {tuple(row) for row in found.source} == {tuple(row) for row in found.target} == {tuple(row) for row in p[:20]}
    )


def test_its_own_registration_finds_a_motion_among_wrong_matches():
    pytest.importorskip("open3d", reason="RANSAC of its own pose: pip install open3d")
    T = se3.from_rotation_translation(se3.random_rotation(RNG), [0.4, -0.3, 0.1])
    p, features = RNG.random((150, 3)), RNG.normal(size=(150, 6))
    q = se3.apply(T, p)
    q[:75] = RNG.random((75, 3)) + 3.0
    output, batch = output_of(p, q, features, features, np.ones(150), np.ones(150))
    np.testing.assert_allclose(code(n_points=500).own_pose(output, batch), T, atol=1e-6)
    batch["points"][0][150:] = torch.from_numpy(RNG.random((150, 3)) * 100.0)
    with pytest.raises(NoPose, match="three of 150"):
        code(n_points=500).own_pose(output, batch)


def test_saliency_is_learned_once_features_find_their_matches():
    poor, good = {"recall": 0.1}, {"recall": 0.5}
    assert not knows_features([good] * (RECENT - 1))
    assert knows_features([poor] * 5 + [good] * RECENT)
    assert not knows_features([good] * RECENT + [poor] * RECENT)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("models/architectures.py", "class Renamed: pass"),
        ("models/architectures.py", None),
        ("configs/models.py", "architectures = {}"),
    ],
)
def test_another_layout_is_refused(stand_in, name, text):
    (stand_in / name).unlink() if text is None else (stand_in / name).write_text(text)
    with pytest.raises(MethodUnavailableError, match="code of Predator as its authors publish it"):
        Checkout.at(stand_in)


def test_it_is_given_both_clouds_in_its_unit_with_what_lies_on_what(stand_in):
    made, sizes = Checkout.at(stand_in), ModelConfig(superpoints=(50, 75), width=16)
    points = make_bone("femur", 1).sample(4000, RNG)[0]
    frame = target_frame(points, sizes)
    target, source = build_cloud(points, frame, sizes), build_cloud(points[points[:, 2] > 0], frame, sizes)
    shift = (source.centre_mm - target.centre_mm)[0] / frame.scale_mm
    T = torch.cat([torch.eye(3), shift.float()[:, None]], dim=1)
    batch = made.batch(source, target, frame.voxel, sizes, T)
    p, q = (cloud.levels[0].points * VOXEL / frame.voxel for cloud in (source, target))
    torch.testing.assert_close(batch["points"][0], torch.cat([p, q]))
    i, j = batch["correspondences"].T
    moved = p @ batch["rot"].T + batch["trans"].T
    assert len(set(i.tolist())) > 0.9 * len(p)
    assert float((moved[i] - q[j]).norm(dim=1).max()) <= 1.5 * VOXEL + 1e-6
    assert made.settings(sizes).first_feats_dim == 32 and batch["neighbors"][0].shape[1] <= NEIGHBORS[0]
    assert not len(made.batch(source, target, frame.voxel, sizes)["correspondences"])
    made.defaults["dgcnn_k"] = 1000
    with pytest.raises(InvalidPointCloudError, match="more than 1000 superpoints"):
        made.batch(source, target, frame.voxel, sizes)


CONFIG = replace(TrainConfig(), pairs=4, batch=2, micro_batch=1, mix={"paper": 1.0}, pool=2, share=1)


def test_a_stand_in_of_a_checkout_learns_goes_on_after_a_stop_and_registers(monkeypatch, stand_in, tmp_path):
    before = Path.cwd(), set(sys.modules)
    made = Checkout.at(stand_in)
    config = replace(CONFIG, model_settings={"width": 16})
    drawn, draw = [], WithVoxel.pair

    def stopped(self, number):
        if number == 2:
            raise KeyboardInterrupt
        return draw(self, number)

    monkeypatch.setattr(training, "SAVE_S", -1.0)  # after every step
    monkeypatch.setattr(WithVoxel, "pair", stopped)
    with pytest.raises(KeyboardInterrupt):
        train(made, Lessons, config, None, tmp_path)
    monkeypatch.setattr(WithVoxel, "pair", lambda self, number: drawn.append(number) or draw(self, number))
    train(made, Lessons, config, None, tmp_path)
    assert drawn == [2, 3]
    log = (tmp_path / "log.csv").read_text().splitlines()
    assert log[0] == "step,pairs,left_out,loss,circle_loss,overlap_loss,saliency_loss,recall" and len(log) == 3
    step = dict(zip(log[0].split(","), map(float, log[1].split(",")), strict=True))
    assert step["recall"] == 1.0 and step["loss"] == pytest.approx(step["circle_loss"] + step["overlap_loss"], rel=1e-3)
    monkeypatch.setenv("PREDATOR", str(stand_in))
    target = make_bone("femur", 1).sample(3000, RNG)[0]
    for name in ("predator", "predator_ransac"):
        method = methods.make(f"{name}@{tmp_path / 'weights.safetensors'}")
        assert method.register(target[:2000], target).method == method.name
    assert Path.cwd() == before[0]
    assert not {"models", "lib", "configs", "datasets", "cpp_wrappers"} & (set(sys.modules) - before[1])


@pytest.mark.skipif(
    ORIGIN.variable not in os.environ, reason=f"its authors' code does not ship: set {ORIGIN.variable} to a clone of it"
)
def test_the_authors_code_learns_a_step_and_registers(tmp_path):
    config = replace(CONFIG, pairs=2, model_settings={"width": 16})
    train(Checkout.at(), Lessons, config, None, tmp_path)
    made = methods.make(f"predator@{tmp_path / 'weights.safetensors'}")
    target = make_bone("femur", 1).sample(3000, RNG)[0]
    assert made.register(target[:2000], target).method == made.name
    (tmp_path / "weights.safetensors").write_bytes(b"no weights")
    with pytest.raises(WeightsError):
        methods.make(f"predator@{tmp_path / 'weights.safetensors'}")
