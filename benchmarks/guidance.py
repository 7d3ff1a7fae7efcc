"""How many points does it take until the bone is known to 2 mm? Guided looks against a sweep and against random ones.

    python benchmarks/guidance.py --anatomy DIR [--split val] [--count 6] [--bones femur,tibia,pelvis] [--plot FILE.png]

Every case begins with the same patch of the bone, 30 mm across, 60 points, with 1.5 mm of noise and a bias of 0.7 mm
(standard deviation) that is common to the patch. Then patches are added until the answer is accepted and its `tre95_mm`
is at most 2 mm: where the guidance says, next to the last one along the bone and back on its other sides (a sweep), or
anywhere. A case that does not arrive within `--most` patches counts as that many; the table says how many arrive.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from gapr_core import Registrar, RegistrarConfig, RegistrationResult
from gapr_core.data.pool import specimens
from gapr_core.data.protocols import TARGET_POINTS
from gapr_core.data.specimen import Specimen
from gapr_core.geometry import extent, se3
from gapr_core.pages import markdown
from gapr_core.runtime.console import say

PATCH_MM, POINTS, NOISE_MM, BIAS_MM = 30.0, 60, 1.5, 0.7
GOAL_MM = 2.0
STEP_MM, NEXT_LANE_RAD = 20.0, np.pi / 2.0  # of a sweep: along the bone, and about it at either end
STRATEGIES = ("guided", "sweep", "random")


@dataclass
class Case:
    """One bone, where the looks begin, and the truth."""

    surface: np.ndarray
    normals: np.ndarray
    target: np.ndarray
    start: int
    seed: int
    T_source_target: np.ndarray

    def look(self, centre: np.ndarray, number: int) -> np.ndarray:
        """The points (N, 3) of a look at the surface nearest to `centre`, source frame."""
        rng = np.random.default_rng([self.seed, number])
        nearest = int(((self.surface - centre) ** 2).sum(axis=1).argmin())
        inside = ((self.surface - self.surface[nearest]) ** 2).sum(axis=1) < (PATCH_MM / 2.0) ** 2
        inside &= self.normals @ self.normals[nearest] > 0.3
        seen = rng.permutation(np.flatnonzero(inside))[:POINTS]
        points = self.surface[seen] + rng.normal(0.0, NOISE_MM, (len(seen), 3))
        return se3.apply(self.T_source_target, points + rng.normal(0.0, BIAS_MM) * self.normals[seen])


def case_of(specimen: Specimen, seed: int) -> Case:
    """A bone at rest somewhere; the looks begin anywhere on it."""
    rng = np.random.default_rng([seed, 61])
    target, _ = specimen.sample(TARGET_POINTS, rng)
    origin = target.mean(axis=0)
    surface, normals = specimen.sample(30_000, rng)
    T = se3.from_rotation_translation(se3.random_rotation(rng), rng.uniform(-150.0, 150.0, 3))
    return Case(surface - origin, normals, target - origin, int(rng.integers(len(surface))), seed, T)


def next_of(strategy: str, case: Case) -> Callable[[RegistrationResult, np.ndarray, int], np.ndarray]:
    """Where a strategy looks: from the last answer, the last centre and the number of the look."""
    rng = np.random.default_rng([case.seed, 67])
    axis = extent.principal(case.surface).axes[0]
    along = case.surface @ axis
    next_lane = se3.exp(np.concatenate([np.zeros(3), NEXT_LANE_RAD * axis]))
    way = 1.0 if along[case.start] < along.mean() else -1.0

    def guided(result: RegistrationResult, last: np.ndarray, number: int) -> np.ndarray:
        return result.guidance.patches[0].centre if result.guidance else anywhere(result, last, number)

    def sweep(result: RegistrationResult, last: np.ndarray, number: int) -> np.ndarray:
        nonlocal way
        ahead = last + way * STEP_MM * axis
        if along.min() < ahead @ axis < along.max():
            return ahead
        way = -way
        return se3.apply(next_lane, last)

    def anywhere(result: RegistrationResult, last: np.ndarray, number: int) -> np.ndarray:
        return case.surface[rng.integers(len(case.surface))]

    return {"guided": guided, "sweep": sweep, "random": anywhere}[strategy]


def run(case: Case, strategy: str, registrar: Registrar, target: object, most: int) -> list[dict[str, float]]:
    """The looks of one strategy until the goal: points so far, the bound, the true error."""
    choose, centre, cloud, steps = next_of(strategy, case), case.surface[case.start], np.empty((0, 3)), []
    for number in range(most):
        nearest = case.surface[((case.surface - centre) ** 2).sum(axis=1).argmin()]
        cloud = np.vstack([cloud, case.look(nearest, number)])
        result = registrar.register(cloud, target)  # type: ignore[arg-type]
        bound, true = np.inf, np.inf
        if result.T_target_source is not None:
            bound = float(result.tre95_mm or np.inf)
            gap = case.target - se3.apply(result.T_target_source @ case.T_source_target, case.target)
            true = float(np.sqrt((gap**2).sum(axis=1).mean()))
        steps.append({"points": len(cloud), "bound": bound, "true": true})
        if bound <= GOAL_MM:
            break
        centre = choose(result, nearest, number)
    return steps


def main() -> int:
    """Run every case with every strategy, print one table, draw one plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anatomy", type=Path, help="folder with the bones; else parametric ones")
    parser.add_argument("--split", default="val")
    parser.add_argument("--count", type=int, default=6, help="cases per bone")
    parser.add_argument("--bones", default="femur,tibia,pelvis", help="with commas")
    parser.add_argument("--most", type=int, default=20, help="patches after which a case has not arrived")
    parser.add_argument("--plot", type=Path, help="picture of the points needed")
    args = parser.parse_args()
    registrar = Registrar.from_pretrained(RegistrarConfig(guide=True))
    bones = {bone: specimens(bone, args.split, args.count, args.anatomy) for bone in args.bones.split(",")}
    cases = [case_of(people[i % len(people)], 900 + i) for people in bones.values() for i in range(args.count)]
    runs: dict[str, list[list[dict[str, float]]]] = {strategy: [] for strategy in STRATEGIES}
    for case in tqdm(cases, unit="case"):
        target = registrar.prepare(case.target)
        for strategy in STRATEGIES:
            runs[strategy].append(run(case, strategy, registrar, target, args.most))
    report(runs)
    if args.plot:
        draw(runs, args.plot)
    return 0


def report(runs: dict[str, list[list[dict[str, float]]]]) -> None:
    """Points needed, cases that did not arrive, and the ratios to the guided looks of the same case."""
    needed = {name: np.array([steps[-1]["points"] for steps in cases]) for name, cases in runs.items()}
    arrived = {name: np.array([steps[-1]["bound"] <= GOAL_MM for steps in cases]) for name, cases in runs.items()}
    say(markdown.head(("looks", "cases", "arrived", "of these truly within 2 mm", "median points",
                       "guided / this, median", "95 % interval")))  # fmt: skip
    for name, cases in runs.items():
        true = np.array([steps[-1]["true"] for steps in cases])[arrived[name]]
        ratio = needed["guided"] / needed[name]
        draws = np.random.default_rng(0).integers(len(ratio), size=(2000, len(ratio)))
        low, high = np.quantile(np.median(ratio[draws], axis=1), [0.025, 0.975])
        within = f"{int((true <= GOAL_MM).sum())} of {len(true)}"
        say(markdown.row((name, len(cases), int(arrived[name].sum()), within, f"{np.median(needed[name]):.0f}",
                          f"{np.median(ratio):.2f}", f"{low:.2f} to {high:.2f}")))  # fmt: skip


def draw(runs: dict[str, list[list[dict[str, float]]]], path: Path) -> None:
    """The share of the cases that have arrived, over the points scanned."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.0, 3.6), layout="constrained")
    for name, cases in runs.items():
        points = np.sort([steps[-1]["points"] for steps in cases if steps[-1]["bound"] <= GOAL_MM])
        axes.step(np.r_[0, points], 100.0 * np.arange(len(points) + 1) / len(cases), where="post", label=name)
    axes.set_xlabel("points scanned")
    axes.set_ylabel("cases known to 2 mm (95 % bound), %")
    axes.set_ylim(0.0, 102.0)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    raise SystemExit(main())
