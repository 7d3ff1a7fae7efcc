"""Hollow bones: the outer cortex alone against both cortices as the target, on the same pairs in one run.

    python benchmarks/hollow.py --anatomy DIR [--split val] [--count 6] [--walls 2.5,4]

Each bone gets an inner cortex, its own surface moved inwards. Sources are one-sided views of the outer cortex (L1 to
L3), or pieces of both cortices (paper, incomplete).
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from gapr_core import Registrar, RegistrarConfig
from gapr_core.benchmark.judge import judge
from gapr_core.data.pool import specimens
from gapr_core.data.protocols import make_pair
from gapr_core.data.solid import volume_mm3
from gapr_core.data.specimen import Specimen
from gapr_core.pages import markdown
from gapr_core.runtime.console import say
from gapr_core.surface import Surface

PROTOCOLS = ("paper", "incomplete", "L1", "L2", "L3")
BONES = ("femur", "tibia", "pelvis")


def main() -> int:
    """Register every pair in three ways, print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anatomy", type=Path, help="folder with the bones; else parametric ones")
    parser.add_argument("--split", default="val")
    parser.add_argument("--count", type=int, default=6, help="pairs per bone, wall and protocol")
    parser.add_argument("--walls", default="2.5,4", help="thicknesses, mm, with commas")
    args = parser.parse_args()
    registrar = Registrar.from_pretrained(RegistrarConfig(num_threads=1))
    head = (
        "wall",
        "source",
        "pairs",
        "inner cortex found",
        "as shipped: right, accepted, wrong at 0.9 or more",
        "outer cortex only",
        "both cortices always",
    )
    lines = [markdown.head(head)]
    for wall_mm in map(float, args.walls.split(",")):
        for protocol in PROTOCOLS:
            rows = [
                measure(registrar, hollowed(people[i % len(people)], wall_mm), protocol, 100 + i)
                for bone in BONES
                for people in [specimens(bone, args.split, 3, args.anatomy)]
                for i in tqdm(range(args.count), f"{protocol} {bone}", leave=False)
            ]
            lines.append(line(wall_mm, protocol, np.array(rows)))
    say("\n".join(lines))
    return 0


def hollowed(specimen: Specimen, wall_mm: float) -> Specimen:
    """The same bone with an inner cortex: its vertices moved inwards along their normals."""
    points, faces = specimen.surface.points, specimen.surface.triangles
    normals = np.asarray(specimen.surface.to_open3d().compute_vertex_normals().vertex_normals)
    inner = points - wall_mm * np.sign(volume_mm3(specimen.surface)) * normals
    both = Surface(np.vstack([points, inner]), np.vstack([faces, faces[:, ::-1] + len(points)]))
    return replace(specimen, surface=both)


def measure(registrar: Registrar, specimen: Specimen, protocol: str, seed: int) -> list[float]:
    """Whether an inner cortex was found, then right, accepted, wrong at 0.9 or more: shipped, outer only, both only."""
    pair = make_pair(protocol, specimen, seed)
    target = registrar.prepare(pair.target)
    both = target.both_cortices or target
    row = [float(target.both_cortices is not None)]
    for given in (target, replace(target, both_cortices=None), both):
        result = registrar.register(pair.source, given)
        judged = judge(pair, result)
        row += [judged.right, result.ok, judged.false_accept and result.confidence >= 0.9]
    return row


def line(wall_mm: float, protocol: str, rows: np.ndarray) -> str:
    """One row of the table."""
    found, *counts = rows.sum(axis=0).astype(int)
    cells = [", ".join(map(str, counts[i : i + 3])) for i in (0, 3, 6)]
    return markdown.row([f"{wall_mm:g} mm", protocol, len(rows), found, *cells])


if __name__ == "__main__":
    raise SystemExit(main())
