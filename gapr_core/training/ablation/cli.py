"""gapr ablate: train the paper's ablations at one budget, test them on held-out subjects, and compare.

gapr ablate --out runs/ablation --pairs 8000 --anatomy DIR --jobs 2

Stop it at any time and call it again: finished networks stay, the one under way goes on from its checkpoint. OUT gets
table.md, table.json, table.csv and curves_*.png again after every network, pairs/ with the test pairs, and one
folder a network and seed, as `gapr train` writes it, with exam.json.
"""

from __future__ import annotations

import math
import os
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from gapr_core import metrics
from gapr_core.benchmark.ransac import ransac, sharpened
from gapr_core.config import RefinementConfig
from gapr_core.data.anatomy import SPLITS
from gapr_core.data.make_pairs import MANIFEST, Recipe, read_manifest, write_pairs
from gapr_core.data.pair_files import load_pair
from gapr_core.data.pool import specimens
from gapr_core.data.protocols import NO_RIGHT_POSE, Pair
from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_core.model import weights
from gapr_core.model.network import GAPRNet
from gapr_core.model.pyramid import build_cloud, target_frame
from gapr_core.registration.fit.refinement import refine_fully
from gapr_core.registration.problem import target
from gapr_core.registration.proposals.consensus import local_to_global
from gapr_core.registration.proposals.network import correspondences_mm
from gapr_core.runtime import files
from gapr_core.runtime.arguments import above_zero, at_least_one, names
from gapr_core.runtime.console import say
from gapr_core.runtime.parallel import end_with_parent
from gapr_core.training import run_folder
from gapr_core.training.ablation.table import FIGURES, folder_of, write
from gapr_core.training.config import TrainConfig, Variant, default_plan, read_plan, trained_as
from gapr_core.training.targets import training_pair
from gapr_core.training.trainer import train
from gapr_core.training.validation import inlier_ratios

METHODS = ("local_to_global", "ransac")

Record = dict[str, Any]


@dataclass(frozen=True)
class Task:
    """One network to train and to examine."""

    folder: Path
    config: TrainConfig
    anatomy: Path | None
    pairs: Path
    deadline: float  # of the clock, seconds
    pose: str = "local_to_global"


def add_arguments(parser: ArgumentParser) -> None:
    """Add the options of `gapr ablate`."""
    parser.add_argument("--out", type=Path, required=True, help="folder of the comparison; an interrupted one goes on")
    parser.add_argument("--pairs", type=at_least_one, required=True, help="budget of every network, in training pairs")
    parser.add_argument("--config", type=Path, help="yaml with what differs from the defaults (config/train.yaml)")
    parser.add_argument("--plan", type=Path, help="which networks, in which tables (config/ablation.yaml)")
    parser.add_argument("--anatomy", type=Path, help="corresponded meshes with splits.json; else parametric bones")
    parser.add_argument("--pose", default=METHODS[0], choices=METHODS, help=f"from matches, in the exam ({METHODS[0]})")
    parser.add_argument("--seeds", type=at_least_one, default=1, help="trainings of every network, seeds 0, 1, ... (1)")
    parser.add_argument("--protocols", default="paper,L1,L2", help="of the test pairs, with commas (paper,L1,L2)")
    parser.add_argument("--count", type=at_least_one, default=10, help="test pairs per protocol and bone (10)")
    parser.add_argument("--split", default="test", choices=[s for s in SPLITS if s != "train"], help="whose bones")
    parser.add_argument("--jobs", type=at_least_one, default=1, help="networks at a time, which share the cores (1)")
    parser.add_argument("--minutes", type=above_zero, default=math.inf, help="stop after so long; call again to go on")


def run(args: Namespace) -> int:
    """Train and examine missing networks, and print the table's place."""
    config = replace(TrainConfig.from_yaml(args.config) if args.config else TrainConfig(), pairs=args.pairs)
    plan = read_plan(args.plan or default_plan())
    origin = "anatomy" if args.anatomy else "parametric"
    recipe = Recipe(names(args.protocols), config.bones, args.count, 0, args.split, args.count, origin)
    missing = ablate(plan, config, args.out, args.anatomy, recipe, args.seeds, args.jobs, args.minutes, args.pose)
    say(f"table in {args.out / 'table.md'}" + (f"; {missing} networks are left, call again" if missing else ""))
    return 0


def ablate(
    plan: Sequence[Variant],
    config: TrainConfig,
    out: Path,
    anatomy: Path | None,
    recipe: Recipe,
    seeds: int = 1,
    jobs: int = 1,
    minutes: float = math.inf,
    pose: str = METHODS[0],
) -> int:
    """Bring the comparison in `out` to its end, or as far as `minutes` suffice.

    Args:
        plan: the rows.
        config: of every training but for model and seed.
        out: folder of the comparison.
        anatomy: real bones; None for parametric ones.
        recipe: pairs of the examination.
        seeds: trainings of every network.
        jobs: processes.
        minutes: budget of this call.
        pose: how the examination makes one from matches: local_to_global, or ransac as in the paper.

    Returns:
        How many networks are not finished yet.

    Raises:
        ConfigError: `out` holds a comparison with other settings, or a protocol of `recipe` has no true pose.
    """
    deadline = time.time() + 60.0 * minutes
    todo = {
        folder_of(out, model, seed): replace(config, model=str(model), seed=seed)
        for seed in range(seeds) for model in dict.fromkeys(trained_as(plan, config.model_settings).values())
    }  # fmt: skip
    for folder, settings in todo.items():
        if (folder / "config.json").exists():
            run_folder.check(folder, settings, settings.network())
    examination(recipe, out / "pairs", anatomy)
    tasks = [Task(folder, settings, anatomy, out / "pairs", deadline, pose) for folder, settings in todo.items()]
    missing = [task for task in tasks if not examined(task)]
    left, written = len(missing), False
    with tqdm(total=len(tasks), initial=len(tasks) - left, unit="network", desc="ablation", disable=None) as bar:
        for done in finish_all(missing, jobs):
            left, written = left - done, done
            bar.update(done)
            if done:
                write(out, plan, config, recipe, seeds)
    if not written:
        write(out, plan, config, recipe, seeds)
    return left


def examination(recipe: Recipe, folder: Path, anatomy: Path | None) -> None:
    """Make the pairs of the examination once: the same for every network."""
    without = [name for name in recipe.protocols if name in NO_RIGHT_POSE]
    if without:
        raise ConfigError("protocols with a true pose", ", ".join(without), "leave them out")
    complete = (folder / MANIFEST).exists() and read_manifest(folder)
    if not (complete and complete["hash"] and complete["recipe"] == recipe.listed()):
        people = {bone: specimens(bone, recipe.split, recipe.people, anatomy) for bone in recipe.bones}
        write_pairs(recipe, people, folder)


def finish_all(tasks: Sequence[Task], jobs: int) -> Iterator[bool]:
    """Finish tasks in order, or `jobs` at a time, each in a process with its share of cores."""
    if jobs == 1:
        yield from map(finish, tasks)
        return
    threads = max(1, len(os.sched_getaffinity(0)) // jobs)
    with ProcessPoolExecutor(jobs, get_context("spawn"), end_with_parent) as pool:
        waiting = [pool.submit(finish_quietly, task, threads) for task in tasks]
        yield from (future.result() for future in as_completed(waiting))


def finish_quietly(task: Task, threads: int) -> bool:
    """`finish` in a process next to others; its output goes to output.log in the task's folder."""
    torch.set_num_threads(threads)
    task.folder.mkdir(parents=True, exist_ok=True)
    with (task.folder / "output.log").open("a") as file, redirect_stderr(file), redirect_stdout(file):
        return finish(task)


def finish(task: Task) -> bool:
    """Train and examine one network, from where an earlier call stopped; False when the time was up."""
    minutes = (task.deadline - time.time()) / 60.0
    if not trained(task) and minutes > 0.0:
        train(task.config, task.folder, task.anatomy, minutes)
    if not trained(task):
        return False
    network = weights.load(task.folder / "weights.safetensors")[0]
    pairs = sorted(task.pairs.glob("*.npz"))
    records = [
        examine(network, load_pair(f), task.pose)
        for f in tqdm(pairs, task.folder.name, False, unit="pair", disable=None)
    ]
    of = {"pairs": read_manifest(task.pairs)["hash"], "pose": task.pose}
    files.write_json(task.folder / "exam.json", {**of, "records": records})
    return True


def examined(task: Task) -> bool:
    """Tell whether the network has its examination; without a stated way of poses, the default one counts.

    Raises:
        ConfigError: it was of other pairs, or with poses found in another way.
    """
    path = task.folder / "exam.json"
    if not path.exists():
        return False
    exam, how = files.read_json(path, "an examination of gapr ablate"), "choose a new --out"
    if exam["pairs"] != read_manifest(task.pairs)["hash"]:
        raise ConfigError(f"an examination of the pairs in {task.pairs}", f"one of others in {path}", how)
    pose = exam.get("pose", METHODS[0])
    if pose != task.pose:
        raise ConfigError(f"an examination with --pose {task.pose}", f"{pose} in {path}", how)
    return True


def trained(task: Task) -> bool:
    """Tell whether the schedule is at its end."""
    path = task.folder / "weights.safetensors"
    return path.exists() and weights.load(path)[1]["step"] >= task.config.pairs // task.config.batch


@torch.inference_mode()
def examine(network: GAPRNet, pair: Pair, pose: str = METHODS[0]) -> Record:
    """Measure inlier ratios and the best pose of one pair, raw and refined; none is a failure."""
    record: Record = {"pair": pair.name, "protocol": pair.protocol, "bone": pair.bone, "person": pair.person}
    frame = target_frame(pair.target, network.config)
    try:
        source, full = (build_cloud(cloud, frame, network.config) for cloud in (pair.source, pair.target))
    except InvalidPointCloudError:
        return record | dict.fromkeys(FIGURES, 0.0)
    truth = training_pair(source, full, pair.T_target_source, frame)
    output = network(source, full)
    record["coarse"], record["fine"] = inlier_ratios(output, source, truth)
    radius_mm = float(truth.radius[0]) * float(source.scale_mm[0])
    found = correspondences_mm(output.matches, source, full)
    agrees_mm = 1.5 * radius_mm
    by_ransac = pose == "ransac"
    poses = ransac(found, agrees_mm, np.random.default_rng(0)) if by_ransac else local_to_global(found, agrees_mm)
    if not len(poses):
        return record | dict.fromkeys([name for name in FIGURES if "rr_" in name], 0.0)
    best = sharpened(poses[0], found, radius_mm) if by_ransac else poses[0]
    refined = refine_fully(best, pair.source, target.prepare(pair.target), RefinementConfig()).T
    return record | _recalled(pair, best, "") | _recalled(pair, refined, "refined_")


def _recalled(pair: Pair, T: Any, prefix: str) -> Record:
    close = metrics.within_paper_limit(metrics.rmse_mm(T, pair.T_target_source, pair.source), pair.target)
    right = metrics.pose_error(T, pair.T_target_source, pair.source).is_right
    return {f"{prefix}rr_paper": float(close), f"{prefix}rr_4_5": float(right)}
