"""Check points: how often they confirm right poses and contradict wrong ones, by their number.

    python benchmarks/check_points.py --anatomy DIR [--split val] [--count 6] [--bones femur,tibia,pelvis,thoracic]

Sources of protocols L2 and pointer are registered. Then points are touched on the half of the bone that faces where the
source was, spread over it, by a pointer that lies 0.5 +- 0.35 mm outside, the same in all points, with 0.4 mm of noise.
They check the answer where it was accepted and right, and poses that are 4 mm or more off over the bone, each with the
answer's covariance: the rivals that were compared, the answer moved by 5 to 10 mm over the bone, and the best pose on
another subject's bone.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from gapr_core import Registrar, RegistrarConfig, RegistrationResult, check_points
from gapr_core.config import SensorConfig
from gapr_core.data import anatomy
from gapr_core.data.pair import Pair
from gapr_core.data.pool import specimens
from gapr_core.data.protocols import make_pair
from gapr_core.geometry import sampling, se3
from gapr_core.pages import markdown
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.results import Verdict
from gapr_core.runtime.console import say

Array = NDArray[np.float64]
Case = tuple[str, PreparedTarget, RegistrationResult]  # what the pose is, on which bone, the answer with it

COUNTS = 4, 8, 12, 20
SENSORS = {"L2": "unknown", "pointer": "pointer"}
STANDOFF_MM, STANDOFF_SD_MM, NOISE_MM = 0.5, 0.35, 0.4
MOVED_MM = 5.0, 10.0
RIGHT, RIVAL, MOVED, OTHER = "the answer, right", "a rival of it", "the answer, moved 5 to 10 mm", "on another subject"


def main() -> int:
    """Register, touch, check; print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anatomy", type=Path, help="folder with the bones; else parametric ones")
    parser.add_argument("--split", default="val")
    parser.add_argument("--bones", default=",".join(anatomy.BONES), help="with commas")
    parser.add_argument("--count", type=int, default=6, help="subjects of each bone, one source by protocol of each")
    args = parser.parse_args()
    registrars = {kind: Registrar.from_pretrained(RegistrarConfig(sensor=SensorConfig(kind=kind)))
                  for kind in SENSORS.values()}  # fmt: skip
    seen: Counter[tuple[str, int, Verdict]] = Counter()
    for bone in args.bones.split(","):
        subjects = specimens(bone, args.split, args.count, args.anatomy)
        for number, specimen in enumerate(tqdm(subjects, bone)):
            for protocol, kind in SENSORS.items():
                pair, rng = make_pair(protocol, specimen, number), np.random.default_rng(number)
                bone_itself = registrars[kind].prepare(pair.target)
                other = registrars[kind].prepare(make_pair(protocol, subjects[number - 1], number).target)
                for case, target, result in cases_of(pair, bone_itself, other, registrars[kind], rng):
                    for count in COUNTS:
                        points = touched(pair, bone_itself, count, rng)
                        seen[case, count, verdict_of(points, target, result)] += 1
    say(table(seen))
    return 0


def cases_of(
    pair: Pair, target: PreparedTarget, other: PreparedTarget, registrar: Registrar, rng: np.random.Generator
) -> Iterator[Case]:
    """The answer to a pair, where it is accepted and right, and wrong poses that claim the same certainty."""
    truth = pair.T_target_source
    result = registrar.register(pair.source, target)
    answered = result.T_target_source
    if answered is None or not se3.pose_error(answered, truth, pair.source).is_right:
        return
    yield RIGHT, target, result
    wrong = [(RIVAL, rival.T_target_source) for rival in result.hypotheses[1:]]
    wrong.append((MOVED, moved(answered, target, rng)))
    for case, T in wrong:
        if off_mm(T, truth, target) > se3.RIGHT_MM:
            yield case, target, replace(result, T_target_source=T)
    there = registrar.register(pair.source, other).best
    if there is not None:
        centre_mm = se3.apply(there, pair.source).mean(axis=0)
        yield OTHER, other, replace(result, T_target_source=there, centre_mm=centre_mm)


def moved(T: Array, target: PreparedTarget, rng: np.random.Generator) -> Array:
    """The pose with an error of some size over the bone, in a random direction and about a random axis."""
    middle, size_mm = target.points.mean(axis=0), rng.uniform(*MOVED_MM)
    twist = rng.normal(size=6) / [1.0, 1.0, 1.0, *3 * [target.half_extent_mm / 2.0]]
    share = size_mm / off_mm(se3.exp(twist, middle), np.eye(4), target)
    return se3.exp(share * twist, middle) @ T


def off_mm(T: Array, truth: Array, target: PreparedTarget) -> float:
    """Root mean square error over the bone."""
    return se3.rms_apart_mm(T @ se3.inverse(truth), np.eye(4), target.points)


def touched(pair: Pair, target: PreparedTarget, count: int, rng: np.random.Generator) -> Array:
    """(count, 3) mm, source frame: points on the side of the bone where the source is."""
    near = target.tree.query(se3.apply(pair.T_target_source, pair.source))[1]
    side = np.flatnonzero(target.normals @ target.normals[near].mean(axis=0) > 0.0)
    some = side[rng.choice(len(side), min(len(side), 40 * count), replace=False)]
    chosen = some[sampling.thin(target.points[some], count)]
    out = rng.normal(STANDOFF_MM, STANDOFF_SD_MM) * target.normals[chosen]
    points = target.points[chosen] + out + rng.normal(0.0, NOISE_MM, (len(chosen), 3))
    return se3.apply(se3.inverse(pair.T_target_source), points)


def verdict_of(points: Array, target: PreparedTarget, result: RegistrationResult) -> Verdict:
    """What points of a pointer say."""
    return check_points(points, target, result, RegistrarConfig(sensor=SensorConfig(kind="pointer"))).verdict


def table(seen: Counter[tuple[str, int, Verdict]]) -> str:
    """Shares of the verdicts for each kind of pose and number of points."""
    lines = [markdown.head(("the pose", "points", "poses", "holds", "says little", "contradicted"))]
    for case in (RIGHT, RIVAL, MOVED, OTHER):
        for count in COUNTS:
            verdicts = [
                seen[case, count, verdict] for verdict in (Verdict.HOLDS, Verdict.SAYS_LITTLE, Verdict.CONTRADICTED)
            ]
            poses = sum(verdicts)
            lines.append(markdown.row((case, count, poses, *(f"{number / max(poses, 1):.1%}" for number in verdicts))))
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(main())
