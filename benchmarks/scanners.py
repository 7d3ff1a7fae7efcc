"""Models as other scanners and segmentations would give them: recall, refusals and false accepts.

    python benchmarks/scanners.py --anatomy DIR [--split val] [--count 8] [--models "as given,voxels of 3 mm"]

The source is drawn from the model itself, as in every list of pairs, or from the bone before it was scanned, as in an
operation: then what the scan changed is one more misfit, which no protocol has. Wrong sources are of the same bone of
another subject, seen as at L2.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from gapr_core import Registrar, RegistrarConfig
from gapr_core.benchmark.judge import judge
from gapr_core.data import scans
from gapr_core.data.pool import specimens
from gapr_core.data.protocols import ANOTHER_PERSON, TARGET_POINTS, make_pair
from gapr_core.data.specimen import Specimen
from gapr_core.pages import markdown
from gapr_core.runtime.console import say

PROTOCOLS = ("paper", "L1", "L2", "L3", "wrong")
BONES = ("femur", "tibia", "pelvis", "thoracic")
PEOPLE = 8  # parametric ones, where a bone has no others


OTHER_PEOPLE: dict[str, scans.Scan] = {
    "as given": scans.of_size(1.0),
    "0.75 of the size": scans.of_size(0.75),
    "1.2 of the size": scans.of_size(1.2),
}
OTHER_SCANNERS: dict[str, scans.Scan] = {
    "voxels of 0.8 x 0.8 x 3 mm": scans.of_voxels(0.8, 0.8, 3.0),
    "voxels of 1.5 mm": scans.of_voxels(1.5, 1.5, 1.5),
    "voxels of 3 mm": scans.of_voxels(3.0, 3.0, 3.0),
    "1000 triangles": scans.of_triangles(1000),
    "smoothed (10 rounds of Laplace)": scans.smoothed(10),
}
MODELS = OTHER_PEOPLE | OTHER_SCANNERS


def main() -> int:
    """Register every pair, print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anatomy", type=Path, help="folder with the bones; else parametric ones")
    parser.add_argument("--split", default="val")
    parser.add_argument("--bones", default=",".join(BONES), help="with commas")
    parser.add_argument("--count", type=int, default=8, help="pairs per bone, model and protocol")
    parser.add_argument("--models", default=",".join(MODELS), help="with commas")
    args = parser.parse_args()
    registrar = Registrar.from_pretrained(RegistrarConfig(num_threads=1))
    people = {bone: specimens(bone, args.split, PEOPLE, args.anatomy) for bone in args.bones.split(",")}
    head = ("model", "source of", *(f"{protocol}: right % (accepted)" for protocol in PROTOCOLS[:-1]),
            "wrong: accepted", "false accepts", "of these at >= 0.9")  # fmt: skip
    say(markdown.head(head))
    for name in args.models.split(","):
        scans = {bone: [replace(s, surface=MODELS[name](s.surface)) for s in known] for bone, known in people.items()}
        sources = {"the model": scans, "the bone": people} if name in OTHER_SCANNERS else {"the model": scans}
        for source_of, seen in sources.items():
            rows = [
                measure(registrar, scans[bone], seen[bone], number)
                for bone in scans
                for number in tqdm(range(args.count), f"{name}, {bone}", leave=False)
            ]
            say(line(name, source_of, np.array(rows)))
    return 0


def measure(registrar: Registrar, scanned: list[Specimen], seen: list[Specimen], number: int) -> list[list[bool]]:
    """One bone's model, for each protocol: right, accepted, false accept, false accept at 0.9 or more."""
    who = number % len(scanned)
    cloud, _ = scanned[who].sample(TARGET_POINTS, np.random.default_rng(number))
    target, answers = registrar.prepare(cloud), []
    for protocol in PROTOCOLS:
        pair = make_pair(protocol, seen[who], 500 + number, seen, ANOTHER_PERSON["L2"])
        T_scan_source = pair.T_target_source.copy()
        T_scan_source[:3, 3] += pair.metadata["origin_mm"]
        result = registrar.register(pair.source, target)
        judged = judge(replace(pair, target=cloud, T_target_source=T_scan_source), result)
        wrong = bool(judged.false_accept)
        answers.append([bool(judged.right), result.ok, wrong, wrong and result.confidence >= 0.9])
    return answers


def line(name: str, source_of: str, answers: np.ndarray) -> str:
    """One row of the table from (pairs, protocols, 4) answers."""
    right, accepted, *_ = answers.sum(axis=0).T
    cells = [f"{100.0 * r / len(answers):.1f} ({a})" for r, a in zip(right[:-1], accepted[:-1], strict=True)]
    counts = [f"{accepted[-1]} of {len(answers)}", *answers[:, :, 2:].sum(axis=(0, 1))]
    return markdown.row([name, source_of, *cells, *counts])


if __name__ == "__main__":
    raise SystemExit(main())
