"""How time and memory grow: with the points of source and target, the number of bones and the share of clutter.

    python benchmarks/growth.py [--anatomy DIR] [--split val] [--repeats 3] [--largest 1e6] [--plot FILE.png]

One femur, seen from one side with 0.3 mm of noise. Times are medians of wall time; memory is the largest that Python
and NumPy allocated above what was there before (`tracemalloc`, in a call of its own, which is not timed). An exponent
is the slope of the logarithms over the last decade: 1 where twice as much takes twice as long.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from numpy.typing import NDArray
from tqdm import tqdm

from gapr_core import Registrar, RegistrarConfig
from gapr_core.data.pair import TARGET_POINTS, Pair
from gapr_core.data.pool import specimens
from gapr_core.data.protocols import make_pair
from gapr_core.data.specimen import Specimen
from gapr_core.geometry import se3
from gapr_core.geometry.sampling import random_directions
from gapr_core.pages import markdown, palette
from gapr_core.runtime.console import say
from gapr_core.runtime.memory import allocated_mb

Array = NDArray[np.float64]
NOISE_MM = 0.3
REACH = 0.45  # of the bone's length: how much of it is seen
USUAL = 3000  # points of a source, where another thing grows
BONES = 1, 2, 4, 8
SHARES = 1.0, 0.7, 0.5, 0.35, 0.25, 0.18  # of a scene's points that are bone


@dataclass(frozen=True)
class Growth:
    """One quantity that grows, and what it costs at each of its values.

    Attributes:
        name: of the quantity.
        step: what is timed.
        x: (K,) its values.
        wall_s: (K,) median wall times.
        memory_mb: (K,) largest allocations.
        is_share: it is a share between 0 and 1, which has no exponent.
    """

    name: str
    step: str
    x: Array
    wall_s: Array
    memory_mb: Array
    is_share: bool = False

    def exponent(self, cost: Array) -> str:
        """Slope of log cost over log x, last decade."""
        if self.is_share:
            return "-"
        last = self.x >= self.x.max() / 10.0
        return f"{np.polyfit(np.log(self.x[last]), np.log(cost[last]), 1)[0]:.2f}"


def main() -> int:
    """Measure all, print a table, draw a picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anatomy", type=Path, help="folder with the bones; else a parametric one")
    parser.add_argument("--split", default="val")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument(
        "--largest", type=float, default=1e6, help="points of the largest source; of the target ten times as many"
    )
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--plot", type=Path)
    args = parser.parse_args()
    registrar = Registrar.from_pretrained(RegistrarConfig(num_threads=args.threads))
    people = specimens("femur", args.split, max(BONES), args.anatomy)
    people = [people[k % len(people)] for k in range(max(BONES))]
    measured = []
    for case in cases(people, registrar, args.largest):
        measured.append(measure(*case, args.repeats))
    say(table(measured))
    if args.plot:
        draw(measured).savefig(args.plot, dpi=150)
    return 0


Case = tuple[str, str, dict[float, Callable[[], object]], bool]


def cases(people: Sequence[Specimen], registrar: Registrar, largest: float) -> Iterator[Case]:
    """Name, step, calls by the value of what grows, and whether that is a share."""
    bone, register = people[0], registrar.register
    source, target = seen(bone, int(largest)), registrar.prepare(cloud(bone, TARGET_POINTS))
    calls = {n: partial(register, source[: int(n)], target) for n in sizes(100, largest)}
    yield "points of the source", "register", calls, False
    targets = {n: cloud(bone, int(n)) for n in sizes(1000, 10.0 * largest)}
    calls = {n: partial(registrar.prepare, each) for n, each in targets.items()}
    yield "points of the target", "prepare", calls, False
    calls = {n: partial(register, source[:USUAL], registrar.prepare(each)) for n, each in targets.items()}
    yield "points of the target", "register", calls, False
    each_alone = [partial(register, seen(one, USUAL), registrar.prepare(cloud(one, TARGET_POINTS))) for one in people]
    yield "bones, one after the other", "register", {k: partial(in_turn, each_alone[:k]) for k in BONES}, False
    scene = make_pair("scene-C3", bone, 5)
    on_scene = partial(register, target=registrar.prepare(scene.target), viewpoint=scene.viewpoint)
    calls = {1.0 - share: partial(on_scene, with_bone_share(scene, share)) for share in SHARES}
    yield "share of clutter", "register a scene", calls, True


def sizes(smallest: float, largest: float) -> list[float]:
    """Two values a decade."""
    return [float(n) for n in np.geomspace(smallest, largest, 1 + round(2 * np.log10(largest / smallest)))]


def cloud(bone: Specimen, count: int) -> Array:
    """(count, 3) points of the surface, mm."""
    return bone.sample(count, np.random.default_rng(1))[0]


def seen(bone: Specimen, count: int) -> Array:
    """(count, 3) points of one end, as one view shows it, moved away, mm; each beginning of it is spread over all."""
    rng = np.random.default_rng(2)
    direction, found = random_directions(1, rng)[0], np.empty((0, 3))
    axis = np.linalg.eigh(np.cov(bone.surface.points.T))[1][:, -1]
    low, high = np.quantile(bone.surface.points @ axis, [0.0, 1.0])
    while len(found) < count:
        points = bone.sample(max(2 * count, 10_000), rng)[0]
        points = points[points @ axis > high - REACH * (high - low)]
        found = np.vstack([found, points[bone.visible_from(points, direction)]])
    T = se3.from_rotation_translation(se3.random_rotation(rng), np.array([100.0, -50.0, 30.0]))
    return se3.apply(T, found[:count] + rng.normal(0.0, NOISE_MM, (count, 3)))


def with_bone_share(scene: Pair, share: float) -> Array:
    """All bone points of a scene, and so many of the others that its share of bone is this one, or the scene's own."""
    is_bone = np.asarray(scene.metadata["is_bone"])
    bone, others = scene.source[is_bone], scene.source[~is_bone]
    count = min(round(len(bone) * (1.0 / share - 1.0)), len(others))
    return np.vstack([bone, np.random.default_rng(3).permutation(others)[:count]])


def in_turn(calls: Sequence[Callable[[], object]]) -> None:
    """One after the other."""
    for call in calls:
        call()


def measure(name: str, step: str, calls: dict[float, Callable[[], object]], is_share: bool, repeats: int) -> Growth:
    """Time the calls, which take turns within every repetition."""
    next(iter(calls.values()))()  # compile, and fill what is kept
    wall: dict[float, list[float]] = {x: [] for x in calls}
    for _ in tqdm(range(repeats), desc=f"{step}, {name}", unit="repetition"):
        for x, call in calls.items():
            start = time.perf_counter()
            call()
            wall[x].append(time.perf_counter() - start)
    memory = [allocated_mb(call) for call in calls.values()]
    times = np.array([np.median(taken) for taken in wall.values()])
    return Growth(name, step, np.array(list(calls)), times, np.array(memory), is_share)


def table(measured: Sequence[Growth]) -> str:
    """A row for each value."""
    rows = []
    for each in measured:
        last = each.exponent(each.wall_s), each.exponent(each.memory_mb)
        for k, x in enumerate(each.x):
            value = f"{x:.2f}" if each.is_share else f"{x:.0f}"
            ends = last if k == len(each.x) - 1 else ("", "")
            rows.append((f"{each.step}: {each.name}", value, f"{1e3 * each.wall_s[k]:.0f}",
                         f"{each.memory_mb[k]:.1f}", *ends))  # fmt: skip
    return markdown.table(
        ("what grows", "value", "wall ms", "allocated MB", "exponent, time", "exponent, memory"), rows
    )


def draw(measured: Sequence[Growth]) -> Figure:
    """Draw time in the upper row, memory in the lower one, a column for each thing that grows."""
    figure = Figure(figsize=(2.6 * len(measured), 4.6), layout="constrained")
    rows = figure.subplots(2, len(measured), sharex="col", sharey="row", squeeze=False)
    for column, each in zip(rows.T, measured, strict=True):
        for axes, cost, colour in zip(column, (each.wall_s, each.memory_mb), palette.SERIES[:2], strict=True):
            axes.plot(each.x, cost, color=colour, marker="o", ms=3)
            axes.set_yscale("log")
            axes.set_xscale("linear" if each.is_share else "log")
            axes.grid(alpha=0.25)
            axes.spines[["top", "right"]].set_visible(False)
        column[0].set_title(each.step, loc="left", fontsize=9)
        column[1].set_xlabel(each.name, fontsize=9)
        if len(each.x) <= len(BONES):
            column[1].set_xticks(each.x, [f"{x:.0f}" for x in each.x])
            column[1].xaxis.set_minor_formatter(NullFormatter())
    rows[0, 0].set_ylabel("wall time, s")
    rows[1, 0].set_ylabel("memory, MB")
    return figure


if __name__ == "__main__":
    raise SystemExit(main())
