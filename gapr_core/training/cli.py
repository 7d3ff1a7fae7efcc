"""gapr train: train the network on bones in a folder, or on parametric ones; draw the curves of runs.

gapr train --config config/train.yaml --anatomy DIR --out runs/mine
gapr train --plot runs/mine [runs/other ...] [--out compared.png]
"""

from __future__ import annotations

import math
from argparse import ArgumentParser, Namespace
from dataclasses import replace
from pathlib import Path

from gapr_core.errors import ConfigError
from gapr_core.runtime.arguments import above_zero, at_least_one
from gapr_core.runtime.console import say


def add_arguments(parser: ArgumentParser) -> None:
    """Add the options of `gapr train`."""
    parser.add_argument("--config", type=Path, help="yaml with what differs from the defaults (config/train.yaml)")
    parser.add_argument("--model", default=None, help="yaml of config/model; over the one that --config names")
    parser.add_argument("--initial", default=None, help="weights (safetensors) of the same network to begin with")
    parser.add_argument("--anatomy", type=Path, help="corresponded meshes with splits.json; else parametric bones")
    parser.add_argument("--out", type=Path, help="folder of the run, an interrupted one goes on; with --plot a PNG")
    parser.add_argument("--pairs", type=at_least_one, default=None, help="length of the schedule, in pairs")
    parser.add_argument("--minutes", type=above_zero, default=math.inf, help="stop after so long; call again to go on")
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="a setting over those of --config; repeatable"
    )
    parser.add_argument("--workers", type=int, default=None, help="processes that make pairs")
    parser.add_argument(
        "--plot", type=Path, nargs="+", metavar="RUN", help="train nothing, draw the curves of these runs together"
    )


def run(args: Namespace) -> int:
    """Train, with the progress bar and the lines of validation as the output; or plot."""
    if args.plot:
        return plot(args.plot, args.out)
    if args.out is None:
        raise ConfigError("--out DIR", "none", "name the folder of the run")
    from gapr_core.training.config import read_config  # torch takes seconds to load
    from gapr_core.training.trainer import train

    config = read_config(args.config, args.set)
    options = {name: getattr(args, name) for name in ("model", "initial", "pairs", "workers")}
    given = {name: value for name, value in options.items() if value is not None}
    written = train(replace(config, **given), args.out, args.anatomy, args.minutes)
    say(f"weights in {written}")
    return 0


def plot(runs: list[Path], out: Path | None) -> int:
    """Draw the curves of one run into its folder, or of any number into the named PNG."""
    from gapr_core.training import curves

    if out is None and len(runs) > 1:
        raise ConfigError("--out PNG with several runs", "none", "name the picture")
    out = out or runs[0] / "curves.png"
    if out.suffix.lower() != ".png":
        raise ConfigError("a name that ends in .png", str(out), "rename it")
    say(f"curves in {curves.draw(runs, out)}")
    return 0
