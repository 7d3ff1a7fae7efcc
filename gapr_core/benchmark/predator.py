"""Predator (Huang et al., CVPR 2021) by its authors, from a checkout. No line of it is here.

git clone https://github.com/prs-eth/OverlapPredator && pip install scikit-learn matplotlib open3d
python -m gapr_core.training.predator --checkout OverlapPredator --anatomy DIR --pairs 3000 --out runs/peer
PREDATOR=OverlapPredator gapr benchmark --methods predator@runs/peer/weights.safetensors ...

Its network and losses run as they are, with the settings of its 3DMatch training, but at the sizes of a network of ours
(channels, superpoints). Its registration is written again, because its own calls an Open3D of 2020. It draws 1000
points of each cloud by overlap times saliency, matches the most similar features, and asks RANSAC. In later versions
of Open3D that ends by confidence instead of after 1000 validations. `checkout` and `peer` are ours as well.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor, nn

from gapr_core.baselines.base import NoPose, require
from gapr_core.benchmark import checkout, peer
from gapr_core.benchmark.checkout import Origin
from gapr_core.benchmark.peer import VOXEL, Array, Matches
from gapr_core.errors import InvalidPointCloudError
from gapr_core.geometry import se3
from gapr_core.model.config import ModelConfig
from gapr_core.model.types import Cloud

SETTINGS = "configs/train/indoor.yaml"
ORIGIN = Origin(
    name="predator",
    title="Predator",
    repository="https://github.com/prs-eth/OverlapPredator",
    holds=SETTINGS,
    libraries="scikit-learn matplotlib open3d",
)
PACKAGES = ("models", "lib", "kernels", "configs", "datasets", "cpp_wrappers")
DATA_SETS = ("indoor", "kitti", "modelnet")  # their modules need libraries for files that are not read here
NEIGHBORS = [29, 34, 38, 27]  # of a point at each stage: what its own calibration gives on pairs of train_paper.yaml
REACH = 2.0 * VOXEL  # RANSAC: points this close agree
EDGES, DRAWS, CONFIDENCE = 0.9, 50_000, 0.999


@dataclass(frozen=True)
class Checkout(peer.Checkout):
    """The authors' code, imported.

    Attributes:
        folder: the checkout.
        model: class of the network.
        loss: class of the losses.
        collate: makes the input of a network from a pair.
        defaults: settings of 3DMatch, with the blocks of its network.
    """

    folder: Path
    model: Any
    loss: Any
    collate: Any
    defaults: dict[str, Any]
    origin = ORIGIN

    @classmethod
    def at(cls, folder: str | Path | None = None) -> Checkout:
        place = ORIGIN.find(folder)
        with ORIGIN.importing([place], PACKAGES, _stand_ins()):
            model, loss, data, configs, utils = map(
                importlib.import_module,
                ("models.architectures", "lib.loss", "datasets.dataloader", "configs.models", "lib.utils"),
            )
            blocks = {"architecture": configs.architectures["indoor"]}
            defaults = utils.load_config(place / SETTINGS) | blocks
            return cls(place, model.KPFCNN, loss.MetricLoss, data.collate_fn_descriptor, defaults)

    def settings(self, sizes: ModelConfig) -> SimpleNamespace:
        """Those of 3DMatch with the channels and heads of one of our networks."""
        own = {"first_feats_dim": 2 * sizes.width, "gnn_feats_dim": sizes.global_width, "num_head": sizes.heads}
        return SimpleNamespace(**self.defaults | own)

    def network(self, sizes: ModelConfig) -> nn.Module:
        with _working_in(self.folder):  # its kernels lie in a relative path
            return self.model(self.settings(sizes))

    def losses(self, sizes: ModelConfig) -> nn.Module:
        """Its losses of features, overlap and saliency."""
        return self.loss(self.settings(sizes))

    def batch(
        self, source: Cloud, target: Cloud, voxel: float, sizes: ModelConfig, T: Tensor | None = None
    ) -> dict[str, Any]:
        p, q, motion = (x.numpy() for x in peer.scaled(source, target, voxel, T))
        settings = self.settings(sizes)
        matched = (
            np.zeros((0, 2), dtype=np.int64) if T is None else near(se3.apply(motion, p), q, settings.overlap_radius)
        )
        ones = (np.ones((len(x), 1), dtype=np.float32) for x in (p, q))
        pair = (p, q, *ones, motion[:3, :3], motion[:3, 3:], torch.from_numpy(matched), p, q, torch.ones(1))
        made = self.collate([pair], settings, NEIGHBORS)
        fewest = int(min(made["stack_lengths"][-1]))
        if fewest <= settings.dgcnn_k:
            raise InvalidPointCloudError(f"more than {settings.dgcnn_k} superpoints", f"{fewest}", "a larger cloud")
        return made

    def matches(self, output: Any, batch: dict[str, Any]) -> Matches:
        features, overlap, saliency = (x.double().numpy() for x in output)
        points, scores = batch["points"][0].double().numpy(), np.maximum(overlap * saliency, 1e-12)
        count, most, rng = int(batch["stack_lengths"][0][0]), self.defaults["n_points"], np.random.default_rng(0)
        i, j = sampled(scores[:count], most, rng), count + sampled(scores[count:], most, rng)
        j = j[cKDTree(features[j]).query(features[i])[1]]
        return Matches(points[i], points[j], scores[i] * scores[j])

    def own_pose(self, output: Any, batch: dict[str, Any]) -> Array:
        found = self.matches(output, batch)
        o3d = require("open3d", "open3d", ORIGIN.name)
        ways = o3d.pipelines.registration
        source, target = (o3d.geometry.PointCloud(o3d.utility.Vector3dVector(x)) for x in found[:2])
        rows = np.repeat(np.arange(len(found.score), dtype=np.int32)[:, None], 2, axis=1)
        o3d.utility.random.seed(0)
        result = ways.registration_ransac_based_on_correspondence(
            source, target, o3d.utility.Vector2iVector(rows), REACH,
            ways.TransformationEstimationPointToPoint(False), 3,
            [ways.CorrespondenceCheckerBasedOnEdgeLength(EDGES), ways.CorrespondenceCheckerBasedOnDistance(REACH)],
            ways.RANSACConvergenceCriteria(DRAWS, CONFIDENCE),
        )  # fmt: skip
        if len(result.correspondence_set) < 3:
            raise NoPose(f"no pose that three of {len(rows)} correspondences agree on")
        return np.array(result.transformation)


def sampled(scores: Array, most: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Rows of a cloud's points: all, or so many of them, drawn by their scores (N,)."""
    if len(scores) <= most:
        return np.arange(len(scores))
    return rng.choice(len(scores), most, replace=False, p=scores / scores.sum())


def near(p: Array, q: Array, radius: float) -> NDArray[np.int64]:
    """(C, 2) rows of points p (N, 3) and q (M, 3) within a radius of each other."""
    found = cKDTree(p).sparse_distance_matrix(cKDTree(q), radius, output_type="ndarray")
    return np.stack([found["i"], found["j"]], axis=1).astype(np.int64)


@contextmanager
def _working_in(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def _stand_ins() -> dict[str, ModuleType]:
    """Modules in place of its compiled operators and of its data sets."""
    voxels, balls = "cpp_wrappers.cpp_subsampling", "cpp_wrappers.cpp_neighbors"
    names = ["cpp_wrappers", voxels, balls, f"{voxels}.grid_subsampling", f"{balls}.radius_neighbors"]
    made = {name: ModuleType(name) for name in (*names, *(f"datasets.{data}" for data in DATA_SETS))}
    made[f"{voxels}.grid_subsampling"].__dict__.update(subsample_batch=subsample_batch)
    made[f"{balls}.radius_neighbors"].__dict__.update(batch_query=batch_query)
    for data in DATA_SETS:
        made[f"datasets.{data}"].__dict__.update(__getattr__=lambda name: None)
    return made


def subsample_batch(
    points: Tensor, lengths: Tensor, sampleDl: float = 0.1, **_: Any
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Means of the points (N, 3) in each voxel, cloud by cloud: (M, 3) and how many of each cloud."""
    thinned, counts = checkout.voxels(np.asarray(points), np.asarray(lengths).tolist(), sampleDl)
    return thinned.astype(np.float32), np.array(counts, dtype=np.int32)


def batch_query(
    queries: Tensor, points: Tensor, query_lengths: Tensor, lengths: Tensor, radius: float = 0.1
) -> NDArray[np.int64]:
    """Find the points of the same cloud in the ball of each query (N, 3), nearest first; M for none.

    K is the size of the fullest ball.
    """
    counts = np.asarray(query_lengths).tolist(), np.asarray(lengths).tolist()
    return checkout.balls(np.asarray(queries, np.float64), np.asarray(points, np.float64), *counts, radius)
