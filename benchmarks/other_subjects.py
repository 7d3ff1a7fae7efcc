"""Bones that are not the target's: how many sources of another subject, or of the other side, are accepted.

    `python benchmarks/other_subjects.py --anatomy DIR --out DIR [--count 2000] [--mirrored 300] [--sides 60]
     [--similar 0]`

Sources are of the same bone of another subject, seen as at L3, of every target and subject in turn; or of the mirrored
femur or tibia, which has no pose on this one; or of the mirrored pelvis or rib cage, which is much the same bone and is
judged against the pose of its other side. Mirrored bones are seen as at L1, L2 and L3 in turn. So are those whose
target is the most similar bone of the other subjects, of any split, grown to their own size.

Finished pairs stay in DIR/records.jsonl, so that a stopped run goes on where it was.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import groupby
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from gapr_core import Registrar, RegistrarConfig, metrics
from gapr_core.benchmark import records
from gapr_core.benchmark.judge import record_of
from gapr_core.benchmark.record import Record
from gapr_core.calibration.other_side import on_own_side
from gapr_core.calibration.pairs import without_twins
from gapr_core.data import anatomy
from gapr_core.data.pair import TARGET_POINTS, Pair
from gapr_core.data.pool import specimens
from gapr_core.data.protocols import make_pair
from gapr_core.data.specimen import Specimen
from gapr_core.data.twins import most_similar
from gapr_core.geometry import se3
from gapr_core.metrics.confidence import SURE
from gapr_core.pages import markdown
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.runtime import origin
from gapr_core.runtime.console import say
from gapr_core.runtime.parallel import end_with_parent

Array = NDArray[np.float64]
Bones = dict[tuple[str, str], Specimen]  # of a bone's name and a subject
SUBJECT, MIRRORED, SIDE, SIMILAR = "another-subject", "mirrored", "other-side", "most-similar"
LONG, SYMMETRIC = ("femur", "tibia"), ("pelvis", "thoracic")
LEVELS = ("L1", "L2", "L3")
PEOPLE, PARAMETRIC = 20, 5  # parametric subjects: where a bone has no others, and of the long bones as well
MOST_SIMILAR = 3  # other subjects for each source
COMPARED = 5000  # points, for the distance between two bones
_bones: Bones = {}  # of this process


@dataclass(frozen=True, order=True)
class Case:
    """One pair: the subject of the target, whose bone the source is of, how it is seen."""

    bone: str
    target: str
    kind: str
    source: str
    level: str
    seed: int

    @property
    def name(self) -> str:
        """Different for each pair of a run."""
        return "_".join(map(str, vars(self).values()))


def main() -> int:
    """Register every pair that is not on record yet, print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anatomy", type=Path, help="folder with the bones; else parametric ones")
    parser.add_argument("--split", default="val")
    parser.add_argument("--bones", default=",".join(anatomy.BONES), help="with commas")
    parser.add_argument("--count", type=int, default=2000, help="pairs of another subject's bone")
    parser.add_argument("--mirrored", type=int, default=300, help="pairs of a mirrored femur or tibia")
    parser.add_argument("--sides", type=int, default=60, help="pairs of a mirrored pelvis or rib cage")
    parser.add_argument("--similar", type=int, default=0, help="pairs with the most similar bone of another subject")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--out", type=Path, required=True, help="folder for the records")
    args = parser.parse_args()
    bones = bones_of(args.bones.split(","), args.split, args.anatomy)
    cases = cases_of(bones, args.count, args.mirrored, args.sides)
    if args.similar:
        grown = similar_to(bones, args.anatomy)
        cases = sorted(cases + cases_of_similar(grown, args.similar))
        bones = bones | {(bone, target): specimen for (bone, _, target), specimen in grown.items()}
    args.out.mkdir(parents=True, exist_ok=True)
    found = run(cases, bones, args.out / records.FILE, args.jobs)
    say(table(found))
    for line in alike(found, bones):
        say(line)
    return 0


def bones_of(names: Sequence[str], split: str, folder: Path | None) -> Bones:
    """The bones of the split, and long parametric ones."""
    known = [s for bone in names for s in specimens(bone, split, PEOPLE, folder)]
    known += [s for bone in names if bone in LONG for s in specimens(bone, split, PARAMETRIC)]
    return {(s.bone, s.person): s for s in known}


def cases_of(bones: Bones, count: int, mirrored: int, sides: int) -> list[Case]:
    """As many of each kind, in equal shares of the bones, those of one target in a row."""
    known = list(dict.fromkeys(bone for bone, _ in bones))
    cases = [
        Case(bone, target, SUBJECT, source, "L3", seed)
        for bone in known
        for seed, (target, source) in dealt(count // len(known), others(bones, bone))
    ]
    for kind, mirrored_ones, number in ((MIRRORED, LONG, mirrored), (SIDE, SYMMETRIC, sides)):
        names = [bone for bone in known if bone in mirrored_ones]
        for bone in names:
            subjects = [who for of_bone, who in bones if of_bone == bone]
            seen = [(who, LEVELS[(i + k) % len(LEVELS)]) for k in range(len(LEVELS)) for i, who in enumerate(subjects)]
            hands = dealt(number // len(names), seen)
            cases += [Case(bone, who, kind, who, level, seed) for seed, (who, level) in hands]
    return sorted(cases)


def similar_to(bones: Bones, folder: Path | None) -> dict[tuple[str, str, str], Specimen]:
    """The most similar bones of other subjects, grown to the size of each subject's own: by (bone, subject, name)."""
    everybody = {bone: specimens(bone, "all", PEOPLE, folder) for bone in dict.fromkeys(bone for bone, _ in bones)}
    return {
        (bone, subject, f"{other.person}-as-large-as-{subject}"): other
        for (bone, subject), specimen in bones.items()
        for other in most_similar(specimen, without_twins(specimen, everybody[bone]), MOST_SIMILAR)
    }


def cases_of_similar(grown: dict[tuple[str, str, str], Specimen], count: int) -> list[Case]:
    """As many of each bone, at every level in turn."""
    known = list(dict.fromkeys(bone for bone, _, _ in grown))
    return [
        Case(bone, target, SIMILAR, source, LEVELS[seed % len(LEVELS)], seed)
        for bone in known
        for seed, (source, target) in dealt(count // len(known), [key[1:] for key in grown if key[0] == bone])
    ]


def others(bones: Bones, bone: str) -> list[tuple[str, str]]:
    """(target, source) of all ordered pairs of two subjects, each target once before one comes again."""
    of_bone = [s for (name, _), s in bones.items() if name == bone]
    if any(s.cohort != "parametric" for s in of_bone):
        of_bone = [s for s in of_bone if s.cohort != "parametric"]
    turns = [of_bone[shift:] + of_bone[:shift] for shift in range(1, len(of_bone))]
    return [(s.person, o.person) for turn in turns for s, o in zip(of_bone, turn, strict=True) if without_twins(s, [o])]


def dealt(count: int, hands: Sequence[tuple[str, str]]) -> Iterator[tuple[int, tuple[str, str]]]:
    """(seed, hand) for `count` pairs; the seed counts how often all hands were dealt."""
    return ((number // len(hands), hands[number % len(hands)]) for number in range(count))


def run(cases: Sequence[Case], bones: Bones, path: Path, jobs: int) -> list[Record]:
    """The records of these cases; those that the file does not hold are made, and appended."""
    records.discard_cut_line(path)
    done = {record.pair: record for record in records.read(path)}
    left = [case for case in cases if case.name not in done]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, _start, (bones,)) as pool:
        for record in tqdm(pool.map(registered, left, chunksize=8), "pairs", len(left)):
            records.append(path, record)
            done[record.pair] = record
    return [done[case.name] for case in cases]


def _start(bones: Bones) -> None:
    end_with_parent()
    _bones.update(bones)


def registered(case: Case) -> Record:
    """One pair registered and judged."""
    pair = pair_of(case, _bones)
    return record_of(pair, registrar().register(pair.source, prepared(case.bone, case.target)))


def pair_of(case: Case, bones: Bones) -> Pair:
    """The case's source before the target that all cases of the bone share; only of the other side a pose is right."""
    bone, source_of = bones[case.bone, case.target], bones[case.bone, case.source]
    seen = source_of if case.kind in (SUBJECT, SIMILAR) else anatomy.mirrored(source_of)
    pair = make_pair(case.level, seen, case.seed)
    cloud = cloud_of(bone)
    origin_mm, truth = cloud.mean(axis=0), np.full((4, 4), np.nan)
    if case.kind == SIDE:
        truth = pair.T_target_source.copy()
        truth[:3, 3] += pair.metadata["origin_mm"]
        truth = on_its_other_side(bone) @ truth
        truth[:3, 3] -= origin_mm
    metadata = pair.metadata | {
        "origin_mm": origin_mm, "wrong_kind": case.kind, "degraded_as": case.level, "source_person": case.source
    }  # fmt: skip
    return Pair(pair.source, cloud - origin_mm, truth, case.name, case.bone, case.target, case.kind, metadata)


@lru_cache(maxsize=4)
def on_its_other_side(bone: Specimen) -> Array:
    """(4, 4) where the mirrored bone lies on the bone, mm."""
    return on_own_side(anatomy.mirrored(bone), bone)


def cloud_of(bone: Specimen) -> Array:
    """(TARGET_POINTS, 3) of the surface, the same whenever it is drawn."""
    return bone.sample(TARGET_POINTS, np.random.default_rng(0))[0]


@lru_cache(maxsize=4)
def prepared(bone: str, subject: str) -> PreparedTarget:
    """The target that a subject's cases share."""
    cloud = cloud_of(_bones[bone, subject])
    return registrar().prepare(cloud - cloud.mean(axis=0))


@cache
def registrar() -> Registrar:
    """The one of this process."""
    return Registrar.from_pretrained(RegistrarConfig(num_threads=1))


@cache
def commit() -> str | None:
    """Of the code that runs."""
    return origin.commit()


def table(found: Sequence[Record]) -> str:
    """Markdown: one line for each kind and bone, and one for each kind."""
    head = ("source", "bone", "subjects", "pairs", "right and accepted", "wrong and accepted",
            "wrong and accepted, % (95 % interval by subject)", "of these at >= 0.9")  # fmt: skip
    lines = []
    for kind in (SUBJECT, SIMILAR, MIRRORED, SIDE):
        of_kind = [r for r in found if r.protocol == kind]
        bones = [bone for bone in anatomy.BONES if any(r.bone == bone for r in of_kind)]
        lines += [line(kind, bone, [r for r in of_kind if r.bone == bone]) for bone in bones]
        lines += [line(kind, "all", of_kind)] if of_kind else []
    return markdown.table(head, lines)


def line(kind: str, bone: str, of_bone: Sequence[Record]) -> list[object]:
    """One row of the table."""
    subjects = [r.source_person if kind == SIMILAR else r.person for r in of_bone]  # whose bone was grown to many sizes
    wrong = [r.false_accept for r in of_bone]
    low, high = (100.0 * end for end in metrics.share_interval(wrong, subjects))
    right = sum(r.right for r in of_bone) if kind == SIDE else "-"
    share = f"{100.0 * np.mean(wrong):.2f} ({low:.2f} to {high:.2f})"
    sure = sum(r.false_accept and r.confidence >= SURE for r in of_bone)
    return [kind, bone, len(set(subjects)), len(of_bone), right, sum(wrong), share, sure]


def alike(found: Sequence[Record], bones: Bones) -> Iterator[str]:
    """For each two subjects with an accepted pair: how many, and how far their bones are apart."""
    key = lambda r: (r.bone, r.person, r.source_person)  # noqa: E731
    for (bone, target, source), group in groupby(sorted((r for r in found if r.protocol == SUBJECT), key=key), key):
        of_two = list(group)
        accepted = [r.confidence for r in of_two if r.accepted]
        if accepted:
            apart_mm = distance_mm(bones[bone, target], bones[bone, source])
            yield (f"{bone} of {target}, source of {source}, {apart_mm:.1f} mm apart (rms): "
                   f"{len(accepted)} of {len(of_two)} accepted, at most at {max(accepted):.2f}")  # fmt: skip


def distance_mm(bone: Specimen, other: Specimen) -> float:
    """Root mean square distance to a bone of points of another that is laid on it, mm."""
    points = se3.apply(on_own_side(other, bone), other.sample(COMPARED, np.random.default_rng(0))[0])
    return float(np.sqrt((bone.distance(points) ** 2).mean()))


if __name__ == "__main__":
    raise SystemExit(main())
