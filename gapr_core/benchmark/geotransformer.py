"""GeoTransformer (Qin et al., CVPR 2022) by its authors, from a checkout next to the project; no line of it is here.

git clone https://github.com/qinzheng93/GeoTransformer && pip install easydict einops ipdb ipython
python -m gapr_core.training.geotransformer --checkout GeoTransformer --anatomy DIR --pairs 3000 --out runs/peer
GEOTRANSFORMER=GeoTransformer gapr benchmark --methods geotransformer@runs/peer/weights.safetensors ...

Its network, losses and registration run as they are, with the settings of its 3DMatch experiment, but at the sizes of a
network of ours (channels, superpoints, patches, Sinkhorn steps). Three things are ours: the two operators of its C++
extension (voxels, balls) are NumPy and k-d trees, its tensors stay on the CPU, and its unit is 40 first voxels of a
pair's target, because its settings are made for voxels of 0.025.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor, nn

from gapr_core.baselines.base import Baseline, BaselineTarget, NoPose
from gapr_core.benchmark.paper_pipeline import ransac_pose
from gapr_core.errors import ConfigError, InvalidPointCloudError, MethodUnavailableError, WeightsError
from gapr_core.geometry import se3
from gapr_core.model.config import ModelConfig
from gapr_core.model.pyramid import build_cloud, target_frame, voxel_means
from gapr_core.model.types import Cloud
from gapr_core.registration.proposals.consensus import Correspondences

Array = NDArray[np.float64]
CHECKOUT = "GEOTRANSFORMER"  # environment variable: where the checkout is
FORMAT = "geotransformer/1"
EXPERIMENT = "geotransformer.3dmatch.stage4.gse.k3.max.oacl.stage2.sinkhorn"
SCRIPTS = ("config", "backbone", "model", "loss")  # top-level modules of an experiment's folder
PYRAMID = ("points", "neighbors", "subsampling", "upsampling")  # lists of tensors, one for each stage
VOXEL = 0.025  # its first voxel, in its unit
NEIGHBORS = [38, 36, 36, 38]  # of a point, as in its demo for 3DMatch
MOST_NEIGHBORS = 64  # that the stand-in for its extension looks for: more than it ever keeps


@dataclass(frozen=True)
class Checkout:
    """The authors' code, imported.

    Attributes:
        config, model, loss: modules of the 3DMatch experiment.
        collate: makes the input of a network from a pair.
    """

    config: ModuleType
    model: ModuleType
    loss: ModuleType
    collate: Any

    @classmethod
    def at(cls, folder: str | Path | None = None) -> Checkout:
        """Import a checkout; that of the environment variable `GEOTRANSFORMER` without a folder.

        Raises:
            MethodUnavailableError: there is none, or a library that it needs is missing.
        """
        place = Path(folder or os.environ.get(CHECKOUT, ""))
        scripts = place / "experiments" / EXPERIMENT
        if not (folder or CHECKOUT in os.environ) or not scripts.is_dir():
            raise MethodUnavailableError(
                f"a checkout of GeoTransformer in the environment variable {CHECKOUT}",
                f"{place} without experiments/{EXPERIMENT}" if str(place) != "." else "none",
                "git clone https://github.com/qinzheng93/GeoTransformer, and name its folder",
            )
        sys.modules.setdefault("geotransformer.ext", _extension())
        with patch.object(sys, "path", [str(scripts), str(place.resolve()), *sys.path]):
            try:
                config, _, model, loss = map(importlib.import_module, SCRIPTS)
                data = importlib.import_module("geotransformer.utils.data")
            except ImportError as error:
                raise MethodUnavailableError(
                    "the libraries that GeoTransformer needs", str(error), "pip install easydict einops ipdb ipython"
                ) from error
            finally:
                for name in SCRIPTS:  # such names belong to nobody
                    sys.modules.pop(name, None)
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
        """The network with random weights."""
        with without_cuda():
            return self.model.create_model(self.settings(sizes))

    def losses(self, sizes: ModelConfig) -> nn.Module:
        """Its coarse and fine losses: called with the output and the input of the network."""
        return self.loss.OverallLoss(self.settings(sizes))

    def batch(
        self, source: Cloud, target: Cloud, voxel: float, patch_size: int, T: Tensor | None = None
    ) -> dict[str, Any]:
        """The input of the network.

        Args:
            source, target: of which the finest points are used.
            voxel: the first voxel in the clouds' units.
            patch_size: points of a patch; its network cannot do with fewer in a whole cloud.
            T: (3, 4) true T_target_source in the clouds' units; the network wants one, and registration ignores it.

        Raises:
            InvalidPointCloudError: a cloud of fewer points than a patch has, after the first thinning.
        """
        scale, motion = VOXEL / voxel, torch.eye(4)
        if T is not None:
            motion[:3] = T
            motion[:3, 3] *= scale
        p, q = (cloud.levels[0].points * scale for cloud in (source, target))
        pair = {
            "ref_points": q,
            "src_points": p,
            "ref_feats": torch.ones(len(q), 1),
            "src_feats": torch.ones(len(p), 1),
        }
        backbone = self.config.make_cfg().backbone
        balls = backbone.num_stages, backbone.init_voxel_size, backbone.init_radius, NEIGHBORS
        made = self.collate([pair | {"transform": motion}], *balls)
        fewest = int(made["lengths"][1].min())
        if fewest < patch_size:
            raise InvalidPointCloudError(f"at least {patch_size} voxels", f"{fewest}", "a larger cloud")
        return {name: [t.contiguous() for t in v] if name in PYRAMID else v for name, v in made.items()}


def thinning(sizes: ModelConfig) -> ModelConfig:
    """The settings for the first voxels: each stage doubles them, all else is as in our network."""
    return replace(sizes, voxel_growth=2.0)


@contextmanager
def without_cuda() -> Iterator[None]:
    """Tensors stay on the CPU, though its code would move them."""
    with patch.object(Tensor, "cuda", lambda tensor, *_, **__: tensor):
        yield


class GeoTransformer(Baseline):
    """Its correspondences, and a pose from them.

    Args:
        weights: that `gapr_core.training.geotransformer` wrote.
        pose: "local_to_global", its own registration, or "ransac", that of the paper's pipeline.
        checkout: folder of the code; that of the environment variable without it.

    Raises:
        MethodUnavailableError: no checkout.
        WeightsError: the file is missing, damaged or of another format.
    """

    def __init__(self, weights: str | Path, pose: str = "local_to_global", checkout: str | Path | None = None) -> None:
        self.code, self.pose = Checkout.at(checkout), pose
        self.network, sizes = load(self.code, weights)
        self.thinning, self.patch_size = thinning(sizes), sizes.patch_size
        self.name = f"geotransformer{'' if pose == 'local_to_global' else f'_{pose}'}@{weights}"

    def _prepare(self, points: Array, normals: Array | None) -> Any:
        frame = target_frame(points, self.thinning)
        return frame, build_cloud(points, frame, self.thinning)

    def _align(self, source: Array, target: BaselineTarget, seed: Array) -> Array:
        frame, cloud = target.static
        try:
            moving = build_cloud(source, frame, self.thinning)
            batch = self.code.batch(moving, cloud, frame.voxel, self.patch_size)
        except InvalidPointCloudError as error:
            raise NoPose(str(error)) from error
        with torch.inference_mode(), without_cuda():
            output = self.network(batch)
        unit_mm = frame.scale_mm * frame.voxel / VOXEL
        if self.pose == "local_to_global":
            return to_mm(output["estimated_transform"].double().numpy(), moving, cloud, unit_mm)
        found = correspondences_mm(output, moving, cloud, unit_mm)
        return ransac_pose(found, frame)


def save(network: nn.Module, sizes: ModelConfig, path: Path, card: dict[str, Any]) -> None:
    """Write weights with what is needed to build the network again."""
    from safetensors.torch import save_file

    header = {"format": FORMAT, "sizes": json.dumps(sizes.to_dict()), "card": json.dumps(card)}
    save_file({name: t.contiguous() for name, t in network.state_dict().items()}, str(path), metadata=header)


def load(code: Checkout, path: str | Path) -> tuple[nn.Module, ModelConfig]:
    """The network of a file, in evaluation mode, and its sizes.

    Raises:
        WeightsError: the file is missing, damaged or of another format.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="pt") as file:
            header, tensors = file.metadata() or {}, {name: file.get_tensor(name) for name in file.keys()}
        if header.get("format") != FORMAT:
            raise WeightsError(f"weights of format {FORMAT}", f"{header.get('format')} in {path}", "train them first")
        sizes = ModelConfig.from_dict(json.loads(header["sizes"]))
        network = code.network(sizes)
        network.load_state_dict(tensors)
    except (OSError, SafetensorError, RuntimeError, ConfigError, KeyError, TypeError, ValueError) as error:
        raise WeightsError("weights of GeoTransformer", f"{path}: {error}", "train them first") from error
    return network.eval(), sizes


def to_mm(T: Array, source: Cloud, target: Cloud, unit_mm: float) -> Array:
    """(4, 4) T_target_source, mm, from one between clouds that were centred, in units of `unit_mm`."""
    centre_p, centre_q = source.centre_mm.numpy()[0], target.centre_mm.numpy()[0]
    shift = centre_q + unit_mm * T[:3, 3] - T[:3, :3] @ centre_p
    return se3.from_rotation_translation(T[:3, :3], shift)


def correspondences_mm(output: dict[str, Tensor], source: Cloud, target: Cloud, unit_mm: float) -> Correspondences:
    """What its fine matching found, in mm; RANSAC does not ask for the patches."""
    p, q = (output[f"{side}_corr_points"].double().numpy() * unit_mm for side in ("src", "ref"))
    score = output["corr_scores"].double().numpy()
    centre_p, centre_q = source.centre_mm.numpy()[0], target.centre_mm.numpy()[0]
    return Correspondences(p + centre_p, q + centre_q, score, np.zeros(len(score), dtype=np.int64))


def _extension() -> ModuleType:
    module = ModuleType("geotransformer.ext")
    module.__dict__.update(grid_subsampling=grid_subsampling, radius_neighbors=radius_neighbors)
    return module


def grid_subsampling(points: Tensor, lengths: Tensor, voxel: float) -> tuple[Tensor, Tensor]:
    """Means of the points (N, 3) in each voxel, cloud by cloud: (M, 3) and how many of each cloud."""
    thinned = [torch.from_numpy(voxel_means(p.double().numpy(), voxel)).float() for p in points.split(lengths.tolist())]
    return torch.cat(thinned), torch.tensor([len(p) for p in thinned])


def radius_neighbors(queries: Tensor, points: Tensor, query_lengths: Tensor, lengths: Tensor, radius: float) -> Tensor:
    """(N, 64) rows of points (M, 3) within a radius of each query (N, 3), of its cloud, nearest first; M for none."""
    rows, first = [], 0
    for near, cloud in zip(queries.split(query_lengths.tolist()), points.split(lengths.tolist()), strict=True):
        found = cKDTree(cloud.numpy()).query(near.numpy(), MOST_NEIGHBORS, distance_upper_bound=radius)[1]
        rows.append(np.where(found == len(cloud), len(points), found + first))
        first += len(cloud)
    return torch.from_numpy(np.concatenate(rows))
