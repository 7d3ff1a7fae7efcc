"""A stream of scenes through register_node: right, wrong, refused and late.

    python benchmarks/scene_stream.py [--anatomy DIR --split val] [--bone femur] [--frames 200] [--direct] [--unnamed]

A camera circles a wound while the bone sways (`gapr_core.data.scenes.stream`); the clouds are in the camera's own
frame, and the next one is sent when the last one was answered, so that none is dropped. With --direct the clouds go
through a `Tracker` in this process, without ROS: cheaper. With --unnamed nobody
says where the camera is, and its place is inferred.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from gapr_core import RegistrarConfig, Tracker
from gapr_core.data.pool import specimens
from gapr_core.data.scenes.stream import SceneMotion, simulate
from gapr_core.data.specimen import Specimen
from gapr_core.pages import markdown
from gapr_core.runtime import origin
from gapr_core.runtime.console import say
from gapr_ros.demo.act import Act, act_of_pairs, write_stl
from gapr_ros.demo.observer import Answer
from gapr_ros.demo.report import Row, judge

HEAD = ("stream", "frames", "right %", "wrong", "of these at >= 0.9", "refused %", "no answer",
        "median error mm", "median ms", "95 % ms")  # fmt: skip
Ask = Callable[[int], Answer | None]


def main() -> int:
    """Run the stream, print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anatomy", type=Path, help="folder with the bones; else parametric ones")
    parser.add_argument("--split", default="val")
    parser.add_argument("--bone", default="femur")
    parser.add_argument("--level", default="scene-C2", help="scene-C1, scene-C2, scene-C3")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--direct", action="store_true", help="a Tracker in this process, no ROS")
    parser.add_argument("--unnamed", action="store_true", help="say nothing of where the camera is")
    args = parser.parse_args()
    people = specimens(args.bone, args.split, 1 + args.seed, args.anatomy)
    specimen = people[args.seed % len(people)]
    say(f"`python {' '.join(sys.argv)}`, commit {origin.commit()}, {os.cpu_count()} cores of {origin.cpu_name()}\n")
    say(markdown.head(HEAD))
    name = ("in-process" if args.direct else "node") + (", no viewpoint" if args.unnamed else "")
    with tempfile.TemporaryDirectory() as folder:
        act = stream(specimen, args.seed, SceneMotion(args.frames, args.level), Path(folder))
        with asking(act, args.direct, args.unnamed, Path(folder)) as ask:
            say(line(f"{args.bone}, {args.level}, {name}", answered(act, ask)))
    return 0


def stream(specimen: Specimen, seed: int, motion: SceneMotion, folder: Path) -> Act:
    """All frames, and the bone as a file."""
    path = folder / f"{specimen.bone}.stl"
    write_stl(specimen.surface, path)
    pairs = list(tqdm(simulate(specimen, seed, motion), "images", motion.frames, disable=None))
    return act_of_pairs(specimen, path, pairs, period_s=1.0)


def asking(act: Act, direct: bool, unnamed: bool, folder: Path) -> AbstractContextManager[Ask]:
    """Give a function from a frame's number to its answer."""
    if direct:
        return in_process(act, None if unnamed else np.zeros(3))
    return through_node(act, {"viewpoint": "auto" if unnamed else "origin"}, folder)


@contextmanager
def in_process(act: Act, viewpoint: NDArray[np.float64] | None) -> Iterator[Ask]:
    """A `Tracker` that is asked directly; the viewpoint is (3,) mm, frame of the camera."""
    tracker = Tracker.from_pretrained(RegistrarConfig())
    target = tracker.prepare(act.bone)

    def ask(frame: int) -> Answer:
        sent = time.monotonic()
        result = tracker.register(act.clouds[frame], target, viewpoint=viewpoint)
        return Answer(
            result.T_target_source, result.reason, result.confidence, result.tre_mm, result.tre95_mm,
            1000.0 * result.seconds, time.monotonic(), sent,
        )  # fmt: skip

    yield ask


@contextmanager
def through_node(act: Act, parameters: dict[str, object], folder: Path) -> Iterator[Ask]:
    """A node as its own process; a cloud is sent when the one before was answered."""
    from gapr_ros.demo.running import Sender, observing, running

    with observing(folder / "log") as observer:
        with running(observer, folder, {**act.node_parameters, **parameters}) as node:
            sender = Sender(node, act.frame_id)
            node.wait_until_ready()
            yield lambda frame: sender.ask(act.clouds[frame], act.stamp_ms(frame))


def answered(act: Act, ask: Ask) -> list[Row]:
    """Every frame with its answer, judged."""
    answers = {act.stamp_ms(frame): ask(frame) for frame in tqdm(range(len(act.clouds)), "frames", disable=None)}
    return judge(act, {stamp: answer for stamp, answer in answers.items() if answer is not None})


def line(name: str, rows: Sequence[Row]) -> str:
    """One row of the table."""
    marks = [row.mark for row in rows]
    confident = sum(row.mark == "bad" and row.answer.confidence >= 0.9 for row in rows if row.answer)
    errors = [row.error_mm for row in rows if row.mark in ("ok", "bad")]
    late = [row.answer.latency_ms for row in rows if row.answer]
    share = {mark: f"{100.0 * marks.count(mark) / len(rows):.1f}" for mark in ("ok", "hold")}
    times = [f"{np.quantile(late, q):.0f}" if late else "" for q in (0.5, 0.95)]
    error = f"{np.median(errors):.2f}" if errors else ""
    cells = (share["ok"], marks.count("bad"), confident, share["hold"], marks.count(""), error, *times)
    return markdown.row((name, len(rows), *cells))


if __name__ == "__main__":
    raise SystemExit(main())
