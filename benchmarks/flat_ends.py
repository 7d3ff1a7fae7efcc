"""Models that end in a plane, and clouds with another: is a saw cut laid on the border of a scan, a table on a table?

    python benchmarks/flat_ends.py --anatomy DIR [--split val] [--count 24]

`border`: the model is cut where a scan ends, the bone 4 to 30 mm from there; a camera sees cut and bone. `table`: the
model holds the scanner's flat table below the bone, the cloud another one, tilted, at another distance. Each with the
flat ends in the target (`target.flat_end_mm2` 0) and without. Noise of 0.1 to 0.5 mm, a smooth bias of up to 0.3 mm.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from gapr_core import Registrar, RegistrarConfig, Surface
from gapr_core.config import TargetConfig
from gapr_core.data.pool import specimens
from gapr_core.data.sensors.acquired import smooth_offsets
from gapr_core.data.specimen import Specimen
from gapr_core.geometry import extent, se3
from gapr_core.metrics.confidence import SURE
from gapr_core.pages import markdown
from gapr_core.runtime.console import say

Array = NDArray[np.float64]
BONES = ("femur", "tibia")
DENSE, SEEN = 120_000, 3000
HEAD = ("model and cloud", "flat ends", "pairs", "right and accepted", "wrong accepted", "of these at 0.9 or more",
        "error below tre95_mm")  # fmt: skip


class Case(NamedTuple):
    """A model, what is seen in its frame (mm), the bone alone, and the pose of the model in the sensor's frame."""

    model: Surface
    seen: Array
    bone: Specimen
    T_source_target: Array


def main() -> int:
    """Register every case with and without the flat ends, print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anatomy", type=Path, help="folder with the bones; else parametric ones")
    parser.add_argument("--split", default="val")
    parser.add_argument("--count", type=int, default=24, help="cases of each kind and bone")
    args = parser.parse_args()
    people = {bone: specimens(bone, args.split, 8, args.anatomy) for bone in BONES}
    config = RegistrarConfig(num_threads=1)
    kept = replace(config, target=TargetConfig(flat_end_mm2=0.0))
    registrars = {"in the target": Registrar.from_pretrained(kept), "left out": Registrar.from_pretrained(config)}
    lines = [markdown.head(HEAD)]
    for kind, make in KINDS.items():
        answers: dict[str, list[tuple[bool, bool, bool, bool]]] = {name: [] for name in registrars}
        for number in tqdm(range(args.count * len(BONES)), kind, leave=False):
            bone = people[BONES[number % len(BONES)]]
            case = make(bone[number // len(BONES) % len(bone)], np.random.default_rng([number, len(kind)]))
            for name, registrar in registrars.items():
                answers[name].append(measured(registrar, case))
        for name, rows in answers.items():
            lines.append(line(kind, name, np.array(rows)))
    say("\n".join(lines))
    return 0


def measured(registrar: Registrar, case: Case) -> tuple[bool, bool, bool, bool]:
    """Whether the answer is right, wrong, wrong at 0.9 or more, and right with a bound that holds."""
    result = registrar.register(se3.apply(case.T_source_target, case.seen), registrar.prepare(case.model))
    if result.T_target_source is None:
        return False, False, False, False
    moved = result.T_target_source @ case.T_source_target
    right = se3.pose_error(moved, np.eye(4), case.seen).is_right
    error_mm = se3.rms_apart_mm(moved, np.eye(4), case.bone.surface.points)
    return right, not right, not right and result.confidence >= SURE, right and error_mm <= (result.tre95_mm or np.inf)


def border(whole: Specimen, rng: np.random.Generator) -> Case:
    """A model cut where the scan ends, and what a camera sees of the bone that is sawn 4 to 30 mm from there."""
    points = whole.surface.points
    axis = extent.principal(points).axes[0] * rng.choice([-1.0, 1.0])
    along = points @ axis
    end_mm = along.min() + rng.uniform(0.35, 0.7) * np.ptp(along)
    tilted = unit(axis + np.tan(np.radians(2.0)) * rng.normal(size=3))
    here = points[np.abs(along - end_mm) < 10.0].mean(axis=0)
    gap_mm = rng.choice([rng.uniform(4.0, 8.0), rng.uniform(8.0, 30.0)])
    sawn = whole.cut(tilted, here @ tilted - gap_mm)
    towards = unit(unit(np.cross(axis, rng.normal(size=3))) + rng.uniform(0.4, 1.3) * axis)
    seen, normals = sawn.sample(DENSE, rng)
    reach_mm = rng.uniform(15.0, 90.0)
    near = (seen @ tilted > here @ tilted - gap_mm - reach_mm) & (normals @ towards > 0.15)
    source = measured_points(sawn, seen[near], normals[near], towards, rng)
    return Case(whole.cut(axis, end_mm).surface, source, whole, anywhere(rng))


def table(whole: Specimen, rng: np.random.Generator) -> Case:
    """A model with the flat table of the scanner, and a camera that sees bone and another flat thing below it."""
    axes = extent.principal(whole.surface.points).axes
    up = axes[2] * rng.choice([-1.0, 1.0])
    model = with_slab(whole, axes, up, rng.uniform(5.0, 40.0), np.zeros(3))
    scene = with_slab(whole, axes, up, rng.uniform(5.0, 40.0), np.radians(4.0) * rng.normal(size=3))
    towards = unit(up + 0.5 * rng.normal(size=3))
    seen, normals = scene.sample(DENSE, rng)
    middle = whole.surface.points[rng.integers(len(whole.surface.points))]
    aside = seen - middle
    aside -= np.outer(aside @ towards, towards)
    near = (np.linalg.norm(aside, axis=1) < rng.uniform(50.0, 110.0)) & (normals @ towards > 0.2)
    return Case(model.surface, measured_points(scene, seen[near], normals[near], towards, rng), whole, anywhere(rng))


KINDS: dict[str, Callable[[Specimen, np.random.Generator], Case]] = {"border": border, "table": table}


def with_slab(whole: Specimen, axes: Array, up: Array, gap_mm: float, turned: Array) -> Specimen:
    """The bone with a slab 10 mm thick below it, 80 mm wider on each side, turned about its middle by (3,) rad."""
    import open3d as o3d

    frame = np.array([axes[0], np.cross(up, axes[0]), up])
    own = whole.surface.points @ frame.T
    low, high = own.min(axis=0) - [80.0, 80.0, 0.0], own.max(axis=0) + [80.0, 80.0, 0.0]
    box = o3d.geometry.TriangleMesh.create_box(high[0] - low[0], high[1] - low[1], 10.0).subdivide_midpoint(4)
    corners = (np.asarray(box.vertices) + [low[0], low[1], low[2] - gap_mm - 10.0]) @ frame
    corners = se3.apply(se3.exp(np.concatenate([np.zeros(3), turned]), corners.mean(axis=0)), corners)
    faces = np.vstack([whole.surface.triangles, np.asarray(box.triangles) + len(own)])
    return replace(whole, surface=Surface(np.vstack([whole.surface.points, corners]), faces))


def measured_points(scene: Specimen, points: Array, normals: Array, towards: Array, rng: np.random.Generator) -> Array:
    """(N, 3) up to 3000 of the points that are seen from far away, with noise and a smooth bias."""
    visible = np.flatnonzero(scene.visible_from(points, towards))
    drawn = rng.permutation(visible)[:SEEN]
    bias_mm, _ = smooth_offsets(points[drawn], 0.3, rng)
    noise_mm = rng.normal(0.0, rng.uniform(0.1, 0.5), (len(drawn), 3))
    return np.asarray(points[drawn] + noise_mm + bias_mm[:, None] * normals[drawn])


def anywhere(rng: np.random.Generator) -> Array:
    """A pose (4, 4) with any rotation, mm."""
    return se3.from_rotation_translation(se3.random_rotation(rng), rng.uniform(-300.0, 300.0, 3))


def unit(v: Array) -> Array:
    """A vector (3,) of length 1."""
    return np.asarray(v / np.linalg.norm(v))


def line(kind: str, ends: str, rows: NDArray[np.bool_]) -> str:
    """One row of the table."""
    right, wrong, sure, held = rows.sum(axis=0)
    return markdown.row([kind, ends, len(rows), right, wrong, sure, f"{held} of {right}"])


if __name__ == "__main__":
    raise SystemExit(main())
