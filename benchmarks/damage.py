"""Damaged sources of kinds that nothing was fitted to: is a wrong pose believed, and is the right one found?

    python benchmarks/damage.py --anatomy DIR --out DIR [--split val] [--count 48] [--others 24] [--damages plate,lines]

Views of L1 and L2 in turn are damaged (`gapr_core.data.damage`), of the bone itself and, `--others`, of another
subject's. Finished pairs stay in DIR/records.jsonl, so that a stopped run goes on where it was.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from zlib import crc32

import numpy as np
from tqdm import tqdm

from gapr_core import Registrar, RegistrarConfig
from gapr_core.benchmark import records
from gapr_core.benchmark.judge import record_of
from gapr_core.benchmark.record import Record
from gapr_core.calibration.pairs import without_twins
from gapr_core.config import SensorConfig
from gapr_core.data.damage import CHANGES, DAMAGES, Site
from gapr_core.data.pair import Pair
from gapr_core.data.pool import specimens
from gapr_core.data.protocols import make_pair
from gapr_core.data.specimen import Specimen
from gapr_core.metrics.confidence import SURE
from gapr_core.pages import markdown
from gapr_core.runtime.console import say

Case = tuple[str, str, int, bool]  # damage, bone, number, and whether the target is another subject's
BONES, LEVELS = ("femur", "tibia", "pelvis"), ("L1", "L2")
NEXT = {"femur": "tibia", "tibia": "femur"}  # the bone on the other side of the knee
OTHER = ", another subject's bone"
HEAD = (
    "damage", "pairs", "best pose right", "right and accepted", "wrong accepted", "of these at 0.9 or more",
    "error below tre95_mm", "another subject's, accepted", "of these at 0.9 or more",
)  # fmt: skip


def main() -> int:
    """Register every pair that is not on record yet, print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anatomy", type=Path, help="folder with the bones; else parametric ones")
    parser.add_argument("--split", default="val")
    parser.add_argument("--count", type=int, default=48, help="pairs of each damage, of three bones")
    parser.add_argument("--others", type=int, default=24, help="as many of another subject's femur or tibia")
    parser.add_argument("--damages", default=",".join(DAMAGES), help="with commas")
    parser.add_argument("--sensor", default="unknown", help="what the user says of the sensor (default: %(default)s)")
    parser.add_argument("--out", type=Path, required=True, help="folder for the records")
    args = parser.parse_args()
    bones = {bone: specimens(bone, args.split, 12, args.anatomy) for bone in BONES}
    args.out.mkdir(parents=True, exist_ok=True)
    damages = args.damages.split(",")
    cases = [(name, bone, number, False) for name in damages for bone in BONES for number in range(args.count // 3)]
    changed = [name for name in damages if name in CHANGES]
    cases += [(name, bone, number, True) for name in changed for bone in NEXT for number in range(args.others // 2)]
    registrar = Registrar.from_pretrained(RegistrarConfig(num_threads=1, sensor=SensorConfig(args.sensor)))
    say(table(run(cases, bones, args.out / records.FILE, registrar, args.split), damages))
    return 0


def run(
    cases: Sequence[Case], bones: dict[str, list[Specimen]], path: Path, registrar: Registrar, split: str
) -> list[Record]:
    """The records of these cases; those that the file does not hold are made, and appended.

    A name says whose bones they are and how they were asked for: no record passes for one of another run.
    """
    records.discard_cut_line(path)
    done = {record.pair: record for record in records.read(path)}
    found = []
    for case in tqdm(cases, unit="pair"):
        person = whose(bones[case[1]], case[2]).person
        name = "_".join(map(str, (*case, person, split, registrar.config.sensor.kind)))
        if name not in done:
            done[name] = registered(registrar, replace(pair_of(*case, bones), name=name))
            records.append(path, done[name])
        found.append(done[name])
    return found


def whose(people: Sequence[Specimen], number: int) -> Specimen:
    """The bone that pair `number` is measured of: everybody's in turn."""
    return people[number % len(people)]


def pair_of(damage: str, bone: str, number: int, is_other: bool, bones: dict[str, list[Specimen]]) -> Pair:
    """Pair `number` of a damage; of another subject's bone it has no true pose."""
    people = bones[bone]
    own = whose(people, number)
    seen = make_pair(LEVELS[number // len(people) % len(LEVELS)], own, 100 + number)
    next_bone = next((s for s in bones.get(NEXT.get(bone, ""), []) if s.person == own.person), None)
    rng = np.random.default_rng([number, crc32(f"{damage} {bone}".encode())])
    damaged = DAMAGES[damage](seen, Site.of(own, seen.metadata["origin_mm"], next_bone), own, rng)
    if not is_other:
        return replace(damaged, protocol=damage)
    others = [other for other in without_twins(own, people) if other is not own]
    target = others[(number + number // len(people)) % len(others)]  # every other subject in turn
    return replace(
        damaged,
        target=make_pair("L1", target, number).target,
        T_target_source=np.full((4, 4), np.nan),
        person=target.person,
        protocol=damage + OTHER,
    )


def registered(registrar: Registrar, pair: Pair) -> Record:
    """The answer, judged."""
    return record_of(pair, registrar.register(pair.source, registrar.prepare(pair.target)))


def table(found: Sequence[Record], damages: Sequence[str]) -> str:
    """One row for each damage, and one for all."""
    of = {protocol: list(rows) for protocol, rows in groupby(sorted(found, key=_protocol), _protocol)}
    rows = [(name, of.get(name, []), of.get(name + OTHER, [])) for name in damages]
    rows.append(("all", [r for _, own, _ in rows for r in own], [r for _, _, others in rows for r in others]))
    return "\n".join([markdown.head(HEAD), *(line(*row) for row in rows)])


def line(name: str, own: Sequence[Record], others: Sequence[Record]) -> str:
    """One row."""
    wrong = [r for r in own if r.false_accept]
    taken = [r for r in others if r.accepted]
    bounded = [r for r in own if r.predicted_tre95_mm is not None and r.whole_bone_mm is not None and r.accepted]
    held = sum(r.whole_bone_mm <= r.predicted_tre95_mm for r in bounded)
    return markdown.row([
        name, len(own), sum(bool(r.best_right) for r in own), sum(r.right for r in own), len(wrong), _sure(wrong),
        f"{held} of {len(bounded)}", f"{len(taken)} of {len(others)}", _sure(taken),
    ])  # fmt: skip


def _sure(accepted: Sequence[Record]) -> int:
    return sum(r.confidence >= SURE for r in accepted)


def _protocol(record: Record) -> str:
    return record.protocol


if __name__ == "__main__":
    raise SystemExit(main())
