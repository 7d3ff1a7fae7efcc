"""Scans that hold one end of a bone only, as those of a knee do: recall, refusals and false accepts.

    python benchmarks/short_scans.py --anatomy DIR [--split val] [--count 12] [--shares 0.4,0.2]

Target and source are of the same end of the bone, cut off and closed; wrong sources are of the same end of another
subject's bone.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from tqdm import tqdm

from gapr_core import Registrar, RegistrarConfig
from gapr_core.benchmark.judge import judge
from gapr_core.data.pool import specimens
from gapr_core.data.protocols import ANOTHER_PERSON, make_pair
from gapr_core.data.specimen import Specimen
from gapr_core.pages import markdown
from gapr_core.runtime.console import say

PROTOCOLS = ("paper", "L1", "L2", "L3", "sweep", "wrong")


def main() -> int:
    """Register every pair, print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anatomy", type=Path, help="folder with the bones; else parametric ones")
    parser.add_argument("--split", default="val")
    parser.add_argument("--bones", default="femur,tibia", help="with commas")
    parser.add_argument("--count", type=int, default=12, help="pairs per bone, share and protocol")
    parser.add_argument("--shares", default="0.4,0.2", help="of the bone's length, with commas")
    args = parser.parse_args()
    registrar = Registrar.from_pretrained(RegistrarConfig(num_threads=1))
    head = ("share of the bone", "protocol", "pairs", "recall 4 mm/5 deg %", "best pose right %", "refused",
            "false accepts", "of these at >= 0.9")  # fmt: skip
    lines = [markdown.head(head)]
    for share in map(float, args.shares.split(",")):
        ends = [[[s.end(share, upper) for s in specimens(bone, args.split, 5, args.anatomy)] for upper in (False, True)]
                for bone in args.bones.split(",")]  # fmt: skip
        for protocol in PROTOCOLS:
            rows = [
                measure(registrar, of_bone[i % 2], protocol, i)
                for of_bone in ends
                for i in tqdm(range(args.count), f"{share:g} {protocol}", leave=False)
            ]
            lines.append(line(share, protocol, np.array(rows)))
    say("\n".join(lines))
    return 0


def measure(registrar: Registrar, people: list[Specimen], protocol: str, number: int) -> list[bool]:
    """Whether the answer is right, its best pose is, it is a refusal, a false accept, and one at 0.9 or more."""
    turn = list(ANOTHER_PERSON.values())[number // 2 % 4]
    pair = make_pair(protocol, people[number // 2 % len(people)], 300 + number, people, turn)
    result = registrar.register(pair.source, registrar.prepare(pair.target))
    judged = judge(pair, result)
    wrong = bool(judged.false_accept)
    return [bool(judged.right), bool(judged.best_right), not result.ok, wrong, wrong and result.confidence >= 0.9]


def line(share: float, protocol: str, rows: np.ndarray) -> str:
    """One row of the table."""
    right, best, *counts = rows.sum(axis=0)
    shares = ["-", "-"] if protocol == "wrong" else [f"{100.0 * n / len(rows):.1f}" for n in (right, best)]
    return markdown.row([f"{share:g}", protocol, len(rows), *shares, *counts])


if __name__ == "__main__":
    raise SystemExit(main())
