"""GeoTransformer (Qin et al., CVPR 2022) by its authors, from a checkout. No line of it is here.

git clone https://github.com/qinzheng93/GeoTransformer && pip install easydict einops ipdb ipython
python -m gapr_core.training.geotransformer --checkout GeoTransformer --anatomy DIR --pairs 3000 --out runs/peer
GEOTRANSFORMER=GeoTransformer gapr benchmark --methods geotransformer@runs/peer/weights.safetensors ...

Its network, losses and registration (local to global) run as they are, with the settings of its 3DMatch experiment.
The sizes are those of a network of ours (channels, superpoints, patches, Sinkhorn steps). `checkout` and `peer` are
ours.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor, nn

from gapr_core.benchmark import checkout, peer
from gapr_core.benchmark.checkout import Origin
from gapr_core.benchmark.peer import Array, Matches
from gapr_core.errors import InvalidPointCloudError
from gapr_core.model.config import ModelConfig
from gapr_core.model.types import Cloud

EXPERIMENT = "experiments/geotransformer.3dmatch.stage4.gse.k3.max.oacl.stage2.sinkhorn"
ORIGIN = Origin(
    name="geotransformer",
    title="GeoTransformer",
    repository="https://github.com/qinzheng93/GeoTransformer",
    holds=EXPERIMENT,
    libraries="easydict einops ipdb ipython",
)
SCRIPTS = ("config", "backbone", "model", "loss")  # top-level modules of an experiment's folder
PYRAMID = ("points", "neighbors", "subsampling", "upsampling")  # lists of tensors, one for each stage
NEIGHBORS = [38, 36, 36, 38]  # of a point, as in its demo for 3DMatch
MOST_NEIGHBORS = 64  # that the stand-in for its extension looks for: more than it ever keeps


@dataclass(frozen=True)
class Checkout(peer.Checkout):
    """The authors' code, imported.

    Attributes:
        config, model, loss: modules of the 3DMatch experiment.
        collate: makes the input of a network from a pair.
    """

    config: ModuleType
    model: ModuleType
    loss: ModuleType
    collate: Any
    origin = ORIGIN

    @classmethod
    def at(cls, folder: str | Path | None = None) -> Checkout:
        place = ORIGIN.find(folder)
        extension = {"geotransformer.ext": _extension()}
        with ORIGIN.importing([place / EXPERIMENT, place], [*SCRIPTS, "geotransformer"], extension):
            config, _, model, loss = map(importlib.import_module, SCRIPTS)
            data = importlib.import_module("geotransformer.utils.data")
            return cls(config, model, loss, data.registration_collate_fn_stack_mode)

    def settings(self, sizes: ModelConfig) -> Any:
        """Those of 3DMatch with the channels, patches and Sinkhorn steps of one of our networks."""
        made = self.config.make_cfg()
        made.backbone.init_dim, made.backbone.group_norm = sizes.width, sizes.width // 2
        made.backbone.output_dim, made.geotransformer.input_dim = 4 * sizes.width, 16 * sizes.width
        made.geotransformer.hidden_dim = made.geotransformer.output_dim = sizes.global_width
        made.geotransformer.num_heads = sizes.heads
        made.model.num_points_in_patch = sizes.patch_size
        made.model.num_sinkhorn_iterations = sizes.sinkhorn_iterations
        made.coarse_matching.num_targets = sizes.train_pairs
        made.coarse_matching.num_correspondences = sizes.test_pairs
        return made

    def network(self, sizes: ModelConfig) -> nn.Module:
        with checkout.without_cuda():
            return self.model.create_model(self.settings(sizes))

    def losses(self, sizes: ModelConfig) -> nn.Module:
        """Its coarse and fine losses: called with the output and the input of the network."""
        return self.loss.OverallLoss(self.settings(sizes))

    def batch(
        self, source: Cloud, target: Cloud, voxel: float, sizes: ModelConfig, T: Tensor | None = None
    ) -> dict[str, Any]:
        p, q, motion = peer.scaled(source, target, voxel, T)  # the network wants a motion, registration ignores it
        pair = {
            "ref_points": q,
            "src_points": p,
            "ref_feats": torch.ones(len(q), 1),
            "src_feats": torch.ones(len(p), 1),
        }
        backbone = self.config.make_cfg().backbone
        stages = backbone.num_stages, backbone.init_voxel_size, backbone.init_radius, NEIGHBORS
        made = self.collate([pair | {"transform": motion}], *stages)
        fewest = int(made["lengths"][1].min())
        if fewest < sizes.patch_size:  # after the first thinning
            raise InvalidPointCloudError(f"at least {sizes.patch_size} voxels", f"{fewest}", "a larger cloud")
        return {name: [t.contiguous() for t in v] if name in PYRAMID else v for name, v in made.items()}

    def matches(self, output: Any, batch: dict[str, Any]) -> Matches:
        names = ("src_corr_points", "ref_corr_points", "corr_scores")
        return Matches(*(output[name].double().numpy() for name in names))

    def own_pose(self, output: Any, batch: dict[str, Any]) -> Array:
        return output["estimated_transform"].double().numpy()


def _extension() -> ModuleType:
    module = ModuleType("geotransformer.ext")
    module.__dict__.update(grid_subsampling=grid_subsampling, radius_neighbors=radius_neighbors)
    return module


def grid_subsampling(points: Tensor, lengths: Tensor, voxel: float) -> tuple[Tensor, Tensor]:
    """Means of the points (N, 3) in each voxel, cloud by cloud: (M, 3) and how many of each cloud."""
    thinned, counts = checkout.voxels(points.double().numpy(), lengths.tolist(), voxel)
    return torch.from_numpy(thinned).float(), torch.tensor(counts)


def radius_neighbors(queries: Tensor, points: Tensor, query_lengths: Tensor, lengths: Tensor, radius: float) -> Tensor:
    """Find the points of the same cloud within a radius of each query (N, 3), nearest first; M for none."""
    counts = query_lengths.tolist(), lengths.tolist()
    return torch.from_numpy(checkout.balls(queries.numpy(), points.numpy(), *counts, radius, MOST_NEIGHBORS))
