"""Is the covariance honest for every kind of sensor? NEES and errors at the bone, by family.

    python benchmarks/uncertainty.py --anatomy DIR [--split val] [--count 24] [--families pointer,ultrasound] [--full]
    python benchmarks/uncertainty.py --pairs DIR

Poses come from a refinement that starts at the truth, or with --full from the search. 5.35 is the median of chi square
with six degrees of freedom: a median NEES of 1 in its units means an honest covariance, more means one too small. The
share that ends within 4 mm and 5 deg of the truth is what no search can exceed.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from gapr_core import Registrar, RegistrarConfig
from gapr_core.calibration.conformal import MEDIAN_NEES
from gapr_core.config import SENSOR_KINDS, SensorConfig
from gapr_core.data.pair import Pair
from gapr_core.data.pair_files import load_pair, pair_paths
from gapr_core.data.pool import specimens
from gapr_core.data.protocols import make_pair
from gapr_core.geometry import se3
from gapr_core.geometry.twists import error_twist, nees, predicted_rmse_mm
from gapr_core.pages import markdown
from gapr_core.registration.checks.assess import bias_corrected
from gapr_core.registration.fit.refinement import Fit, refine_fully
from gapr_core.registration.problem import source as sources
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.uncertainty.covariance import PoseUncertainty, estimate
from gapr_core.registration.uncertainty.smooth_bias import corrected_fit
from gapr_core.results import Refusal
from gapr_core.runtime.console import say

FAMILIES = "paper,L1,L2,L3,L2-wave,L2-gp,L3-gp,pointer,ultrasound,depth-camera,laser,sweep"
Measured = tuple[float, float, float, bool]


def main() -> int:
    """Measure every family, print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anatomy", type=Path, help="folder with the bones; else parametric ones")
    parser.add_argument("--split", default="val", choices=("train", "val"))
    parser.add_argument("--bones", default="femur,tibia,pelvis", help="with commas")
    parser.add_argument("--count", type=int, default=24, help="pairs of each family")
    parser.add_argument("--families", default=FAMILIES, help="protocols, with commas")
    parser.add_argument("--pairs", type=Path, help="a folder of pairs instead, by protocol")
    parser.add_argument("--full", action="store_true", help="register, instead of refining from the truth")
    parser.add_argument("--declared", action="store_true", help="name the kind of sensor to the library")
    args = parser.parse_args()
    lines = [
        markdown.head(("family", "pairs", "within 4 mm and 5 deg, %", "median NEES / 5.35", "TRE, mm", "predicted, mm"))
    ]
    for family, pairs in (of_folder(args.pairs) if args.pairs else drawn(args)).items():
        kinds = [kind for kind in SENSOR_KINDS if family.replace("-", "_").startswith(kind)]
        sensor = SensorConfig(kinds[0] if args.declared and kinds else "unknown")
        registrar = Registrar(RegistrarConfig(num_threads=1, sensor=sensor))
        found = [measure(registrar, pair(), args.full) for pair in tqdm(pairs, family, leave=False)]
        lines.append(line(family, found))
    say("\n".join(lines))
    return 0


def drawn(args: argparse.Namespace) -> dict[str, list[Callable[[], Pair]]]:
    """Pairs of every family, made when they are called."""
    bones = [s for bone in args.bones.split(",") for s in specimens(bone, args.split, 3, args.anatomy)[:3]]
    return {family: [partial(make_pair, family, bones[i % len(bones)], 3000 + i) for i in range(args.count)]
            for family in args.families.split(",")}  # fmt: skip


def of_folder(folder: Path) -> dict[str, list[Callable[[], Pair]]]:
    """The pairs of a folder that have a truth, by protocol, read when they are called."""
    found: dict[str, list[Callable[[], Pair]]] = {}
    for path in pair_paths(folder):
        pair = load_pair(path)
        if pair.has_truth:
            found.setdefault(pair.protocol, []).append(partial(load_pair, path))
    return found


def line(family: str, found: Sequence[Measured | None]) -> str:
    """One row; without medians where no source can be used."""
    right = sum(row[3] for row in found if row)
    cells = [family, len(found), f"{100.0 * right / len(found):.1f}"]
    rows = np.array([row[:3] for row in found if row])
    if not len(rows):
        return markdown.row([*cells, "-", "-", "-"])
    surprise, true_mm, predicted_mm = np.median(rows, axis=0)
    return markdown.row([*cells, f"{surprise / MEDIAN_NEES:.2f}", f"{true_mm:.2f}", f"{predicted_mm:.2f}"])


def measure(registrar: Registrar, pair: Pair, full: bool) -> Measured | None:
    """NEES, true and predicted error over the bone, mm, and is it right; None where the source cannot be used."""
    target = registrar.prepare(pair.target)
    found = (assessed if full else refined)(registrar, pair, target)
    if found is None:
        return None
    fit, uncertainty, points = found
    moved = se3.apply(fit.T @ se3.inverse(pair.T_target_source), target.points) - target.points
    true_mm = float(np.sqrt((moved**2).sum(axis=1).mean()))
    twist = error_twist(fit.T, pair.T_target_source, points)
    centre = fit.moved.mean(axis=0)
    predicted_mm = predicted_rmse_mm(uncertainty.covariance, target.points, centre)
    is_right = se3.pose_error(fit.T, pair.T_target_source, pair.source).is_right
    return nees(twist, uncertainty.covariance), true_mm, predicted_mm, is_right


def refined(registrar: Registrar, pair: Pair, target: PreparedTarget) -> tuple[Fit, PoseUncertainty, np.ndarray] | None:
    """The pose that a refinement from the truth comes to."""
    config, source = registrar.config, sources.prepare(pair.source, registrar.config.source)
    if isinstance(source, Refusal):
        return None
    fit = refine_fully(pair.T_target_source, source.points, target, config.refinement, source.neighbours)
    known = estimate(fit, config.covariance, config.sensor).covariance
    fit = corrected_fit(fit, known, source, target, config)
    return fit, estimate(fit, config.covariance, config.sensor), source.points


def assessed(
    registrar: Registrar, pair: Pair, target: PreparedTarget
) -> tuple[Fit, PoseUncertainty, np.ndarray] | None:
    """The best hypothesis of a full registration, refused or not, if it is within 4 mm and 5 deg."""
    assessment = registrar.assess(pair.source, target)
    if isinstance(assessment, Refusal):
        return None
    assessment = bias_corrected(assessment, registrar.config)
    if not se3.pose_error(assessment.fit.T, pair.T_target_source, assessment.source.points).is_right:
        return None
    return assessment.fit, assessment.uncertainty, assessment.source.points


if __name__ == "__main__":
    raise SystemExit(main())
