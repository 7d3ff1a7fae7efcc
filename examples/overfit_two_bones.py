"""Two hundred training steps on two bones: the coarse inlier ratio goes clearly up, in some minutes on one CPU core.

python examples/overfit_two_bones.py [--steps 200] [--model config/model/best.yaml]

Sixteen views of two parametric bones, seen again and again: this shows that the network can learn, not that it
generalises. For that use `gapr train`.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch
from tqdm import trange

from gapr_core.data.pool import parametric_specimen
from gapr_core.data.protocols import make_pair
from gapr_core.model.config import ModelConfig
from gapr_core.model.network import GAPRNet
from gapr_core.model.pyramid import build_cloud, target_frame
from gapr_core.training.losses import compute_losses
from gapr_core.training.targets import TrainingPair, join, training_pair
from gapr_core.training.validation import inlier_ratios


def views(config: ModelConfig, each: int) -> list[TrainingPair]:
    """One-sided views (protocol L1) of a femur and of a tibia, with their truth."""
    found = []
    for bone in ("femur", "tibia"):
        specimen = parametric_specimen(bone, 0)
        for seed in range(each):
            pair = make_pair("L1", specimen, seed)
            frame = target_frame(pair.target, config)
            source, target = build_cloud(pair.source, frame, config), build_cloud(pair.target, frame, config)
            found.append(training_pair(source, target, pair.T_target_source, frame))
    return found


@torch.inference_mode()
def mean_inliers(network: GAPRNet, pairs: list[TrainingPair]) -> tuple[float, float]:
    """Coarse and fine inlier ratio over the pairs."""
    ratios = [inlier_ratios(network(p.source, p.target), p.source, p) for p in pairs]
    return sum(r[0] for r in ratios) / len(ratios), sum(r[1] for r in ratios) / len(ratios)


def run(config: ModelConfig, steps: int, batch: int = 4) -> list[tuple[float, float]]:
    """Train; returns the inlier ratios before, and after every quarter of the steps."""
    torch.manual_seed(0)
    network, pairs = GAPRNet(config), views(config, 8)
    optimizer = torch.optim.AdamW(network.parameters(), 1e-3)
    history = [mean_inliers(network, pairs)]
    draw = torch.Generator().manual_seed(0)
    for step in (progress := trange(steps, desc="steps")):
        chosen = torch.randperm(len(pairs), generator=draw)[:batch].tolist()
        losses, _ = compute_losses(network, join([pairs[i] for i in chosen]), draw)
        optimizer.zero_grad()
        losses.total.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        progress.set_postfix(coarse=f"{losses.coarse.item():.2f}", fine=f"{losses.fine.item():.2f}")
        if (step + 1) % max(steps // 4, 1) == 0:
            history.append(mean_inliers(network, pairs))
            progress.write(f"step {step + 1}: coarse inliers {history[-1][0]:.2f}, fine inliers {history[-1][1]:.2f}")
    return history


def main() -> None:
    """Print the ratios before and after."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--model", type=Path)
    args = parser.parse_args()
    config = ModelConfig.from_yaml(args.model) if args.model else ModelConfig()
    history = run(replace(config, superpoints=(40, 60)), args.steps)
    (coarse_0, fine_0), (coarse, fine) = history[0], history[-1]
    print(f"coarse inliers {coarse_0:.2f} -> {coarse:.2f}, fine inliers {fine_0:.2f} -> {fine:.2f}")


if __name__ == "__main__":
    main()
