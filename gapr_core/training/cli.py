"""gapr train: train the network on bones in a folder, or on parametric ones."""

from __future__ import annotations

import math
from argparse import ArgumentParser, Namespace
from dataclasses import replace
from pathlib import Path

from gapr_core.console import say


def add_arguments(parser: ArgumentParser) -> None:
    """The options of `gapr train`."""
    parser.add_argument("--config", type=Path, help="yaml with what differs from the defaults (config/train.yaml)")
    parser.add_argument("--model", default=None, help="yaml of config/model; over the one that --config names")
    parser.add_argument("--anatomy", type=Path, help="corresponded meshes with splits.json; else parametric bones")
    parser.add_argument("--out", type=Path, required=True, help="folder of the run; an interrupted run goes on")
    parser.add_argument("--pairs", type=int, default=None, help="length of the schedule, in pairs")
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop after so long; call again to go on")
    parser.add_argument("--workers", type=int, default=None, help="processes that make pairs")


def run(args: Namespace) -> int:
    """Train; the progress bar and the lines of validation are the output."""
    from gapr_core.training.config import TrainConfig  # torch takes seconds to load
    from gapr_core.training.trainer import train

    config = TrainConfig.from_yaml(args.config) if args.config else TrainConfig()
    given = {name: getattr(args, name) for name in ("model", "pairs", "workers") if getattr(args, name) is not None}
    written = train(replace(config, **given), args.out, args.anatomy, args.minutes)
    say(f"weights in {written}")
    return 0
