"""Poses that are followed between two assessments against assessed ones of the same frames.

    python benchmarks/following.py --anatomy DIR [--split val] [--count 4] [--bones femur,tibia,pelvis] [--every 3]
        [--kinds NAME ...]

One tracker assesses every frame. Another one assesses one of `--every` frames and follows the others where that can be.
The bone moves a little or much from frame to frame, while the view wanders over all of it; or it jumps every eighth
frame; or in the middle of the stream another subject's bone takes its place, so that every pose from then on is wrong.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from gapr_core import Registrar, RegistrarConfig, Tracker
from gapr_core.calibration.pairs import without_twins
from gapr_core.data.pair import Pair
from gapr_core.data.pool import specimens
from gapr_core.data.specimen import Specimen
from gapr_core.data.stream import Motion, simulate
from gapr_core.geometry import se3
from gapr_core.pages import markdown
from gapr_core.runtime.console import say

KINDS = {
    "moves": Motion(),
    "moves, 4000 points": Motion(points=4000),
    "moves fast (8 mm, 6 deg)": Motion(step_mm=8.0, step_deg=6.0),
    "smaller views, moves": Motion(share=0.12, points=800, noise_mm=1.5, bias_mm=1.0),
    "moves and jumps": Motion(jump_every=8),
    "becomes another subject's bone": Motion(),
}
OTHER = "becomes another subject's bone"
SUBJECTS = 20  # of a bone, at most


@dataclass
class Tally:
    """What came of the streams of one kind."""

    frames: int = 0
    asked: int = 0  # to follow, after an assessed frame
    followed: list[tuple[float, float]] = field(default_factory=list)  # errors, mm and deg
    assessed: list[tuple[float, float]] = field(default_factory=list)  # of the same frames, where they were accepted
    apart_mm: list[float] = field(default_factory=list)  # the two poses


def main() -> int:
    """Run every stream through both, print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anatomy", type=Path, help="folder with the bones; else parametric ones")
    parser.add_argument("--split", default="val")
    parser.add_argument("--count", type=int, default=4, help="streams per bone and kind")
    parser.add_argument("--bones", default="femur,tibia,pelvis", help="with commas")
    parser.add_argument("--every", type=int, default=3, help="of so many frames one is assessed")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS), metavar="NAME", help="of streams")
    args = parser.parse_args()
    registrar = Registrar.from_pretrained(RegistrarConfig(num_threads=1))
    bones = {bone: specimens(bone, args.split, SUBJECTS, args.anatomy) for bone in args.bones.split(",")}
    tallies = {kind: Tally() for kind in args.kinds}
    runs = [(kind, bone, i) for kind in args.kinds for bone in bones for i in range(args.count)]
    for kind, bone, i in tqdm(runs, "streams"):
        count(tallies[kind], stream(kind, bones[bone], i), registrar, args.every)
    names = ("stream", "frames", "followed", "asked in vain", "followed beyond 4 mm or 5 deg", "assessed, same frames",
             "followed, median", "assessed, median", "apart, 95 %")  # fmt: skip
    say(markdown.head(names))
    for kind, tally in tallies.items():
        say(row(kind, tally))
    return 0


def stream(kind: str, subjects: list[Specimen], number: int) -> list[Pair]:
    """The frames of one stream; those of another subject's bone lie where the bone was, and have no truth."""
    own = subjects[number % len(subjects)]
    frames = simulate(own, 500 + number, KINDS[kind])
    if kind != OTHER:
        return frames
    others = [o for o in without_twins(own, subjects) if o.person != own.person]
    theirs = simulate(others[number % len(others)], 500 + number, KINDS[kind])
    half = len(frames) // 2
    return frames[:half] + [replaced(*both) for both in zip(frames[half:], theirs[half:], strict=True)]


def replaced(pair: Pair, other: Pair) -> Pair:
    """The other's source where that of the pair is; no pose is right."""
    T = se3.inverse(pair.T_target_source) @ other.T_target_source
    return replace(pair, source=se3.apply(T, other.source), T_target_source=np.full((4, 4), np.nan))


def count(tally: Tally, frames: list[Pair], registrar: Registrar, every: int) -> None:
    """One stream: all frames assessed, and one of `every` assessed and the others followed."""
    both, some, target = Tracker(registrar), Tracker(registrar), registrar.prepare(frames[0].target)
    since = every
    for pair in frames:
        result, found = both.register(pair.source, target), None
        if since + 1 < every:
            tally.asked += 1
            found = some.follow(pair.source, target)
        since = 0 if found is None else since + 1
        if found is None:
            some.register(pair.source, target)
        else:
            tally.followed.append(error(found.T_target_source, pair))
            if result.T_target_source is not None:
                tally.assessed.append(error(result.T_target_source, pair))
                apart_mm = se3.rms_apart_mm(found.T_target_source, result.T_target_source, pair.source)
                tally.apart_mm.append(apart_mm)
        tally.frames += 1


def error(T: np.ndarray, pair: Pair) -> tuple[float, float]:
    """In mm and deg; infinite where no pose is right."""
    if not np.isfinite(pair.T_target_source).all():
        return np.inf, np.inf
    return tuple(se3.pose_error(T, pair.T_target_source, pair.source))


def row(kind: str, tally: Tally) -> str:
    """One row of the table."""
    cells = [kind, tally.frames, len(tally.followed), tally.asked - len(tally.followed)]
    both = tally.followed, tally.assessed
    cells += [sum(mm > se3.RIGHT_MM or deg > se3.RIGHT_DEG for mm, deg in errors) for errors in both]
    cells += ["{:.2f} mm, {:.2f} deg".format(*np.median(errors, axis=0)) if errors else "" for errors in both]
    cells.append(f"{np.percentile(tally.apart_mm, 95):.2f} mm" if tally.apart_mm else "")
    return markdown.row(cells)


if __name__ == "__main__":
    raise SystemExit(main())
