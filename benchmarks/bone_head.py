"""Does the network see what is bone, and does it help? For scenes with `is_bone` and a viewpoint.

    `python benchmarks/bone_head.py --pairs DIR [--weights FILE] [--shard 1/3]`
    `python benchmarks/bone_head.py --pairs DIR --shard 1/3 --seeds 12,6 --led head`

The first line says how well the head tells bone from the rest (area under the ROC curve of a scene's points), next to
what needs no network: how rough the surface is, and how near to the middle of the cloud a point lies; and whether the
network alone finds the pose. The second registers, with so many regions of each radius, grown from points anywhere
(`--led none`), from where the head sees bone, from true bone (`truth`) or from the middle of the cloud (`middle`).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from unittest import mock

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from tqdm import tqdm

from gapr_core import Registrar, RegistrarConfig
from gapr_core.data.pair import Pair
from gapr_core.data.pair_files import load_pair, pair_paths
from gapr_core.geometry import sampling, se3
from gapr_core.metrics import auroc
from gapr_core.pages import markdown
from gapr_core.registration import source as sources
from gapr_core.registration.assessment import Assessment
from gapr_core.registration.proposals import regions
from gapr_core.registration.proposals.network import SHIPPED, NetworkProposer
from gapr_core.registration.source import PreparedSource
from gapr_core.registration.target import PreparedTarget
from gapr_core.runtime.console import say

Array = NDArray[np.float64]
LED = ("none", "head", "truth", "middle")
LED_SHARE = 0.3  # of the points, at least, that regions are grown from
COLUMNS = ("head", "rough", "middle", "constant", "said", "bone", "pose found", "near pose", "head s")


def main() -> int:
    """Print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=Path, required=True, help="folder of scenes")
    parser.add_argument("--weights", type=Path, default=SHIPPED, help="weights with a bone head")
    parser.add_argument("--shard", default="1/1", help="K/N: every N-th pair from the K-th on")
    parser.add_argument("--seeds", help="regions of each radius, such as 12,6: register")
    parser.add_argument("--led", choices=LED, default="none", help="where regions are grown")
    args = parser.parse_args()
    torch.set_num_threads(1)
    first, step = map(int, args.shard.split("/"))
    pairs = [load_pair(path) for path in pair_paths(args.pairs)[first - 1 :: step]]
    network = NetworkProposer.from_weights(args.weights)
    if args.seeds is None:
        say(judged(pairs, network))
    else:
        say(registered(pairs, network, tuple(map(int, args.seeds.split(","))), args.led))
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


def registered(pairs: list[Pair], network: NetworkProposer, seeds: tuple[int, ...], led: str) -> str:
    """Right poses found and CPU seconds a scene, with so many regions of each radius."""
    rows: dict[str, list[tuple[bool, int, float]]] = {}
    config = RegistrarConfig(num_threads=1)
    registrar = Registrar(replace(config, clutter=replace(config.clutter, seeds=seeds)))
    for pair in tqdm(pairs):
        target = registrar.prepare(pair.target)
        network.prepare(target)
        values = {
            "head": partial(network.bone, target=target), "truth": partial(truth_of, pair), "middle": middle_of
        }  # fmt: skip
        begun = time.process_time()
        with grown_from(values.get(led)):
            found = registrar.assess(pair.source, target, viewpoint=pair.viewpoint)
        seconds, right, rounds = time.process_time() - begun, False, 0
        if isinstance(found, Assessment):
            right = se3.pose_error(found.fit.T, pair.T_target_source, pair.source).is_right
            rounds = found.rounds
        rows.setdefault(pair.protocol, []).append((right, rounds, seconds))
    table = [
        [name, str(len(of)), str(sum(r for r, _, _ in of)), str(sum(n > 1 for _, n, _ in of)),
         f"{np.sum([s for _, _, s in of]):.1f}"]
        for name, of in rows.items()
    ]  # fmt: skip
    return markdown.table(["protocol", "scenes", "right pose found", "second round", "CPU s, all"], table)


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


def grown_from(values: Callable[[PreparedSource], Array] | None) -> AbstractContextManager[object]:
    """Regions whose seeds are spread over the points of the largest values; without values, over all as ever."""
    if values is None:
        return nullcontext()
    values = lru_cache(values)  # once a source, not once a radius

    def seeds(source: PreparedSource, count: int) -> NDArray[np.int64]:
        value = values(source).astype(np.float64)
        enough = max(count, round(LED_SHARE * len(value)))
        some = np.argsort(-value, kind="stable")[: max(enough, int((value > 0.5).sum()))]
        points = source.points[some]
        start = int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmin())
        return some[sampling.farthest_points(points, count, start)]

    return mock.patch.object(regions, "_seeds", seeds)


if __name__ == "__main__":
    raise SystemExit(main())
