"""Streams: every frame by itself, the `Tracker` and the `Accumulator`, on the same streams in one run.

    python benchmarks/tracking.py --anatomy DIR [--split val] [--count 4] [--bones femur,tibia] [--kinds NAME ...]

Each frame is a small one-sided view. The bone moves a little from frame to frame, or also jumps every eighth frame; or
it is another subject's, so that every pose is wrong; or it rests, and each frame is a slice of it, as an image of a
tracked probe is.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from gapr_core import Accumulator, Registrar, RegistrarConfig, Tracker
from gapr_core.benchmark.judge import judge
from gapr_core.calibration.pairs import without_twins
from gapr_core.data.pair import Pair
from gapr_core.data.pool import specimens
from gapr_core.data.stream import Motion, simulate
from gapr_core.pages import markdown
from gapr_core.runtime.console import say

SLICES = Motion(share=0.04, points=200, step_mm=0.0, step_deg=0.0)
KINDS = {
    "moves": Motion(),
    "smaller views, moves": Motion(share=0.12, points=800, noise_mm=1.5, bias_mm=1.0),
    "moves and jumps": Motion(jump_every=8),
    "another subject's bone": Motion(),
    "rests, slices": SLICES,
    "rests, slices of another subject's bone": SLICES,
}
PEOPLE = 20  # of a bone, at most
ANOTHER_SUBJECT, RESTS, BY_ITSELF = "another subject's bone", "rests", "every frame by itself"


@dataclass
class Tally:
    """What came of the frames of one kind with one method."""

    frames: int = 0
    right: int = 0
    accepted: int = 0
    false_accepts: int = 0
    confident: int = 0  # false accepts at 0.9 or more
    tracked: int = 0
    seconds: tuple[float, ...] = ()


def main() -> int:
    """Run every stream through both, print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anatomy", type=Path, help="folder with the bones; else parametric ones")
    parser.add_argument("--split", default="val")
    parser.add_argument("--count", type=int, default=4, help="streams per bone and kind")
    parser.add_argument("--bones", default="femur,tibia,pelvis,thoracic", help="with commas")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS), metavar="NAME", help="of streams")
    args = parser.parse_args()
    full = Registrar.from_pretrained(RegistrarConfig(num_threads=1))
    methods = {BY_ITSELF: full, "tracker": Tracker(full), "accumulator": Accumulator(Tracker(full), 24)}
    people = {bone: specimens(bone, args.split, PEOPLE, args.anatomy) for bone in args.bones.split(",")}
    tallies = {(kind, name): Tally() for kind in args.kinds for name in chosen(kind)}
    runs = [(kind, bone, i) for kind in args.kinds for bone in people for i in range(args.count)]
    for kind, bone, i in tqdm(runs, "streams"):
        frames = stream(kind, people[bone], i)
        target = full.prepare(frames[0].target)
        for name in chosen(kind):
            if name != BY_ITSELF:
                methods[name].reset()
            for pair in frames:
                count(tallies[kind, name], pair, methods[name], target)
    head = (
        "stream",
        "method",
        "frames",
        "right %",
        "accepted %",
        "false accepts",
        "of these at >= 0.9",
        "answered by tracking %",
        "median s",
        "mean s",
    )
    say(markdown.head(head))
    for (kind, name), tally in tallies.items():
        say(line(kind, name, tally))
    return 0


def chosen(kind: str) -> tuple[str, ...]:
    """The methods for a kind; an accumulator needs a bone that rests."""
    return (BY_ITSELF, "accumulator") if kind.startswith(RESTS) else (BY_ITSELF, "tracker")


def stream(kind: str, people: list, number: int) -> list[Pair]:
    """The frames of one stream; of another subject, whose bone is not the target, so without a truth."""
    own = people[number % len(people)]
    frames = simulate(own, 500 + number, KINDS[kind])
    if ANOTHER_SUBJECT not in kind:
        return frames
    others = [o for o in without_twins(own, people) if o.person != own.person]
    other = simulate(others[number % len(others)], 500 + number, replace(KINDS[kind], frames=1))[0]
    return [replace(pair, target=other.target, T_target_source=np.full((4, 4), np.nan)) for pair in frames]


def count(tally: Tally, pair: Pair, method: Registrar | Tracker | Accumulator, target) -> None:
    """Register one frame and add what came of it."""
    result = method.register(pair.source, target)
    judged = judge(pair, result)
    wrong = bool(judged.false_accept)
    tally.frames += 1
    tally.right += bool(judged.right)
    tally.accepted += result.ok
    tally.false_accepts += wrong
    tally.confident += wrong and result.confidence >= 0.9
    tally.tracked += result.proposer == "track"
    tally.seconds += (result.seconds,)


def line(kind: str, name: str, tally: Tally) -> str:
    """One row of the table."""
    right, accepted, tracked = (f"{100.0 * n / tally.frames:.1f}" for n in (tally.right, tally.accepted, tally.tracked))
    times = [f"{seconds:.3f}" for seconds in (np.median(tally.seconds), np.mean(tally.seconds))]
    cells = (kind, name, tally.frames, right, accepted, tally.false_accepts, tally.confident, tracked, *times)
    return markdown.row(cells)


if __name__ == "__main__":
    raise SystemExit(main())
