"""Does the network see what is bone? For scenes with `is_bone` and a viewpoint.

    `python benchmarks/bone_head.py --pairs DIR [--weights FILE] [--shard 1/3]`

How well the head tells bone from the rest (area under the ROC curve of a scene's points), next to what needs no
network: how rough the surface is, and how near to the middle of the cloud a point lies; and whether the network alone
finds the pose.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from tqdm import tqdm

from gapr_core import Registrar
from gapr_core.data.pair import Pair
from gapr_core.data.pair_files import load_pair, pair_paths
from gapr_core.geometry import se3
from gapr_core.metrics import auroc
from gapr_core.pages import markdown
from gapr_core.registration.problem import source as sources
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.proposals.network import SHIPPED, NetworkProposer
from gapr_core.runtime.console import say

Array = NDArray[np.float64]
COLUMNS = ("head", "rough", "middle", "constant", "said", "bone", "pose found", "near pose", "head s")


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=Path, required=True, help="folder of scenes")
    parser.add_argument("--weights", type=Path, default=SHIPPED, help="weights with a bone head")
    parser.add_argument("--shard", default="1/1", help="K/N: every N-th pair from the K-th on")
    args = parser.parse_args()
    torch.set_num_threads(1)
    first, step = map(int, args.shard.split("/"))
    pairs = [load_pair(path) for path in pair_paths(args.pairs)[first - 1 :: step]]
    network = NetworkProposer.from_weights(args.weights)
    say(judged(pairs, network))
    return 0


def judged(pairs: list[Pair], network: NetworkProposer) -> str:
    """Means over the scenes of each protocol."""
    rows: dict[str, list[list[float]]] = {}
    registrar = Registrar()
    for pair in tqdm(pairs):
        row = seen(pair, registrar.prepare(pair.target), network)
        rows.setdefault(pair.protocol, []).append(row)
    table = [[name, str(len(of)), *(f"{v:.3f}" for v in np.mean(of, axis=0))] for name, of in rows.items()]
    return markdown.table(["protocol", "scenes", *COLUMNS], table)


def seen(pair: Pair, target: PreparedTarget, network: NetworkProposer) -> list[float]:
    """What `COLUMNS` name, of one scene."""
    source = prepared(pair)
    is_bone = truth_of(pair, source)
    network.prepare(target)
    begun = time.process_time()
    said = network.bone(source, target)
    seconds = time.process_time() - begun
    poses = network.propose(source, target, np.random.default_rng(0)).poses
    errors = [se3.pose_error(T, pair.T_target_source, pair.source) for T in poses]
    answers = said, source.flatness_mm, middle_of(source), np.ones(len(said))
    return [
        *(auroc(answer, is_bone) for answer in answers), said.mean(), is_bone.mean(),
        any(e.is_right for e in errors), any(e.within(20.0, 15.0) for e in errors), seconds,
    ]  # fmt: skip


def prepared(pair: Pair) -> PreparedSource:
    """The source as a registration has it."""
    source = sources.prepare(pair.source)
    assert isinstance(source, PreparedSource), source
    return source


def truth_of(pair: Pair, source: PreparedSource) -> NDArray[np.bool_]:
    """(N,) whether the points of a prepared source are bone."""
    return np.asarray(pair.metadata["is_bone"])[cKDTree(pair.source).query(source.points)[1]]


def middle_of(source: PreparedSource) -> Array:
    """(N,) the nearer to the middle of the cloud, the larger; never above 0."""
    return -np.linalg.norm(source.points - source.points.mean(axis=0), axis=1)


if __name__ == "__main__":
    raise SystemExit(main())
