"""Bones out of label maps of several voxel sizes against their meshes: recall and error, on the same sources.

    python benchmarks/masks.py --anatomy DIR [--split val] [--count 8] [--spacings 0.5,1,2,3]

Each bone is voxelised and read back as a label map; the source is drawn from the bone itself, as in an operation. All
errors are against the true pose, in the frame of the bone.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from gapr_core import Registrar, RegistrarConfig
from gapr_core.benchmark.judge import judge
from gapr_core.data.masks import mask_of
from gapr_core.data.pool import specimens
from gapr_core.data.protocols import make_pair
from gapr_core.data.solid import is_closed
from gapr_core.data.specimen import Specimen
from gapr_core.formats.volumes.contour import surface_of
from gapr_core.pages import markdown
from gapr_core.runtime.console import say
from gapr_core.surface import Surface

BONES = ("femur", "tibia", "pelvis")
PEOPLE = 8


def main() -> int:
    """Register every pair to the mesh and to each mask, print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anatomy", type=Path, help="folder with the bones; else parametric ones")
    parser.add_argument("--split", default="val")
    parser.add_argument("--protocols", default="L2,L3", help="with commas")
    parser.add_argument("--count", type=int, default=8, help="pairs per bone and protocol")
    parser.add_argument("--spacings", default="0.5,1,2,3", help="sizes of the voxels, mm, with commas")
    args = parser.parse_args()
    registrar = Registrar.from_pretrained(RegistrarConfig(num_threads=1))
    spacings = [0.0, *map(float, args.spacings.split(","))]
    rows: dict[tuple[str, float], list[list[float]]] = {}
    people = {bone: closed(bone, args.split, args.anatomy) for bone in BONES}
    try:
        for number, bone in tqdm([(n, bone) for n in range(args.count) for bone in BONES], "bones", disable=None):
            specimen = people[bone][number % len(people[bone])]
            for spacing_mm in spacings:
                target = registrar.prepare(model(specimen.surface, spacing_mm, number))
                for protocol in args.protocols.split(","):
                    row = measure(registrar, target, specimen, protocol, 700 + number)
                    rows.setdefault((protocol, spacing_mm), []).append(row)
    finally:  # a run that is stopped shows what it has
        say(table(rows))
    return 0


def closed(bone: str, split: str, anatomy: Path | None) -> list[Specimen]:
    """The subjects whose mesh has an inside."""
    return [s for s in specimens(bone, split, PEOPLE, anatomy) if is_closed(s.surface.triangles)]


def model(surface: Surface, spacing_mm: float, seed: int) -> Surface:
    """The bone itself for 0, else the surface of its label map."""
    return surface_of(*mask_of(surface, spacing_mm, seed=seed)) if spacing_mm else surface


def measure(registrar: Registrar, target: object, specimen: Specimen, protocol: str, number: int) -> list[float]:
    """Right and accepted, best pose right, false accept, and the error over the whole bone, mm (NaN on a refusal)."""
    pair = make_pair(protocol, specimen, number)
    T_bone_source = pair.T_target_source.copy()
    T_bone_source[:3, 3] += pair.metadata["origin_mm"]
    result = registrar.register(pair.source, target)  # type: ignore[arg-type]
    cloud, _ = specimen.sample(len(pair.target), np.random.default_rng(number))
    judged = judge(replace(pair, target=cloud, T_target_source=T_bone_source), result)
    error = float(judged.whole_bone_mm) if result.ok and judged.whole_bone_mm is not None else np.nan
    return [bool(judged.right), bool(judged.best_right), bool(judged.false_accept), error]


def table(rows: dict[tuple[str, float], list[list[float]]]) -> str:
    """Markdown, one line for each protocol and target."""
    head = ("source", "target", "pairs", "accepted and right", "best pose right", "false accepts",
            "error over the bone, mm: median", "95 %")  # fmt: skip
    lines = [markdown.head(head)]
    for (protocol, spacing_mm), answers in sorted(rows.items()):
        right, best, wrong, error = np.array(answers).T
        known = error[np.isfinite(error)]
        tail = [f"{np.percentile(known, q):.2f}" for q in (50, 95)] if len(known) else ["-", "-"]
        name = f"voxels of {spacing_mm:g} mm" if spacing_mm else "mesh"
        counts = [f"{int(values.sum())}" for values in (right, best, wrong)]
        lines.append(markdown.row([protocol, name, len(answers), *counts, *tail]))
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(main())
