"""How far the network's features and scores change when both clouds are moved, each by a motion of its own.

nice python benchmarks/model_invariance.py [--models YAML ...] [--weights FILE ...] [--motions 20] [--json FILE]

Motions are uniform on SO(3) with translations up to 150 mm. The pyramid is rebuilt from the moved clouds, so its
own dependence on the frame counts, too. Features: |f' - f| over |f|, per point. Scores: largest change of the
dual-normalised correlation, eq. (7), over the largest entry. Also the share of the chosen patch pairs that stay,
and, as a yardstick, how far the features of two different superpoints of a bone are apart: |f_a - f_b| over |f_a|.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from gapr_core.data.pool import parametric_specimen
from gapr_core.data.protocols import make_pair
from gapr_core.geometry import se3
from gapr_core.model import weights
from gapr_core.model.config import ModelConfig
from gapr_core.model.network import GAPRNet
from gapr_core.model.pyramid import Frame, build_cloud, target_frame

BONES = ("femur", "tibia", "pelvis")


def answer(network: GAPRNet, frame: Frame, source: np.ndarray, target: np.ndarray) -> dict[str, Tensor]:
    """Features and scores for two clouds (N, 3), (M, 3), mm."""
    clouds = [build_cloud(points, frame, network.config) for points in (source, target)]
    features = [network.backbone(cloud) for cloud in clouds]
    out = network(*clouds, features[1])
    return {
        "fine": torch.cat([f.fine for f in features]),
        "superpoints": torch.cat([f.coarse for f in features]),
        "scores": out.coarse[0].exp(),
        "chosen": out.chosen.source * out.coarse.shape[2] + out.chosen.target,
    }


def relative(still: Tensor, moved: Tensor) -> np.ndarray:
    """(N,) change of features (N, C) over their length."""
    return ((moved - still).norm(dim=1) / still.norm(dim=1)).numpy()


def compare(still: dict[str, Tensor], moved: dict[str, Tensor]) -> dict[str, Any] | None:
    """Deviations of one motion; None when a point on a voxel's border fell to the other side."""
    if any(still[name].shape != moved[name].shape for name in ("fine", "superpoints")):
        return None
    change = (moved["scores"] - still["scores"]).abs().max() / still["scores"].max()
    return {
        "fine": relative(still["fine"], moved["fine"]),
        "superpoints": relative(still["superpoints"], moved["superpoints"]),
        "scores": float(change),
        "pairs_kept": float(torch.isin(still["chosen"], moved["chosen"]).float().mean()),
    }


def other_point(features: Tensor) -> float:
    """Median distance between the features (S, C) of different superpoints, over their length."""
    return float((torch.cdist(features, features) / features.norm(dim=1, keepdim=True)).median())


@torch.inference_mode()
def measure(network: GAPRNet, motions: int, name: str) -> dict[str, Any]:
    """Deviations of a network over all bones and motions."""
    rng, rows, apart, lost = np.random.default_rng(0), [], [], 0
    for bone in BONES:
        pair = make_pair("paper", parametric_specimen(bone, 0), 0)
        frame = target_frame(pair.target, network.config)
        still = answer(network, frame, pair.source, pair.target)
        apart.append(other_point(still["superpoints"]))
        for _ in tqdm(range(motions), desc=f"{name}, {bone}", disable=None):
            turned = [se3.apply(random_motion(rng), points) for points in (pair.source, pair.target)]
            row = compare(still, answer(network, frame, *turned))
            lost += row is None
            rows += [row] if row else []
    found = {key: np.concatenate([np.atleast_1d(row[key]) for row in rows]) for key in rows[0]}
    return {
        **{f"{key}_median": float(np.median(found[key])) for key in ("fine", "superpoints", "scores")},
        **{f"{key}_largest": float(found[key].max()) for key in ("fine", "superpoints", "scores")},
        "pairs_kept": float(found["pairs_kept"].mean()),
        "other_point": float(np.mean(apart)),
        "other_voxels": lost,
    }


def random_motion(rng: np.random.Generator) -> np.ndarray:
    """(4, 4), mm."""
    return se3.from_rotation_translation(se3.random_rotation(rng), rng.uniform(-150, 150, 3))


def table(numbers: dict[str, dict[str, Any]], motions: int) -> str:
    """The numbers as Markdown."""
    lines = [
        f"{len(BONES)} bones, {motions} motions each; median / largest over all points and motions.",
        "",
        "| network | fine features | superpoint features | two different superpoints | scores | patch pairs kept "
        "| other voxels |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, row in numbers.items():
        fine, coarse, scores = (
            f"{row[f'{k}_median']:.1e} / {row[f'{k}_largest']:.1e}" for k in ("fine", "superpoints", "scores")
        )
        lines.append(
            f"| {name} | {fine} | {coarse} | {row['other_point']:.2f} | {scores} "
            f"| {100 * row['pairs_kept']:.1f} % | {row['other_voxels']} |"
        )
    return "\n".join(lines)


def main() -> int:
    """Print the table, and write the numbers where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", type=Path, nargs="*", default=[], help="yamls of config/model, untrained, seed 0")
    parser.add_argument("--weights", type=Path, nargs="*", default=[], help="trained networks")
    parser.add_argument("--motions", type=int, default=20)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    networks = {}
    for path in args.models:
        torch.manual_seed(0)
        networks[f"{path.stem}, untrained"] = GAPRNet(ModelConfig.from_yaml(path)).eval()
    for path in args.weights:
        networks[f"{path.stem}, trained"] = weights.load(path)[0]
    numbers = {name: measure(network, args.motions, name) for name, network in networks.items()}
    print(table(numbers, args.motions))
    if args.json:
        args.json.write_text(json.dumps(numbers, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
