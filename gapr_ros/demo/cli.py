"""`gapr demo`: the node registers simulated clouds of a bone; a table and a report hold its poses against the truth.

A probe sweeps along the bone. With --scene a camera circles a wound; with --guided a probe goes where the node says
that a look would help most. With --real DIR public real clouds are registered instead, without the node;
docs/results/real.md says where they are.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from gapr_core.errors import GaprError
from gapr_core.runtime import files
from gapr_core.runtime.arguments import a_path, at_least_one
from gapr_ros.demo import interrupt
from gapr_ros.demo.act import DemoError, camera_round, probe_sweep, write_bag

FRAMES = {"sweep": 24, "scene": 12, "guided": 12}
PERIOD_S = {"sweep": 1.0, "scene": 3.0}
SHORTEST_S = 0.001  # stamps of two clouds differ by a millisecond or more
DOING = {"sweep": "sweeping a probe along it", "scene": "circling a wound with a camera"}
MAKERS = {"sweep": probe_sweep, "scene": camera_round}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gapr demo`."""
    parser.description = __doc__
    act = parser.add_mutually_exclusive_group()
    act.add_argument("--scene", dest="act", action="store_const", const="scene", default="sweep",
                     help="a camera circles a wound: most of what it sees is no bone")  # fmt: skip
    act.add_argument("--guided", dest="act", action="store_const", const="guided",
                     help="small looks, each where the node says that it would help most")  # fmt: skip
    act.add_argument("--real", type=Path, metavar="DIR", help="register the public real data in this folder")
    parser.add_argument("--bone", default="femur", help="femur, pelvis, ...: a parametric bone (default: femur)")
    parser.add_argument("--seed", type=_seed, default=1, help="which subject, which way, where the patient lies")
    parser.add_argument("--frames", type=at_least_one, help="clouds in the bag, or most looks (default: 24; "
                        "--scene and --guided: 12)")  # fmt: skip
    parser.add_argument("--period", type=_period, metavar="S",
                        help="time between two clouds of the bag (default: 1 s; --scene: 3 s)")  # fmt: skip
    parser.add_argument("--weights", type=a_path, help="of a network of your own (gapr train), instead of the shipped")
    parser.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap", help="of the bag")
    parser.add_argument("--out", type=Path, default=Path("demo_output"), help="folder (default: demo_output)")


def _seed(text: str) -> int:
    """Read a whole number, 0 or more."""
    if not text.strip().isdecimal():
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 0, got {text!r}")
    return int(text)


def _period(text: str) -> float:
    """Seconds, a millisecond or more."""
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not SHORTEST_S <= seconds < float("inf"):  # NaN neither
        raise argparse.ArgumentTypeError(f"expected seconds, at least {SHORTEST_S:g}, got {text!r}")
    return seconds


def run(args: argparse.Namespace) -> int:
    """0 when poses came and all were right; 1 when one was wrong, none came, or something did not run."""
    from rich.console import Console

    console = Console(width=None if sys.stdout.isatty() else 110)
    if args.real is not None:
        from gapr_ros.demo import real

        return real.run(args.real, console, args.weights)
    args.frames = FRAMES[args.act] if args.frames is None else args.frames
    try:
        files.check_writable(args.out / "report.html")
        args.out.mkdir(parents=True, exist_ok=True)
        with interrupt.heeded():
            return _guided(args, console) if args.act == "guided" else _from_bag(args, console)
    except (DemoError, GaprError, OSError) as error:
        console.print(f"[red]error:[/red] {error}", highlight=False)
        return 1
    except KeyboardInterrupt:
        console.print("stopped")
        return 130


def _from_bag(args: argparse.Namespace, console: Any) -> int:
    from gapr_ros.demo import report as demo_report
    from gapr_ros.demo.running import observing, play

    say = _numbered(console)
    say(f"Making a {args.bone} (subject {args.seed}) and {DOING[args.act]}")
    period_s = PERIOD_S[args.act] if args.period is None else args.period
    act = MAKERS[args.act](args.bone, args.seed, args.frames, period_s, args.out)
    act = replace(act, parameters={**act.parameters, **_own(args)})
    say(f"Writing {args.frames} clouds to the bag {args.out / 'bag'}")
    write_bag(act, args.out / "bag", args.storage)
    with observing(args.out / "log") as observer:
        say(f"Starting register_node (ROS_DOMAIN_ID={os.environ['ROS_DOMAIN_ID']}) and playing the bag over DDS")
        play(act, observer, args.out, console)
        rows = demo_report.judge(act, observer.answers)
    console.print(demo_report.rich_table(rows))
    lost = sum(row.answer is None for row in rows) - observer.dropped
    if lost > 0:
        console.print(f"[yellow]{lost} clouds did not reach the node: is this machine very busy?[/yellow]")
    say("Writing the report")
    demo_report.write(act, rows, args.out)
    console.print(demo_report.verdict(rows), f"Report: {args.out / 'report.html'}   Picture: {args.out / 'report.png'}")
    return 0 if demo_report.passed(rows) else 1


def _own(args: argparse.Namespace) -> dict[str, Path]:
    """Return the user's parameters of the node."""
    return {"weights": args.weights.resolve()} if args.weights else {}


def _guided(args: argparse.Namespace, console: Any) -> int:
    from gapr_ros.demo import guided
    from gapr_ros.demo import report as demo_report
    from gapr_ros.demo.running import observing

    say = _numbered(console)
    say(f"Making a {args.bone} (subject {args.seed})")
    probe = guided.make_probe(args.bone, args.seed)
    with observing(args.out / "log") as observer:
        say(f"Starting register_node (ROS_DOMAIN_ID={os.environ['ROS_DOMAIN_ID']}) with guide:=true")
        looks = guided.follow(probe, observer, args.frames, args.out, console, _own(args))
    rows = guided.judged(probe, looks)
    console.print(demo_report.rich_table(rows))
    say("Writing the report")
    guided.write(probe, looks, rows, args.out)
    console.print(guided.verdict(looks, rows), f"Report: {args.out / 'report.html'}")
    return 0 if demo_report.passed(rows) else 1


def _numbered(console: Any) -> Callable[[str], None]:
    numbers = iter(range(1, 100))
    return lambda text: console.print(f"[bold]{next(numbers)}. {text}[/bold]", highlight=False)
