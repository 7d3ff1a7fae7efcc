"""How many neighbourhoods the caps of `neighbors` cut, stage by stage, on the bones of a split.

Real bones where the folder has them, parametric ones where it has none.

python -m gapr_core.training.balls --model config/model/faithful.yaml --anatomy DIR

The paper's neighbourhood is a ball; a cap keeps only the nearest of its points. A stage's cap counts for the balls
around its own points and for those around the points of the next coarser stage that look at it.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gapr_core.data import anatomy, pool
from gapr_core.data.protocols import make_pair
from gapr_core.data.specimen import Specimen
from gapr_core.model.config import ModelConfig
from gapr_core.model.pyramid import pyramid, stage_radii, target_frame
from gapr_core.pages.markdown import table
from gapr_core.runtime.arguments import at_least_one
from gapr_core.runtime.console import exit_code, say

Array = NDArray[np.float64]
Counts = list[NDArray[np.int64]]  # of each stage: points in every ball, however many there are
MOST_CUT = 0.05  # share of the balls of a stage that a cap may cut


def ball_sizes(points_mm: Array, voxel: float, scale_mm: float, config: ModelConfig) -> Counts:
    """Points in every ball of every stage of one cloud (N, 3), mm, whose unit is `scale_mm`; no cap."""
    resolutions = pyramid((points_mm - points_mm.mean(axis=0)) / scale_mm, voxel, config)
    radii, sizes = stage_radii(voxel, config), []
    for stage, points in enumerate(resolutions):
        tree = cKDTree(points)
        centres = np.vstack(resolutions[stage : stage + 2])
        sizes.append(np.asarray(tree.query_ball_point(centres, radii[stage], return_length=True), dtype=np.int64))
    return sizes


def bone_sizes(specimens: Iterable[Specimen], config: ModelConfig, seed: int = 0) -> Counts:
    """Count points in balls of target and source of one pair of protocol paper per bone."""
    found = []
    for specimen in specimens:
        pair = make_pair("paper", specimen, seed)
        frame = target_frame(pair.target, config)
        found += [ball_sizes(cloud, frame.voxel, frame.scale_mm, config) for cloud in (pair.target, pair.source)]
    return [np.concatenate(stage) for stage in zip(*found, strict=True)]


def share_cut(sizes: Counts, caps: Iterable[int]) -> list[float]:
    """Return per stage the share of balls with more points than the cap."""
    return [float((stage > cap).mean()) for stage, cap in zip(sizes, caps, strict=True)]


def caps_for(sizes: Counts, most_cut: float = MOST_CUT) -> list[int]:
    """Return per stage the smallest cap that cuts at most this share of balls."""
    return [int(np.sort(stage)[int(np.ceil((1.0 - most_cut) * len(stage))) - 1]) for stage in sizes]


def main(arguments: list[str] | None = None) -> int:
    """Print one line a bone and stage."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, help="yaml of config/model; the default network without it")
    parser.add_argument("--anatomy", type=Path, required=True, help="corresponded meshes with splits.json")
    parser.add_argument("--split", default="train", choices=anatomy.SPLITS, help="whose bones (train)")
    parser.add_argument("--people", type=at_least_one, default=4, help="subjects of each bone and cohort (4)")
    args = parser.parse_args(arguments)
    config = ModelConfig.from_yaml(args.model) if args.model else ModelConfig()
    rows = []
    for bone in anatomy.BONES:
        specimens = pool.specimens(bone, args.split, args.people, args.anatomy)
        cohorts = sorted({s.cohort for s in specimens})
        chosen = [s for c in cohorts for s in [s for s in specimens if s.cohort == c][: args.people]]
        rows += _rows(f"{bone} ({', '.join(cohorts)})", bone_sizes(chosen, config), config)
    say(table(["bone", "stage", "balls", "median", "95 % hold at most", "cap", "cut"], rows))
    return 0


def _rows(bone: str, sizes: Counts, config: ModelConfig) -> list[list[str]]:
    facts = zip(sizes, caps_for(sizes), config.neighbors, share_cut(sizes, config.neighbors), strict=True)
    return [
        [bone, str(stage), str(len(s)), f"{np.median(s):.0f}", str(ball_size), str(cap), f"{100 * cut:.1f} %"]
        for stage, (s, ball_size, cap, cut) in enumerate(facts)
    ]


if __name__ == "__main__":
    raise SystemExit(exit_code(main, "python -m gapr_core.training.balls"))
