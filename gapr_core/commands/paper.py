"""`gapr paper`: the paper's tables I to V by one command each, with our numbers next to the paper's.

gapr paper --table 1 --anatomy DIR --out runs/table1
gapr paper --table 4 --pairs 24000 --anatomy DIR --out runs/table4

Tables I to III make pairs of the test split (protocol paper; overlap-40 to -70; incomplete) and run the pipeline of the
paper on them: correspondences, RANSAC, its metrics; then the same with point-to-plane refinement, and ICP. Tables IV
and V train every row in the paper's regime at one budget. Call the same line again to go on.
"""

from __future__ import annotations

import math
from argparse import ArgumentParser, Namespace
from dataclasses import replace

from gapr_core.benchmark.methods import REFINED
from gapr_core.commands.benchmark import benchmark
from gapr_core.data import anatomy
from gapr_core.data.make_pairs import Recipe, write_pairs
from gapr_core.data.pool import specimens
from gapr_core.errors import ConfigError
from gapr_core.runtime.arguments import a_path, above_zero, at_least_one, names
from gapr_core.runtime.console import say

PROTOCOLS = {
    1: ("paper",),
    2: ("overlap-40", "overlap-50", "overlap-60", "overlap-70"),
    3: ("incomplete",),
}
TRAINED = {4: ("Backbone (table IV)", "Final cross-attention (table IV)"), 5: ("Transformer (table V)",)}


def add_arguments(parser: ArgumentParser) -> None:
    """Add the options of `gapr paper`."""
    parser.add_argument("--table", type=int, required=True, choices=(*PROTOCOLS, *TRAINED), help="of the paper")
    parser.add_argument("--out", type=a_path, required=True, help="folder of the table; an interrupted one goes on")
    parser.add_argument("--weights", type=a_path, help="of the network in tables 1 to 3 (those that ship)")
    parser.add_argument("--also", default="", help="more methods in tables 1 to 3, with commas: predator@WEIGHTS")
    parser.add_argument("--anatomy", type=a_path, help="corresponded meshes with splits.json; else parametric bones")
    parser.add_argument("--split", default="test", choices=[s for s in anatomy.SPLITS if s != "train"], help="(test)")
    parser.add_argument("--bones", default=",".join(anatomy.BONES), help="with commas; the paper's four")
    parser.add_argument("--count", type=at_least_one, default=40, help="pairs for each bone and protocol (40)")
    parser.add_argument("--jobs", type=at_least_one, default=1, help="processes (1)")
    parser.add_argument("--config", type=a_path, help="of the trainings in tables 4 and 5 (config/ablate_paper.yaml)")
    parser.add_argument("--pairs", type=at_least_one, help="budget of every network in tables 4 and 5")
    parser.add_argument("--seeds", type=at_least_one, default=1, help="trainings of every network in them (1)")
    parser.add_argument("--minutes", type=above_zero, default=math.inf, help="stop a training after so long")


def run(args: Namespace) -> int:
    """Make the table, and say where it is."""
    bones = names(args.bones)
    origin = "anatomy" if args.anatomy else "parametric"
    recipe = Recipe(PROTOCOLS.get(args.table, ("paper",)), bones, args.count, 0, args.split, args.count, origin)
    left = trained_table(args, recipe) if args.table in TRAINED else compared_table(args, recipe)
    say(f"table {args.table} in {args.out / 'table.md'}" + (f"; {left} networks are left, call again" if left else ""))
    return 0


def compared_table(args: Namespace, recipe: Recipe) -> int:
    """Tables I to III: one network on pairs of the split."""
    if args.weights is not None and not args.weights.is_file():
        raise ConfigError("--weights FILE", f"{args.weights}, which is none", "check the path")
    pairs = args.out / "pairs"
    people = {bone: specimens(bone, recipe.split, recipe.people, args.anatomy) for bone in recipe.bones}
    write_pairs(recipe, people, pairs)
    ours = f"gapr_paper@{args.weights}" if args.weights else "gapr_paper"
    methods = [ours, ours + REFINED, *names(args.also), "icp"]
    benchmark(pairs, methods, args.out, jobs=args.jobs, ours=ours)
    return 0


def trained_table(args: Namespace, recipe: Recipe) -> int:
    """Tables IV and V: every row is trained; returns how many networks are not finished yet."""
    from gapr_core.training.ablation.cli import ablate
    from gapr_core.training.config import TrainConfig, default_plan, read_plan

    if args.pairs is None:
        raise ConfigError("--pairs N", "none", "name the budget of every network, such as 24000")
    folder = default_plan().parent
    config = TrainConfig.from_yaml(args.config or folder / "ablate_paper.yaml")
    config = replace(config, pairs=args.pairs, bones=recipe.bones)
    plan = [row for row in read_plan(folder / "ablation_paper.yaml") if row.table in TRAINED[args.table]]
    return ablate(plan, config, args.out, args.anatomy, recipe, args.seeds, args.jobs, args.minutes, "ransac")
